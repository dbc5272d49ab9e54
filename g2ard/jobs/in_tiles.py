"""Simplification, distillation and levels of detail of scenes in tiles."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from g2ard.errors import InputError
from g2ard.io.reports import Report
from g2ard.io.sanitize import BLOCK
from g2ard.io.source import Source
from g2ard.io.stream import PartsStream
from g2ard.io.tile_store import TileStore
from g2ard.jobs.budget import Budget
from g2ard.jobs.budget_search import ResolvedBudget, resolved_in_tiles
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import say_regions
from g2ard.jobs.memory import TilePlan, plan_tiles
from g2ard.jobs.run_views import pool_times, views_of
from g2ard.jobs.tile_options import Tiling
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.distill import RunViews, draw_weights
from g2ard.progress import Detail, Progress, Say, silent, unsaid
from g2ard.report.run import TiledReport, TiledScores
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.recover.anchors import regularizers_for
from g2ard.stages.simplify import SimplifyConfig
from g2ard.stages.simplify.gaps import say_gaps
from g2ard.system.peak_memory import peak_rss_of_all
from g2ard.tiles.executor import Workers, executor
from g2ard.tiles.ingest import ingest
from g2ard.tiles.merging import simplify_tiles
from g2ard.tiles.recover import recover_tiles
from g2ard.tiles.sights import Sights
from g2ard.tiles.simplify import TiledRun, sample_stride


@dataclass(frozen=True, eq=False)
class Tiles:
    """A scene in tiles: written, with workers, or only planned.

    Args:
        store: the tiles; None if they are not written.
        workers: None if nothing is to be computed.
    """

    source: Source
    tiling: Tiling
    plan: TilePlan
    store: TileStore | None = None
    workers: Workers | None = None

    @property
    def written(self) -> TileStore:
        """The tiles, which are not only planned."""
        assert self.store is not None
        return self.store

    def run(self, config: SimplifyConfig, store: TileStore | None = None) -> TiledRun:
        """Begin to simplify the tiles, or those of a scene derived from them."""
        assert self.workers is not None
        return TiledRun(store or self.written, self.workers, config)

    def simplified(self, count: int, views: Cameras | None, config: SimplifyConfig) -> TiledSimplified:
        """Simplify the scene; finished steps are in the folder of its workers."""
        small = simplify_tiles(self.run(config), count, views, gaps=True)
        parts = list(small.splats.counts), small.views, small.unseen, small.opacity_lost
        return TiledSimplified(small.splats, TiledSimplifyReport(self.plan.count, len(small.splats), *parts))

    def sample(self, config: SimplifyConfig) -> Splats:
        """Return a sample of the Gaussians, from which views are planned and constants chosen."""
        if self.workers is not None:
            return self.run(config).sample()
        stream = self.source.scene
        stride, read, parts = sample_stride(stream.count), 0, []
        for block in stream.blocks(BLOCK):
            parts.append(block.take(slice(-read % stride, None, stride)))
            read += len(block)
        return join(parts)


@contextmanager
def opened(
    source: Source,
    tiling: Tiling,
    times: float,
    *,
    planned: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[Tiles]:
    """Open the tiles of a scene, streamed into `tiling.folder` if it is a file, and start workers.

    Args:
        tiling: how. Tiles of another size are replaced unless the user named the folder.
        times: memory of a tile relative to merging it.
        planned: only plan this; nothing is written.
    """
    store, model = source.store, source.render_model
    if store is not None and model not in (None, store.render_model):
        raise InputError(
            f"these tiles are {store.render_model}",
            path=source.path,
            hint=f"run `g2ard ingest --render-model {model}` on their scene",
        )
    if store is None and not planned:
        store = ingest(
            source,
            tiling.folder / "tiles",
            tile_rows=tiling.most_rows,
            overwrite=not tiling.keep,
            progress=progress,
            say=say,
        )
    plan = plan_tiles(store or source.scene, tiling, times)
    say(f"{plan.tiles:,} tiles of {plan.count:,} Gaussians, {plan.workers} at a time")
    tiles = Tiles(source, tiling, plan, store)
    if planned:
        yield tiles
        return
    threads = max(1, tiling.usable_cores // plan.workers)
    with executor(plan.workers, threads, tiling.scheduler) as runs:
        yield replace(tiles, workers=Workers(runs, tiling.folder / "steps", progress))


@dataclass(frozen=True)
class TiledSimplifyReport(Report):
    """Report of a simplification in tiles; the fields are those of `Merged`."""

    input_count: int
    output_count: int
    tiles: list[int]
    views: int
    unseen: int | None
    opacity_lost: float | None
    rounds = ()


@dataclass(frozen=True, eq=False)
class TiledSimplified:
    """A simplified scene in tiles, and a report."""

    splats: PartsStream
    report: TiledSimplifyReport


@dataclass(frozen=True, eq=False)
class TiledDistilled:
    """A distilled scene in tiles, with its unrecovered version and its scores."""

    splats: PartsStream
    simplified: PartsStream
    scores: TiledScores


@dataclass(eq=False)
class TiledJob:
    """A prepared distillation in tiles: everything is decided.

    Targets are the dense scene's own renders.

    Args:
        sample: of the dense scene.
        recovers: whether anything is recovered, or only scored.
        began: when the preparation began.
        around: visibility of the dense tiles, once they have been seen.
    """

    tiles: Tiles
    budget: ResolvedBudget
    sample: Splats
    views: RunViews
    config: DistillConfig
    recovers: bool
    began: float
    say: Say = unsaid
    around: Sights | None = None
    targets = None
    photos = ()

    @property
    def total(self) -> int:
        """Gaussians of the dense scene."""
        return self.tiles.plan.count

    @property
    def dense(self) -> TileStore:
        """The dense scene."""
        return self.tiles.written

    def is_kept(self, count: int) -> bool:
        """Return False: all is recovered in tiles."""
        return False

    def steps(self, count: int) -> int:
        """Return the steps of a recovery of the whole scene."""
        recover = self.config.recover
        needed = recover.final_steps(self.sample, self.views.train.cameras, of_photos=False)
        return needed if recover.steps is not None else round(needed * pool_times(self.total))

    def run(self, work: Path | None = None) -> TiledDistilled:
        """Distil the scene; finished steps are in the folder of its workers."""
        return self._reduced(self.tiles.written, self.budget.count, self.views)

    def level(
        self, finer: TileStore, count: int, views: RunViews, work: Path | None = None
    ) -> tuple[TileStore, TileStore, float, float | None]:
        """Make a level of detail, see `g2ard.jobs.levels.LevelsJob`."""
        done = self._reduced(finer, count, views)
        merged = self._stored(done.simplified, "merged")
        if not self.recovers:
            return merged, merged, done.scores.simplified, None
        return self._stored(done.splats, "level"), merged, done.scores.simplified, done.scores.recovered

    def report(self, done: TiledDistilled, file: Path) -> TiledReport:
        """Describe the run."""
        return TiledReport(
            input_count=self.total,
            output_count=len(done.splats),
            tiles=list(done.splats.counts),
            notes={note.code: note.count for note in self.tiles.written.notes},
            seconds={"total": time.monotonic() - self.began},
            peak_rss_bytes=peak_rss_of_all(),
            scores=done.scores,
            size=self.views.test.size_text,
            views={"train": len(self.views.train.cameras), "test": len(self.views.test)},
        )

    def _reduced(self, store: TileStore, count: int, views: RunViews) -> TiledDistilled:
        """Simplify the dense scene or one derived from it, recover it unless nothing is, and score it."""
        seen = views if self.recovers else self.views
        run = self.tiles.run(self.config.simplify, store)
        small = simplify_tiles(run, count, seen.train.cameras, gaps=not self.recovers)
        say_gaps(small.opacity_lost, self.say)
        self.around = self.around or small.sights  # the first is made from the dense scene itself
        assert self.around is not None  # views are given
        dense = self.tiles.written
        student = self._stored(small.splats, "student", like=dense)
        steps = replace(self, views=views).steps(count) if self.recovers else 0
        splats, scores = recover_tiles(
            dense, student, self.around, views, self.config.recover, steps, run.workers
        )
        return TiledDistilled(splats, small.splats, scores)

    def _stored(self, scene: PartsStream, name: str, like: TileStore | None = None) -> TileStore:
        """Write a derived scene in tiles of its own, or in those of another."""
        folder = self.tiles.tiling.folder / f"{name}-{scene.identity()[0]}"
        return ingest(scene, folder, tile_rows=self.tiles.tiling.most_rows, like=like)


def prepare_tiles(
    tiles: Tiles,
    budget: Budget,
    options: DistillOptions,
    *,
    recovers: bool,
    began: float,
    progress: Progress,
    say: Say,
) -> TiledJob:
    """Decide everything that a distillation in tiles needs.

    Args:
        options: as for `g2ard.distill`, without what `needs_whole` returns.
    """
    total = tiles.plan.count
    if budget.bytes is None:
        budget.of(total, str(tiles.source))  # refused before any work
    sample = tiles.sample(options.config.simplify)
    degree = options.config.recover.sh_degree
    stored = sample if degree is None else sample.with_sh_degree(degree)
    wanted = resolved_in_tiles(budget, total, stored, str(tiles.source), f"scene.{options.format}", say)
    say_regions(sample, options.config.simplify, "a sample of the scene", unsaid)
    views = views_of(
        sample,
        options,
        wanted.count,
        beside=options.beside or tiles.source.path,
        use="tiles" if recovers else "merging",
        represents=total / len(sample),
        progress=progress,
        say=say,
    )
    regularizers, why, _ = regularizers_for(options.named("recover.regularizers"), sample)
    config = options.configured(regularizers)
    if recovers:
        say(Detail(f"regularisers: {why}"))
        weights = draw_weights(sample, views.train, config, progress)  # as in one piece
        views = replace(views, train=replace(views.train, weights=weights))
    return TiledJob(tiles, wanted, sample, views, config, recovers, began, say)
