"""The dense scene that a command works on: in memory, or streamed into tiles if it is large."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from g2ard.errors import InputError
from g2ard.io.sanitize import BLOCK
from g2ard.io.source import Source
from g2ard.io.stream import PointStream, SceneStream
from g2ard.io.types import Note, ViewSet
from g2ard.jobs.memory import TilePlan, plan_tiles
from g2ard.jobs.tile_options import Tiling
from g2ard.pipeline.dense import Dense, InMemory
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.lift import LiftConfig, lift
from g2ard.stages.simplify import SimplifyConfig
from g2ard.tiles.simplify import sample_stride

if TYPE_CHECKING:
    from g2ard.jobs.budget import Budget


@dataclass(eq=False)
class Planned(InMemory):
    """A scene in tiles that are only planned: a sample, and the number of all its Gaussians.

    Args:
        tile_rows: most Gaussians of a tile.
    """

    count: int = 0
    tile_rows: int = 0

    @property
    def most_rows(self) -> float:  # type: ignore[override]
        """Largest count that is merged into memory."""
        return self.tile_rows

    @property
    def total(self) -> int:
        """Number of Gaussians."""
        return self.count


@dataclass(frozen=True, eq=False)
class Opened:
    """A dense scene in tiles.

    Args:
        plan: of its tiles.
        notes: on its file, once it has been read.
        views: for points with photos, those to learn from and those to score.
    """

    dense: Dense
    plan: TilePlan
    notes: tuple[Note, ...] = ()
    views: tuple[ViewSet, Cameras] | None = None


@contextmanager
def open_tiles(
    source: Source,
    tiling: Tiling,
    times: float,
    config: SimplifyConfig,
    lifting: LiftConfig | None = None,
    *,
    budgets: Sequence[Budget] = (),
    planned: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[Opened]:
    """Open the tiles of a scene, streamed into `tiling.folder` if it is a file, and start workers.

    Args:
        source: a scene, a point cloud, which is lifted tile by tile, or tiles.
        tiling: how. Tiles of another size are replaced unless the user named the folder.
        times: memory of a tile relative to merging it.
        config: of merges.
        lifting: how points are lifted.
        budgets: rejected before tiles are written if these cannot have so many Gaussians or so few.
        planned: only plan this; nothing is written.
    """
    from g2ard.tiles.dense import InTiles
    from g2ard.tiles.executor import Executor, Workers, executor
    from g2ard.tiles.ingest import ingest

    of_points = source.kind != "splats"
    store = None if of_points else source.store
    model = source.render_model
    if store is not None and model not in (None, store.render_model):
        raise InputError(
            f"these tiles are {store.render_model}",
            path=source.path,
            hint=f"run `g2ard ingest --render-model {model}` on their scene",
        )
    stream = source.cloud() if of_points else source.scene

    def running(plan: TilePlan) -> AbstractContextManager[Executor]:
        return executor(plan.workers, max(1, tiling.usable_cores // plan.workers), tiling.scheduler)

    name = str(source)
    plan = plan_tiles(store or stream, tiling, times)
    _check_budgets(budgets, plan, name)
    if store is None and not planned:
        with running(plan) as runs:
            store = ingest(
                source,
                tiling.folder / "tiles",
                tile_rows=tiling.most_rows,
                lift=lifting,
                overwrite=tiling.overwrite,
                runs=runs,
                progress=progress,
                say=say,
            )
        plan = plan_tiles(store, tiling, times)
        _check_budgets(budgets, plan, name)
    say(f"{plan.tiles:,} tiles of {plan.count:,} Gaussians, {plan.workers} at a time")
    if planned or store is None:
        yield Opened(
            Planned(_sample_stream(stream, lifting), count=plan.count, tile_rows=tiling.most_rows),
            plan,
        )
        return
    with running(plan) as runs:
        workers = Workers(runs, tiling.folder / "steps", progress)
        yield Opened(
            InTiles(store, workers, config, tiling.most_rows, tiling.folder), plan, store.notes
        )


def _check_budgets(budgets: Sequence[Budget], plan: TilePlan, name: str) -> None:
    from g2ard.tiles.merging import check_reachable

    for budget in budgets:
        if not budget.is_measured:
            check_reachable(budget.of(plan.count, name), plan.tiles)


def _sample_stream(stream: SceneStream | PointStream, lifting: LiftConfig | None) -> Splats:
    """Return a sample of a scene or of a lifted cloud that is not in tiles yet."""
    stride = sample_stride(stream.count)
    read = 0
    scenes = []
    points = []
    for block in stream.blocks(BLOCK):
        rows = slice(-read % stride, None, stride)
        if isinstance(block, Splats):
            scenes.append(block.take(rows))
            read += len(block)
        else:
            points.append([array[rows] for array in block])
            read += len(block[0])
    if scenes:
        return join(scenes)
    return lift(*map(np.concatenate, zip(*points, strict=True)), **vars(lifting or LiftConfig()))
