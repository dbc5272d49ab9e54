"""Levels of detail of scenes larger than memory: a chain of simplifications in tiles, each recovered."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.policy.budget import Budget
from g2ard.policy.levels import LevelReport, check_ratios, level_size
from g2ard.policy.tiled import Tiling
from g2ard.policy.tiled_job import TiledJob, resized, tiled_job
from g2ard.policy.whole import refuse_whole, whole_options
from g2ard.progress import Progress, Say, plural, silent, unsaid

if TYPE_CHECKING:
    from g2ard.levels import Cut
    from g2ard.policy.distill_options import DistillOptions
    from g2ard.tiles.sights import Surroundings
    from g2ard.tiles.store import TileStore
    from g2ard.tiles.stored import StoredScene

__all__ = ["TiledLevels", "lod_in_tiles"]


@dataclass(frozen=True, eq=False)
class TiledLevels:
    """A scene's levels of detail in tiles, the finest first, and a report on each."""

    scenes: tuple[StoredScene, ...]
    reports: tuple[LevelReport, ...]

    def key(self, rule: Cut, errors: bool) -> str:
        """16 hexadecimal digits of what decides the files that they are written to."""
        from g2ard.tiles.simplify import key_of

        return key_of([[scene.store.key for scene in self.scenes], asdict(rule), errors])


def lod_in_tiles(
    scene: Path,
    ratios: Sequence[float],
    tiling: Tiling,
    options: DistillOptions,
    *,
    recover: bool = True,
    progress: Progress = silent,
    say: Say = unsaid,
) -> TiledLevels:
    """Levels of detail of a scene that does not fit into memory.

    As `g2ard.lod`: a level is merged from the one before, which lies in tiles of its own, and recovered
    against the dense scene's renders in views shrunk by √√r.

    Args:
        scene: its file, or a folder of tiles.
        ratios: how many times fewer Gaussians each level has, rising; 1 is the scene as it is.
        tiling: how; `folder` keeps what is done, so that the same call goes on.
        options: as for `g2ard.distill`; what takes the scene in one piece is refused.
        recover: optimise each level; else they are merged alone.
        progress: told of tasks.
        say: told in lines what was decided.

    Returns:
        The levels, of exactly round(N/r) Gaussians each.

    Raises:
        InputError: ratios that do not rise, or as `g2ard.policy.tiled_distill.distill_in_tiles`.
    """
    from g2ard.tiles.stored import StoredScene

    check_ratios(ratios)
    refuse_whole(scene, whole_options(options))
    levels: list[StoredScene] = []
    reports: list[LevelReport] = []
    around: Surroundings | None = None
    with tiled_job(scene, tiling, options, learn=recover, progress=progress, say=say) as job:
        finer = job.store
        for number, ratio in enumerate(ratios):
            if ratio == 1:
                size = level_size(job.views.train.cameras, 1)
                level, report = job.store, LevelReport(job.store.count, 1.0, size, 0.0)
            else:
                count = Budget(ratio=ratio).of(job.store.count, str(scene))
                say(f"level {number}: {plural(count, 'Gaussian')}")
                level, finer, around, report = _level(job, finer, around, count, ratio, recover)
            levels.append(StoredScene(level))
            reports.append(report)
    return TiledLevels(tuple(levels), tuple(reports))


def _level(
    job: TiledJob, finer: TileStore, around: Surroundings | None, count: int, ratio: float, recover: bool
) -> tuple[TileStore, TileStore, Surroundings, LevelReport]:
    """The level, the same before recovery, where the dense scene's tiles stand, and the level's report."""
    began = time.perf_counter()
    longest = level_size(job.views.train.cameras, ratio)
    views = resized(job.views, longest)
    small = job.simplified(finer, count, (views if recover else job.views).train.cameras)
    around = around or small.surroundings  # the first level is merged from the dense scene itself
    assert around is not None  # views are given
    merged = job.stored(small, "merged")
    done, scores = job.recovered(small, around, views, learn=recover)
    level = job.stored(done, "level") if recover else merged
    seconds = time.perf_counter() - began
    recovered = scores.recovered if recover else None
    return level, merged, around, LevelReport(count, ratio, longest, seconds, scores.simplified, recovered)
