"""Coloured clouds read block by block, so that memory does not bound their size."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.stream import file_identity
from g2ard.io.types import Note
from g2ard.progress import plural

__all__ = ["PointStream", "PointTally", "RawPoints", "cloud_middle", "open_point_stream"]

_STREAMED = {"cloud_ply": "cloud_ply", "las": "las"}
"""Format → the module with its `stream(path)`; clouds of other formats are held as a whole."""

RawPoints = tuple[NDArray[np.float64], NDArray[np.float32]]
"""(n, 3) positions, world units, and (n, 3) colours as stored: in [0, 1] once divided by `divisor`."""


@dataclass
class PointTally:
    """What was met in the rows so far."""

    rows: int = 0
    dropped: int = 0
    first: int = -1
    brightest: float = 0.0

    def finite(self, points: RawPoints) -> NDArray[np.bool_]:
        """(n,) which of the next rows are to be kept."""
        good = np.all(np.isfinite(points[0]), axis=1) & np.all(np.isfinite(points[1]), axis=1)
        lost = len(good) - int(np.count_nonzero(good))
        if lost and not self.dropped:
            self.first = self.rows + int(np.argmin(good))
        self.dropped += lost
        self.rows += len(good)
        self.brightest = max(self.brightest, float(np.max(points[1], where=good[:, None], initial=0.0)))
        return good


class PointStream(ABC):
    """A coloured cloud as a sequence of points, any part of which can be read again.

    Attributes:
        path: names the cloud in messages.
        count: points in the source, those that will be dropped included.
        offset: (3,) float64, what positions should be relative to, so that float32 holds them.
        tally: counts over the points that `blocks` has been through.
    """

    def __init__(self, path: Path, count: int, offset: NDArray[np.float64]) -> None:
        self.path, self.count, self.offset, self.tally = path, count, offset, PointTally()

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        """The source's points from `start` on, at most `rows` at a time."""

    @property
    def divisor(self) -> float:
        """What colours are to be divided by, known once `blocks` is through."""
        return 1.0

    def notes(self) -> tuple[Note, ...]:
        """What was noticed beside points that are not finite."""
        return ()

    def identity(self) -> list[Any]:
        """What tells this source from another, as JSON."""
        return file_identity([self.path])

    def blocks(self, rows: int, start: int = 0) -> Iterator[RawPoints]:
        """All points from `start` on that are finite."""
        for points in self.raw(rows, start):
            good = self.tally.finite(points)
            yield points if good.all() else (points[0][good], points[1][good])

    def all_notes(self) -> tuple[Note, ...]:
        """What was noticed, once `blocks` is through.

        Raises:
            InputError: there was no point, or none that is finite.
        """
        tally = self.tally
        if not tally.rows:
            raise InputError(f"{self.path}: holds no points")
        if tally.dropped == tally.rows:
            raise InputError(f"{self.path}: none of its {plural(tally.rows, 'point')} is finite")
        if not tally.dropped:
            return self.notes()
        text = f"{plural(tally.dropped, 'non-finite point')} dropped (the first is row {tally.first})"
        return (*self.notes(), Note("dropped_rows", tally.dropped, text))


def open_point_stream(path: str | Path | Sequence[str | Path]) -> PointStream:
    """A cloud, or several as one, to be read block by block.

    Args:
        path: a cloud in any format that `g2ard.io.read_cloud` reads, or several. Of .ply, .las and .laz
            (COPC is one) a block at a time is held, of others all. Several take the offset of the first.

    Raises:
        InputError: nothing is there, or it is broken as far as its header tells.
        MissingDependencyError: .las or .laz without `pip install g2ard[las]`.
    """
    from g2ard.io.detect import file_format

    if not isinstance(path, str | Path):
        streams = [open_point_stream(part) for part in path]
        if not streams:
            raise InputError("no cloud was given")
        return streams[0] if len(streams) == 1 else _Joined(streams)
    path, found = Path(path), file_format(path)
    if found in _STREAMED:
        stream: PointStream = import_module(f"g2ard.io.{_STREAMED[found]}").stream(path)
        return stream
    return _Whole(path)


def cloud_middle(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """The whole-unit middle of a cloud's bounds; zero where the cloud lies around the origin as it is."""
    middle = (low + high) / 2
    far = np.abs(middle) > np.linalg.norm(high - low)
    return np.where(np.isfinite(middle).all() and far.any(), np.rint(middle), 0.0)


class _Whole(PointStream):
    """A cloud that is held as a whole."""

    def __init__(self, path: Path) -> None:
        from g2ard.io import read_cloud

        self._cloud = read_cloud(path)
        at = self._cloud.points.positions
        super().__init__(path, len(at), cloud_middle(at.min(axis=0), at.max(axis=0)))

    def identity(self) -> list[Any]:
        files = sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]
        return file_identity([file for file in files if file.is_file()])

    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        points = self._cloud.points
        for first in range(start, self.count, rows):
            at = slice(first, first + rows)
            yield points.positions[at], points.colors[at]

    def notes(self) -> tuple[Note, ...]:
        return self._cloud.notes


class _Joined(PointStream):
    """Several clouds, one after the other; each one's colours are brought to [0, 1] as they are read."""

    def __init__(self, streams: list[PointStream]) -> None:
        super().__init__(streams[0].path, sum(s.count for s in streams), streams[0].offset)
        self._streams = streams
        self._divisors: list[float | None] = [None] * len(streams)

    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        for number, stream in enumerate(self._streams):
            if start < stream.count:
                divisor = self._divisor(number, rows)
                for positions, colors in stream.raw(rows, start):
                    yield positions, colors / np.float32(divisor)
            start = max(0, start - stream.count)

    def _divisor(self, number: int, rows: int) -> float:
        """A file's divisor is known after its last point: it is read once more for that alone."""
        known = self._divisors[number]
        if known is None:
            stream = self._streams[number]
            stream.tally = PointTally()
            for points in stream.raw(rows, 0):
                stream.tally.finite(points)
            known = self._divisors[number] = stream.divisor
        return known

    def notes(self) -> tuple[Note, ...]:
        return tuple(replace(n, text=f"{s.path}: {n.text}") for s in self._streams for n in s.notes())

    def identity(self) -> list[Any]:
        return [stream.identity() for stream in self._streams]
