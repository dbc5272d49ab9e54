"""Distillation of scenes larger than memory: views, simplification and recovery in tiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.errors import InputError
from g2ard.policy.tiled import Tiling, cores_of, tiles_of, workers_for
from g2ard.progress import Progress, Say, silent, unsaid

if TYPE_CHECKING:
    from g2ard.policy.budget import Budget
    from g2ard.policy.distill_options import DistillOptions
    from g2ard.policy.views import RunViews
    from g2ard.tiles.recover import TiledScores
    from g2ard.tiles.simplify import TiledScene
    from g2ard.tiles.store import TileStore

__all__ = ["distill_in_tiles"]

_RECOVERY_TIMES = 1.5
"""Memory of a tile's recovery, renders included, over that of merging it."""


def distill_in_tiles(
    scene: Path,
    budgets: Sequence[Budget],
    tiling: Tiling,
    options: DistillOptions,
    *,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[tuple[TileStore, TiledScene, TiledScores, RunViews]]:
    """Distil a scene that does not fit into memory: it is simplified, then recovered, tile by tile.

    Targets are the dense scene's own renders, into views that are given, found beside it or made.

    Args:
        scene: its file, or a folder of tiles.
        budgets: counts, ratios or shares.
        tiling: how.
        options: as for `g2ard.distill`; what takes the scene in one piece is refused.
        progress: told of tasks.
        say: told in lines what was decided.

    Raises:
        InputError: as `g2ard.policy.tiled.simplify_in_tiles`, or an option that tiles do not have.
    """
    from g2ard.constants import changed, full_names
    from g2ard.policy.views import pool_times, views_of
    from g2ard.regions import as_regions
    from g2ard.stages.recover import RecoverConfig
    from g2ard.stages.recover.need import steps_for
    from g2ard.stages.recover.presets import preset_for
    from g2ard.stages.recover.schedule import schedule_named
    from g2ard.stages.simplify import SimplifyConfig
    from g2ard.tiles.executor import executor
    from g2ard.tiles.recover import recover_tiles
    from g2ard.tiles.simplify import sample_of, simplify_tiles

    _refuse(scene, budgets, options)
    assert tiling.folder is not None
    work = tiling.folder / "steps"
    with tiles_of(scene, tiling, progress, say) as store:
        workers = workers_for(store, tiling, _RECOVERY_TIMES)
        threads = max(1, cores_of(tiling) // workers)
        say(f"{len(store.tiles):,} tiles of {store.count:,} Gaussians, {workers} at a time")
        with executor(workers, threads, tiling.scheduler) as runs:
            sample = sample_of(store, runs, work, progress)
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
            say(f"regularisers: {why}")
            schedule = schedule_named(options.schedule or "default", options.steps)
            config = RecoverConfig(
                schedule=schedule,
                regularizers=regularizers,
                background=options.background,
                sh_degree=options.sh_degree,
                seed=options.seed,
            )
            merging = SimplifyConfig(keep_region=as_regions(options.keep_region))
            constants = full_names(options.constants or {}, {"recover": config, "simplify": merging})
            config, merging = changed(config, "recover", constants), changed(merging, "simplify", constants)
            train = views.train.cameras
            steps = options.steps or round(steps_for(sample, train, schedule.steps) * pool_times(store.count))
            for budget in budgets:
                small = simplify_tiles(
                    store,
                    budget.of(store.count, str(scene)),
                    executor=runs,
                    work=work,
                    config=merging,
                    views=train,
                    seed=options.seed,
                    progress=progress,
                    say=say,
                )
                done, scores = recover_tiles(
                    store, small, views, config, steps, executor=runs, work=work, progress=progress
                )
                yield store, done, scores, views


def _refuse(scene: Path, budgets: Sequence[Budget], options: DistillOptions) -> None:
    """What tiles do not have."""
    usual = type(options)()
    whole = [
        name
        for name in ("clean", "photos", "views_count", "reselect", "recovery_time", "engine")
        if getattr(options, name) != getattr(usual, name)
    ]
    whole += ["method"] if options.method not in (None, "default") else []
    whole += ["preset paper"] if options.preset.startswith("paper") else []
    whole += ["schedule paper"] if options.schedule == "paper" else []
    whole += ["a budget in bytes or decibels"] if any(budget.is_measured for budget in budgets) else []
    if whole:
        raise InputError(
            f"{scene}: {whole[0].replace('_', '-')} takes the scene in one piece, not in tiles; --tile-rows "
            "above its count avoids them"
        )
