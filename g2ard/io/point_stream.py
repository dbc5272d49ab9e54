"""Coloured point clouds in blocks, for clouds larger than memory."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.io.paths import file_identity
from g2ard.io.sanitize import RowTally
from g2ard.io.stream import from_row
from g2ard.io.types import Cloud, Note, Points

_ROWS_AT_ONCE = 1 << 20

RawPoints = tuple[NDArray[np.float64], NDArray[np.float32]]
"""(n, 3) positions, world units, and (n, 3) colours; colours / `divisor` are in [0, 1]."""


@dataclass
class PointTally(RowTally):
    """Counts over the rows read so far."""

    brightest: float = 0.0

    def finite(self, points: RawPoints) -> NDArray[np.bool_]:
        """Return an (n,) mask of the finite rows, and count them."""
        good = np.all(np.isfinite(points[0]), axis=1) & np.all(np.isfinite(points[1]), axis=1)
        self.count(good)
        self.brightest = max(self.brightest, float(np.max(points[1], where=good[:, None], initial=0.0)))
        return good


class PointStream(ABC):
    """Coloured point cloud that can be read from any row.

    Attributes:
        path: path for messages.
        count: points in the source, including those that will be dropped.
        offset: (3,) float64 origin for which float32 can represent the positions.
        tally: counts over the points that `blocks` has read.
    """

    def __init__(self, path: Path, count: int, offset: NDArray[np.float64]) -> None:
        self.path, self.count, self.offset, self.tally = path, count, offset, PointTally()

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        """Yield the source's points from `start`, at most `rows` at a time."""

    @property
    def divisor(self) -> float:
        """The divisor of colours, known once `blocks` has finished."""
        return 1.0

    def notes(self) -> tuple[Note, ...]:
        """Return notes other than on non-finite points."""
        return ()

    def identity(self) -> list[Any]:
        """Return JSON that identifies this source."""
        return file_identity([self.path])

    def blocks(self, rows: int, start: int = 0) -> Iterator[RawPoints]:
        """Yield the finite points from `start`."""
        for points in self.raw(rows, start):
            good = self.tally.finite(points)
            yield points if good.all() else (points[0][good], points[1][good])

    def all_notes(self) -> tuple[Note, ...]:
        """Return all notes once `blocks` has finished; raise an `InputError` if no point is finite."""
        return (*self.notes(), *self.tally.dropped_notes(self.path, "point"))

    def whole(self) -> Cloud:
        """Read all points, with colours in [0, 1]."""
        positions, colors, kept = np.empty((self.count, 3)), np.empty((self.count, 3), np.float32), 0
        for block in self.blocks(_ROWS_AT_ONCE):
            rows = slice(kept, kept := kept + len(block[0]))
            positions[rows], colors[rows] = block
        notes = self.all_notes()
        return Cloud(Points(positions[:kept], np.clip(colors[:kept] / np.float32(self.divisor), 0, 1)), notes)


def cloud_middle(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centre of a cloud's bounds in whole units, or zero for a cloud around the origin."""
    middle = (low + high) / 2
    far = np.abs(middle) > np.linalg.norm(high - low)
    return np.where(np.isfinite(middle).all() and far.any(), np.rint(middle), 0.0)


class WholeCloud(PointStream):
    """Point cloud in memory."""

    def __init__(self, path: Path, positions: NDArray[np.float64], colors: NDArray[np.float32]) -> None:
        self._positions, self._colors = positions, colors
        at = positions[np.isfinite(positions).all(axis=1)]
        bounds = (at.min(axis=0), at.max(axis=0)) if len(at) else np.zeros((2, 3))
        super().__init__(path, len(positions), cloud_middle(*bounds))

    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        for first in range(start, self.count, rows):
            yield self._positions[first : first + rows], self._colors[first : first + rows]


class JoinedClouds(PointStream):
    """Several point clouds as one, with colours scaled to [0, 1]."""

    def __init__(self, streams: list[PointStream]) -> None:
        super().__init__(streams[0].path, sum(s.count for s in streams), streams[0].offset)
        self._streams = streams
        self._divisors: dict[int, float] = {}

    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        for number, begin in from_row([stream.count for stream in self._streams], start):
            divisor = self._divisor(number, rows)
            for positions, colors in self._streams[number].raw(rows, begin):
                yield positions, colors / np.float32(divisor)

    def _divisor(self, number: int, rows: int) -> float:
        """Return a file's divisor, which takes an additional pass over its points."""
        if number not in self._divisors:
            stream = self._streams[number]
            stream.tally = PointTally()
            for points in stream.raw(rows, 0):
                stream.tally.finite(points)
            self._divisors[number] = stream.divisor
        return self._divisors[number]

    def notes(self) -> tuple[Note, ...]:
        return tuple(replace(n, text=f"{s.path}: {n.text}") for s in self._streams for n in s.notes())

    def identity(self) -> list[Any]:
        return [stream.identity() for stream in self._streams]
