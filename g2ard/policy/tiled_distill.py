"""Distillation of scenes larger than memory: simplified, then recovered, tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.policy.tiled import Tiling
from g2ard.policy.tiled_job import tiled_job
from g2ard.policy.whole import refuse_whole, whole_budgets, whole_options
from g2ard.progress import Progress, Say, silent, unsaid

if TYPE_CHECKING:
    from g2ard.policy.budget import Budget
    from g2ard.policy.distill_options import DistillOptions
    from g2ard.policy.views import RunViews
    from g2ard.tiles.recover import TiledScores
    from g2ard.tiles.simplify import TiledScene
    from g2ard.tiles.store import TileStore

__all__ = ["distill_in_tiles"]


def distill_in_tiles(
    scene: Path,
    budgets: Sequence[Budget],
    tiling: Tiling,
    options: DistillOptions,
    *,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[tuple[TileStore, TiledScene, TiledScores, RunViews]]:
    """Distil a scene that does not fit into memory at several budgets; each is ready when it is asked for.

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
    refuse_whole(scene, [*whole_options(options), *whole_budgets(budgets)])
    with tiled_job(scene, tiling, options, progress=progress, say=say) as job:
        for budget in budgets:
            count = budget.of(job.store.count, str(scene))
            small = job.simplified(job.store, count, job.views.train.cameras)
            assert small.surroundings is not None  # views are given
            done, scores = job.recovered(small, small.surroundings, job.views)
            yield job.store, done, scores, job.views
