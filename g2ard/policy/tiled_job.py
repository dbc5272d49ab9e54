"""Distillation of scenes larger than memory, all decided: views, constants, and where tasks run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.policy.tile_memory import RECOVERY_TIMES
from g2ard.policy.tiled import Tiling, cores_of, tiles_of, workers_for
from g2ard.progress import Progress, Say, silent, unsaid

if TYPE_CHECKING:
    from g2ard.policy.distill_options import DistillOptions
    from g2ard.policy.views import RunViews
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.stages.recover import RecoverConfig
    from g2ard.stages.simplify import SimplifyConfig
    from g2ard.tiles.executor import Executor
    from g2ard.tiles.recover import TiledScores
    from g2ard.tiles.sights import Surroundings
    from g2ard.tiles.simplify import TiledScene
    from g2ard.tiles.store import TileStore

__all__ = ["TiledJob", "resized", "tiled_job"]


@dataclass(frozen=True, eq=False)
class TiledJob:
    """What is to be done, and where.

    Args:
        store: the dense scene in tiles.
        sample: a fair sample of it.
        views: what is looked at.
        config: of recovery.
        merging: of simplification.
        steps: of a recovery of all that were asked for; None for as many as it needs.
        executor: runs the tasks.
        folder: keeps what is done.
        tile_rows: Gaussians of a tile at the most.
        seed: of all that is random.
        progress: told of tasks.
        say: told in lines what was decided.
    """

    store: TileStore
    sample: Splats
    views: RunViews
    config: RecoverConfig
    merging: SimplifyConfig
    steps: int | None
    executor: Executor
    folder: Path
    tile_rows: int
    seed: int
    progress: Progress
    say: Say

    def simplified(self, store: TileStore, count: int, cameras: Cameras) -> TiledScene:
        """A scene in tiles, this one or what came of it, at a budget."""
        from g2ard.tiles.simplify import simplify_tiles

        return simplify_tiles(
            store,
            count,
            executor=self.executor,
            work=self.folder / "steps",
            config=self.merging,
            views=cameras,
            seed=self.seed,
            progress=self.progress,
            say=self.say,
        )

    def recovered(
        self, small: TiledScene, around: Surroundings, views: RunViews, *, learn: bool = True
    ) -> tuple[TiledScene, TiledScores]:
        """A simplified scene after recovery, or if nothing is to be learned as it is, with its scores."""
        from g2ard.policy.views import pool_times
        from g2ard.stages.recover.need import steps_for
        from g2ard.tiles.recover import recover_tiles

        needed = steps_for(self.sample, views.train.cameras, self.config.schedule.steps)
        steps = self.steps or round(needed * pool_times(self.store.count))
        return recover_tiles(
            self.store,
            self.stored(small, "student", like=self.store),
            around,
            views,
            self.config,
            steps if learn else 0,
            executor=self.executor,
            work=self.folder / "steps",
            progress=self.progress,
        )

    def stored(self, scene: TiledScene, name: str, like: TileStore | None = None) -> TileStore:
        """A scene that came of tasks in tiles of its own, or in those of another."""
        from g2ard.tiles.ingest import ingest

        folder = self.folder / f"{name}-{scene.key}"
        return ingest(scene.stream(), folder, tile_rows=self.tile_rows, like=like)


@contextmanager
def tiled_job(
    scene: Path,
    tiling: Tiling,
    options: DistillOptions,
    *,
    learn: bool = True,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[TiledJob]:
    """Decide all that a distillation in tiles needs; tasks run while it lasts.

    Args:
        scene: its file, or a folder of tiles.
        tiling: how; `folder` keeps what is done, so that the same call goes on.
        options: as for `g2ard.distill`, those that `g2ard.policy.whole` refuses left out.
        learn: whether anything is recovered, not just scored.
        progress: told of tasks.
        say: told in lines what was decided.

    Raises:
        InputError: a scene or views that cannot be read, or too little memory for a tile.
    """
    from g2ard.config.constants import changed, full_names
    from g2ard.policy.views import views_of
    from g2ard.scene.regions import as_regions
    from g2ard.stages.recover import RecoverConfig
    from g2ard.stages.recover.presets import preset_for
    from g2ard.stages.recover.schedule import schedule_named
    from g2ard.stages.simplify import SimplifyConfig
    from g2ard.tiles.executor import executor
    from g2ard.tiles.simplify import sample_of

    assert tiling.folder is not None
    with tiles_of(scene, tiling, progress, say) as store:
        workers = workers_for(store, tiling, RECOVERY_TIMES)
        threads = max(1, cores_of(tiling) // workers)
        say(f"{len(store.tiles):,} tiles of {store.count:,} Gaussians, {workers} at a time")
        with executor(workers, threads, tiling.scheduler) as runs:
            sample = sample_of(store, runs, tiling.folder / "steps", progress)
            views = views_of(
                sample,
                options.views,
                options.held_out,
                beside=options.beside or scene,
                size=options.size,
                up=options.up,
                seed=options.seed,
                represents=store.count / len(sample),
                progress=progress,
                say=say,
            )
            regularizers, why, _ = preset_for(options.preset, sample)
            if learn:
                say(f"regularisers: {why}")
            config = RecoverConfig(
                schedule=schedule_named(options.schedule or "default", options.steps),
                regularizers=regularizers,
                background=options.background,
                sh_degree=options.sh_degree,
                seed=options.seed,
            )
            merging = SimplifyConfig(keep_region=as_regions(options.keep_region))
            constants = full_names(options.constants or {}, {"recover": config, "simplify": merging})
            yield TiledJob(
                store=store,
                sample=sample,
                views=views,
                config=changed(config, "recover", constants),
                merging=changed(merging, "simplify", constants),
                steps=options.steps,
                executor=runs,
                folder=tiling.folder,
                tile_rows=tiling.most_rows,
                seed=options.seed,
                progress=progress,
                say=say,
            )


def resized(views: RunViews, longest: int) -> RunViews:
    """The same views, shrunk."""
    apart = views.apart and views.apart.resized(longest)
    return replace(views, train=views.train.resized(longest), test=views.test.resized(longest), apart=apart)
