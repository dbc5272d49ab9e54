"""Clouds into tiles: points are poured first, then lifted tile by tile with their halos around them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.io.point_stream import PointStream, PointTally
from g2ard.io.types import Note
from g2ard.progress import Progress, Say
from g2ard.scene.splats import Splats
from g2ard.stages.lift import LiftConfig, lift
from g2ard.tiles.cells import Points
from g2ard.tiles.journal import POINTS, Journal
from g2ard.tiles.pour import pour
from g2ard.tiles.store import halo_name, packed, row_width, tile_name

__all__ = ["PointFeed", "lift_tiles"]

_ROW = np.dtype([("near", "<f4", 3), ("rgb", "<f4", 3), ("far", "<f8", 3)])
"""A point: relative to the offset in float32, which decides its tile; colour as stored; world position."""

_AT_ONCE = 1 << 16
"""Rows of a lifted tile that are written at a time."""


class PointFeed:
    """A cloud's points as rows of tiles that are still to be lifted."""

    def __init__(self, stream: PointStream, config: LiftConfig) -> None:
        self._stream, self.config = stream, config
        self.path, self.count, self.offset, self.sh_degree = stream.path, stream.count, stream.offset, 0
        self.row_bytes = _ROW.itemsize
        self.room = _ROW.itemsize + 4 * row_width(0)
        self.settings: dict[str, Any] = {}

    @property
    def tally(self) -> PointTally:
        return self._stream.tally

    @tally.setter
    def tally(self, tally: PointTally) -> None:
        self._stream.tally = tally

    @property
    def divisor(self) -> float:
        """What colours are to be divided by, once all rows are read."""
        return self._stream.divisor

    def positions(self, rows: int) -> Iterator[Points]:
        for far, _ in self._stream.raw(rows, 0):
            yield self._near(far)

    def rows(self, rows: int, start: int) -> Iterator[tuple[NDArray[Any], Points]]:
        for far, colors in self._stream.blocks(rows, start):
            block = np.empty(len(far), _ROW)
            block["near"], block["rgb"], block["far"] = self._near(far), colors, far
            yield block, np.ascontiguousarray(block["near"])

    def _near(self, far: NDArray[np.float64]) -> Points:
        with np.errstate(over="ignore", invalid="ignore"):
            return (far - self.offset).astype(np.float32)

    def all_notes(self) -> tuple[Note, ...]:
        return self._stream.all_notes()

    def identity(self) -> list[Any]:
        return self._stream.identity()


def lift_tiles(
    folder: Path, key: str, feed: PointFeed, tile_rows: int, rows: int, progress: Progress, say: Say
) -> Journal:
    """Pour the points into a folder within, then lift each tile and pour what comes of it.

    Args:
        folder: there already; empty or with the journals of this very key.
        key: of the content.
        feed: the points.
        tile_rows: points of a tile at the most.
        rows: points in memory at a time while they are read.
        progress: told of points read, then of points lifted.
        say: told what was decided.

    Raises:
        InputError: the source is broken, or has no point to be kept.
        OutputError: the disk has too little room.
    """
    within, row_bytes = folder / POINTS, 4 * row_width(0)
    within.mkdir(exist_ok=True)
    points = pour(within, key, feed, tile_rows, rows, progress, say)
    feed.tally = points.tally
    journal = Journal.open(folder, row_bytes, PointTally)
    if journal is None:
        journal = Journal(folder, key, points.cells, points.margin, row_bytes, points.tally, feed.settings)
        journal.save()
    else:
        say(f"{folder}: goes on after tile {journal.next_row:,}")
    journal.cut()
    total = sum(points.tiles.rows)
    for index in range(journal.next_row, points.cells.leaves):
        splats = _lifted(points, index, feed)
        for start in range(0, len(splats), _AT_ONCE):
            part = splats.take(slice(start, start + _AT_ONCE))
            journal.add(packed(part), part.means)
        journal.next_row = index + 1
        journal.save()
        progress("lift", sum(journal.tiles.rows), total)
    shutil.rmtree(within)
    return journal


def _lifted(points: Journal, index: int, feed: PointFeed) -> Splats:
    """A tile's own points, lifted among those of its halo."""
    core = _read(points.folder / tile_name(index), points.tiles.rows[index])
    if not len(core):
        return Splats.create(np.empty((0, 3)), scales=np.empty((0, 3)))
    halo = _read(points.folder / halo_name(index), points.halos.rows[index])
    both = np.concatenate([core, halo])
    colors = np.clip(both["rgb"] / np.float32(feed.divisor), 0, 1)
    discs = lift(both["far"], colors, **vars(feed.config)).take(slice(0, len(core)))
    return replace(discs, means=np.ascontiguousarray(core["near"]), offset=feed.offset)


def _read(path: Path, count: int) -> NDArray[Any]:
    return np.fromfile(path, _ROW, count)
