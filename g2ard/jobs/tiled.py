"""Simplification, distillation and levels of detail in tiles."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from g2ard.config.choices import RenderModel
from g2ard.errors import InputError
from g2ard.io.detect import MANIFEST
from g2ard.io.tile_store import StoredScene, TileStore
from g2ard.io.types import ViewSet
from g2ard.jobs.budget import Budget
from g2ard.jobs.cost import RECOVERY_TIMES, workers_for
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import Views, say_regions
from g2ard.jobs.levels import Levels, check_ratios, make_levels
from g2ard.jobs.tiling import Tiling, needs_whole, refuse_whole
from g2ard.jobs.views import cameras_for_weights, pool_times, views_of
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.distill import RunViews
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.report.run import TiledReport, TiledScores
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.auto_preset import regularizers_for
from g2ard.stages.recover.schedule import steps_for
from g2ard.stages.select import select
from g2ard.stages.simplify import SimplifyConfig
from g2ard.stages.simplify.growth import say_gaps
from g2ard.system.peak_memory import peak_rss_of_all
from g2ard.tiles.executor import Workers, executor
from g2ard.tiles.ingest import ingest
from g2ard.tiles.merging import TiledScene, simplify_tiles
from g2ard.tiles.recover import recover_tiles
from g2ard.tiles.sights import Surroundings
from g2ard.tiles.steps import TiledRun


@contextmanager
def _tiles_and_workers(
    scene: Path, tiling: Tiling, times: float, render_model: RenderModel | None, progress: Progress, say: Say
) -> Iterator[tuple[TileStore, Workers]]:
    """Open the tiles of a scene, streamed into `tiling.folder` if it is a file, and start workers.

    Args:
        tiling: how. Tiles of another size are replaced unless the user named the folder.
    """
    if (scene / MANIFEST).is_file():
        store = TileStore.open(scene)
        if render_model not in (None, store.render_model):
            raise InputError(
                f"these tiles are {store.render_model}",
                path=scene,
                hint=f"run `g2ard ingest --render-model {render_model}` on their scene",
            )
    else:
        store = ingest(
            scene,
            tiling.folder / "tiles",
            tile_rows=tiling.most_rows,
            render_model=render_model,
            overwrite=not tiling.keep,
            progress=progress,
            say=say,
        )
    workers = workers_for(store, tiling, times)
    threads = max(1, tiling.usable_cores // workers)
    say(f"{len(store.tiles):,} tiles of {store.count:,} Gaussians, {workers} at a time")
    with executor(workers, threads, tiling.scheduler) as runs:
        yield store, Workers(runs, tiling.folder / "steps", progress)


def simplify_in_tiles(
    scene: Path,
    budgets: Sequence[Budget],
    tiling: Tiling,
    *,
    views: Views | None = None,
    blind: bool = False,
    config: SimplifyConfig | None = None,
    up: Sequence[float] | None = None,
    seed: int = 0,
    render_model: RenderModel | None = None,
    counted: Callable[[int], object] | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[tuple[TileStore, TiledScene]]:
    """Simplify a scene larger than memory to several budgets, each computed when it is requested.

    Args:
        tiling: how; `folder` keeps finished steps, so that the same call resumes.
        counted: called with the scene's count before work on its tiles.
    """
    config = config or SimplifyConfig()
    with _tiles_and_workers(scene, tiling, 1.0, render_model, progress, say) as (store, workers):
        if counted is not None:
            counted(store.count)
        counts = [budget.of(store.count, str(scene)) for budget in budgets]
        run, cameras = TiledRun(store, workers, config), None
        if not blind and min(counts) < store.count:
            sample = run.sample()
            say_regions(sample, config, "a sample of the scene", unsaid)
            cameras = cameras_for_weights(
                sample,
                views,
                "default",
                beside=scene,
                up=up,
                seed=seed,
                represents=store.count / len(sample),
                progress=progress,
                say=say,
            )
        for count in counts:
            seen = cameras if count < store.count else None
            yield store, simplify_tiles(run, count, seen, compare=True)


@dataclass(frozen=True, eq=False)
class TiledDistilled:
    """A distilled scene in tiles, with its unrecovered version, its views and its report."""

    splats: TiledScene
    simplified: TiledScene
    views: RunViews
    report: TiledReport


def distill_in_tiles(
    scene: Path,
    budget: Budget,
    tiling: Tiling,
    options: DistillOptions,
    *,
    progress: Progress = silent,
    say: Say = unsaid,
) -> TiledDistilled:
    """Distil a scene larger than memory.

    Targets are the dense scene's own renders, in views that are given, found beside it or generated.

    Args:
        options: as for `g2ard.distill`, without what `needs_whole` returns.
    """
    began = time.monotonic()
    with _job(scene, tiling, options, budget, True, progress, say) as job:
        views = job.views
        small = job.simplified(job.store, job.count, views.train.cameras)
        assert small.surroundings is not None  # views are given
        done, scores = job.recovered(small, small.surroundings, views)
        report = TiledReport(
            input_count=job.store.count,
            output_count=len(done),
            tiles=list(done.counts),
            notes={note.code: note.count for note in job.store.notes},
            seconds={"total": time.monotonic() - began},
            peak_rss_bytes=peak_rss_of_all(),
            scores=scores,
            size=views.test.size_text,
            views={"train": len(views.train.cameras), "test": len(views.test)},
        )
        return TiledDistilled(done, small, views, report)


def lod_in_tiles(
    scene: Path,
    ratios: Sequence[float],
    tiling: Tiling,
    options: DistillOptions,
    *,
    recover: bool = True,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Levels[StoredScene]:
    """Make levels of detail of a scene larger than memory.

    As in `g2ard.lod`, a level is merged from the one before, which lies in tiles of its own, and recovered
    against the dense scene's renders in views shrunk by √√r.

    Args:
        recover: optimise each level; otherwise levels are only merged.

    Returns:
        The levels, of exactly round(N/r) Gaussians each.
    """
    check_ratios(ratios)
    refuse_whole(scene, needs_whole(options.config))
    around: Surroundings | None = None
    with _job(scene, tiling, options, Budget(ratio=ratios[-1]), recover, progress, say) as job:

        def make(
            finer: StoredScene, count: int, longest: int
        ) -> tuple[StoredScene, StoredScene, float, float | None]:
            nonlocal around
            views = job.views.resized(longest)
            small = job.simplified(finer.store, count, (views if recover else job.views).train.cameras)
            say_gaps(small.opacity_lost, say)
            around = around or small.surroundings  # the first level is merged from the dense scene itself
            assert around is not None  # views are given
            merged = StoredScene(job.stored(small, "merged"))
            done, scores = job.recovered(small, around, views)
            if not recover:
                return merged, merged, scores.simplified, None
            return StoredScene(job.stored(done, "level")), merged, scores.simplified, scores.recovered

        return make_levels(StoredScene(job.store), ratios, job.views.train.cameras, make, say)


def _weighted(views: ViewSet, sample: Splats, config: DistillConfig, progress: Progress) -> ViewSet:
    """Return training views with the sampling weights that a distillation in one piece would use."""
    weights = views.weights
    if not config.select.weighted:
        weights = None
    elif weights is None:
        chosen = select(sample, views.cameras, len(views.cameras), progress=progress)
        weights = np.zeros(len(views.cameras))
        weights[chosen.order] = chosen.weights
    return replace(views, weights=weights)


@dataclass(frozen=True, eq=False)
class _Job:
    """A distillation in tiles with everything decided.

    Args:
        learn: whether anything is recovered, or only scored.
    """

    store: TileStore
    count: int
    sample: Splats
    views: RunViews
    config: DistillConfig
    learn: bool
    workers: Workers
    tiling: Tiling

    def simplified(self, store: TileStore, count: int, cameras: Cameras) -> TiledScene:
        """Simplify a scene in tiles: the dense one, or one derived from it."""
        run = TiledRun(store, self.workers, self.config.simplify)
        return simplify_tiles(run, count, cameras, compare=not self.learn)

    def recovered(
        self, small: TiledScene, around: Surroundings, views: RunViews
    ) -> tuple[TiledScene, TiledScores]:
        """Recover a simplified scene, unless nothing is to be learned, and score it."""
        needed = steps_for(self.sample, views.train.cameras, self.config.recover.schedule.steps)
        steps = self.config.recover.steps or round(needed * pool_times(self.store.count))
        return recover_tiles(
            self.store,
            self.stored(small, "student", like=self.store),
            around,
            views,
            self.config.recover,
            steps if self.learn else 0,
            self.workers,
        )

    def stored(self, scene: TiledScene, name: str, like: TileStore | None = None) -> TileStore:
        """Write a derived scene in tiles of its own, or in those of another."""
        folder = self.tiling.folder / f"{name}-{scene.key}"
        return ingest(scene.stream(), folder, tile_rows=self.tiling.most_rows, like=like)


@contextmanager
def _job(
    scene: Path,
    tiling: Tiling,
    options: DistillOptions,
    budget: Budget,
    learn: bool,
    progress: Progress,
    say: Say,
) -> Iterator[_Job]:
    """Open the tiles, start workers, and decide views and constants of a distillation."""
    options.check_trained()
    model = options.render_model
    with _tiles_and_workers(scene, tiling, RECOVERY_TIMES, model, progress, say) as (store, workers):
        count = budget.of(store.count, str(scene))
        sample = TiledRun(store, workers, options.config.simplify).sample()
        say_regions(sample, options.config.simplify, "a sample of the scene", unsaid)
        views = views_of(
            sample,
            options,
            count,
            beside=options.beside or scene,
            use="tiles" if learn else "merging",
            represents=store.count / len(sample),
            progress=progress,
            say=say,
        )
        regularizers, why, _ = regularizers_for(options.named("recover.regularizers"), sample)
        config = options.configured(regularizers)
        if learn:
            say(f"regularisers: {why}")
            views = replace(views, train=_weighted(views.train, sample, config, progress))
        yield _Job(store, count, sample, views, config, learn, workers, tiling)
