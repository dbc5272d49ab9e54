"""Scenes and coloured point clouds in blocks, for files larger than memory."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import RenderModel
from g2ard.io.paths import file_identity
from g2ard.io.sanitize import BLOCK, Raw, Tally
from g2ard.io.types import Cloud, Note, Points, Scene
from g2ard.scene.splats import ARRAYS, Splats
from g2ard.scene.transform import one_model

_DEGREE_OF_REST = {0: 0, 3: 1, 8: 2, 15: 3}
_POINTS_AT_ONCE = 1 << 20

RawPoints = tuple[NDArray[np.float64], NDArray[np.float32]]
"""(n, 3) positions, world units, and (n, 3) colours; colours / `divisor` are in [0, 1]."""

MarkedPoints = tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.bool_]]
"""Positions, colours, and an (n,) mask of points that the file marks as noise."""

_FULL = (255.0, 65535.0)  # largest colours of 8 and 16 bits
_FAR = 10.0  # distance from the origin, in extents, beyond which coordinates may be those of a map
_STEEP = 20.0  # extent in z over that in x and y beyond which x and y may be degrees

Block = TypeVar("Block", Splats, RawPoints)


class Stream(ABC, Generic[Block]):
    """Source of Gaussians or points that can be read from any row.

    Attributes:
        path: path for messages.
        count: rows in the source, including those that will be dropped.
        offset: (3,) float64, world = position + offset, where float32 can represent the positions.
        notes: notes on the header.
        tally: counts over the rows that `blocks` has read.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        offset: NDArray[np.float64] | None,
        notes: tuple[Note, ...] = (),
        item: str = "Gaussian",
    ) -> None:
        self.path, self.count, self.notes, self.tally = path, count, notes, Tally(item)
        self.offset = np.zeros(3) if offset is None else offset

    def identity(self) -> list[Any]:
        """Return JSON that identifies this source, see `file_identity`."""
        return file_identity([self.path])

    @abstractmethod
    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        """Yield the (n, 3) positions of all rows in blocks, relative to `offset`, without cleaning."""

    @abstractmethod
    def blocks(self, rows: int, start: int = 0) -> Iterator[Block]:
        """Yield rows from `start` in blocks of at most `rows`, without those that are not finite."""

    def header_notes(self) -> tuple[Note, ...]:
        """Return notes other than on rows, known once `blocks` has finished."""
        return self.notes

    def all_notes(self) -> tuple[Note, ...]:
        """Return all notes once `blocks` has finished; raise an `InputError` if no row is finite."""
        return (*self.header_notes(), *self.tally.notes(self.path))


class SceneStream(Stream[Splats]):
    """Scene in blocks.

    Attributes:
        sh_degree: 0–3.
        render_model: see `Splats`; may be changed before reading.
        up: the up direction that the source states.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        rest: int = 0,
        offset: NDArray[np.float64] | None = None,
        notes: tuple[Note, ...] = (),
        render_model: RenderModel = "classic",
    ) -> None:
        super().__init__(path, count, offset, notes)
        self.render_model, self.sh_degree = render_model, _DEGREE_OF_REST[rest]
        self.up: tuple[float, float, float] | None = None

    def whole(self) -> Scene:
        """Read all rows into memory."""
        raw, kept = Raw.empty(self.count, (self.sh_degree + 1) ** 2 - 1), 0
        for block in self.blocks(BLOCK):
            rows = raw.take(slice(kept, kept := kept + len(block)))
            rows.fill(getattr(block, name) for name in ARRAYS)
        notes = self.all_notes()
        return Scene(raw.take(slice(kept)).activated(self.render_model, self.offset, self.up), notes)


class RawStream(SceneStream):
    """Scene of a file's `raw` rows, which are cleaned as in `g2ard.io.read_scene`."""

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        """Yield the source's rows from `start`, at most `rows` at a time; callers may change the arrays."""

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        return (raw.means for raw in self.raw(rows, 0))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for raw in self.raw(rows, start):
            before, keep = self.tally.dropped, self.tally.clean(raw)
            splats = raw.activated(self.render_model, self.offset)
            yield splats if self.tally.dropped == before else splats.take(keep)


class PartsStream(SceneStream):
    """Scene of clean parts that `part` loads by index, one at a time."""

    def __init__(
        self,
        path: Path,
        counts: Sequence[int],
        part: Callable[[int], Splats],
        sh_degree: int,
        offset: NDArray[np.float64],
        identity: list[Any],
        notes: tuple[Note, ...] = (),
        render_model: RenderModel = "classic",
    ) -> None:
        super().__init__(path, sum(counts), (sh_degree + 1) ** 2 - 1, offset, notes, render_model)
        self._counts, self._part, self._identity = counts, part, identity

    def identity(self) -> list[Any]:
        return self._identity

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        return (self._part(number).means for number in range(len(self._counts)))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for number, begin in from_row(self._counts, start):
            part = replace(self._part(number), render_model=self.render_model)
            for first in range(begin, len(part), rows):
                block = part.take(slice(first, first + rows))
                self.tally.add(block)
                yield block

    def all_notes(self) -> tuple[Note, ...]:
        return self.notes


def full_scales(kind: np.dtype[Any]) -> tuple[float, ...]:
    """Return the values, ascending, that colours stored as a type may have at full brightness.

    >>> full_scales(np.dtype("u1")), full_scales(np.dtype("i4")), full_scales(np.dtype("f8"))
    ((255.0,), (255.0, 65535.0, 2147483647.0), (1.0, 255.0, 65535.0))
    """
    if kind.kind == "f":
        return (1.0, *_FULL)
    most = float(np.iinfo(kind).max)
    return (*(full for full in _FULL if full < most), most)


class PointStream(Stream[RawPoints]):
    """Coloured point cloud in blocks.

    Colours are divided by the smallest of `full_scales` that holds the brightest, whatever their type.
    """

    def __init__(
        self, path: Path, count: int, sample: NDArray[np.float64], scales: Sequence[float] = (1.0,)
    ) -> None:
        """Open a cloud, whose centre becomes the offset if it is far from the origin.

        The (n, 3) sample is of all parts of the cloud, since files' own bounds may be wrong.
        """
        finite = sample[np.isfinite(sample).all(axis=1)]
        low, high = np.percentile(finite, (1, 99), axis=0) if len(finite) else np.zeros((2, 3))
        middle, extent = (low + high) / 2, high - low
        far = np.isfinite(middle).all() and (np.abs(middle) > np.linalg.norm(extent)).any()
        notes = (_DEGREES,) if _in_degrees(middle, extent) else ()
        super().__init__(path, count, np.rint(middle) if far else None, notes, "point")
        self.scales = scales

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        """Yield the source's points from `start`, at most `rows` at a time."""

    @property
    def divisor(self) -> float:
        """The divisor of colours, known once `blocks` has finished."""
        brightest = self.tally.brightest
        fits = (full for full in self.scales if brightest <= full * (1.5 if full == 1 else 1.001))
        return next(fits, self.scales[-1])

    def header_notes(self) -> tuple[Note, ...]:
        notes, rows = list(self.notes), self.tally.rows
        if rows and self.tally.brightest <= 0:
            text = "all colours are 0; add colours, for example with PDAL's filters.colorization"
            notes.append(Note("black", rows, text))
        elif rows and self.divisor == _FULL[0] < self.scales[-1]:
            notes.append(Note("eight_bit_colors", rows, "colours up to 255 in fields of a larger range"))
        return tuple(notes)

    def near(self, positions: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return positions relative to `offset`."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (positions - self.offset).astype(np.float32)

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        for positions, _, noise in self.raw(rows, 0):
            near = self.near(positions)
            near[noise] = np.nan
            yield near

    def blocks(self, rows: int, start: int = 0) -> Iterator[RawPoints]:
        for positions, colors, noise in self.raw(rows, start):
            good = self.tally.keep(positions, colors, noise)
            yield (positions, colors) if good.all() else (positions[good], colors[good])

    def whole(self) -> Cloud:
        """Read all points, with colours in [0, 1]."""
        positions, colors, kept = np.empty((self.count, 3)), np.empty((self.count, 3), np.float32), 0
        for block in self.blocks(_POINTS_AT_ONCE):
            rows = slice(kept, kept := kept + len(block[0]))
            positions[rows], colors[rows] = block
        notes = self.all_notes()
        return Cloud(Points(positions[:kept], np.clip(colors[:kept] / np.float32(self.divisor), 0, 1)), notes)


_DEGREES = Note(
    "degrees",
    1,
    "x and y look like degrees of longitude and latitude, and z like metres; project them to metres, for "
    "example with `pdal translate IN OUT reprojection --filters.reprojection.out_srs=EPSG:32633`",
)


def _in_degrees(middle: NDArray[np.float64], extent: NDArray[np.float64]) -> bool:
    """Return whether x and y may be degrees, z metres: far from 0, and of much smaller extent than z."""
    wide = float(extent[:2].max())
    on_globe = (np.abs(middle[:2]) <= 180).all() and np.abs(middle[:2]).min() <= 90
    return bool(on_globe and np.abs(middle[:2]).max() > _FAR * wide and extent[2] > _STEEP * wide)


class Joined(Stream[Block]):
    """Several sources as one, with the offset of the first."""

    streams: Sequence[Stream[Block]]

    def identity(self) -> list[Any]:
        return [stream.identity() for stream in self.streams]

    def header_notes(self) -> tuple[Note, ...]:
        return tuple(replace(n, text=f"{s.path}: {n.text}") for s in self.streams for n in s.header_notes())


class JoinedScenes(Joined[Splats], SceneStream):
    """Several scenes as one, with the highest of their SH degrees."""

    streams: Sequence[SceneStream]

    def __init__(self, streams: Sequence[SceneStream]) -> None:
        self.streams, rest = streams, (max(stream.sh_degree for stream in streams) + 1) ** 2 - 1
        count, model = sum(s.count for s in streams), one_model([s.render_model for s in streams])
        SceneStream.__init__(self, streams[0].path, count, rest, streams[0].offset, render_model=model)
        ups = {stream.up for stream in streams}
        self.up = ups.pop() if len(ups) == 1 else None

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        for stream in self.streams:
            for means in stream.positions(rows):
                yield self._moved(means, stream.offset)

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for number, begin in from_row([stream.count for stream in self.streams], start):
            stream = self.streams[number]
            stream.tally = self.tally
            for block in stream.blocks(rows, begin):
                means = self._moved(block.means, stream.offset)
                yield replace(block.with_sh_degree(self.sh_degree), means=means, offset=self.offset)

    def _moved(self, means: NDArray[np.float32], offset: NDArray[np.float64]) -> NDArray[np.float32]:
        shift = offset - self.offset
        return (means + shift).astype(np.float32) if shift.any() else means


class JoinedClouds(Joined[RawPoints], PointStream):
    """Several point clouds as one, with colours scaled to [0, 1]."""

    streams: Sequence[PointStream]

    def __init__(self, streams: Sequence[PointStream]) -> None:
        self.streams, self._divisors = streams, dict[int, float]()
        Stream.__init__(self, streams[0].path, sum(s.count for s in streams), streams[0].offset, item="point")

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for number, begin in from_row([stream.count for stream in self.streams], start):
            divisor = self._divisor(number, rows)
            for positions, colors, noise in self.streams[number].raw(rows, begin):
                yield positions, colors / np.float32(divisor), noise

    def _divisor(self, number: int, rows: int) -> float:
        """Return a file's divisor, which takes an additional pass over its points."""
        if number not in self._divisors:
            stream = self.streams[number]
            stream.tally = Tally("point")
            for points in stream.raw(rows, 0):
                stream.tally.keep(*points)
            self._divisors[number] = stream.divisor
        return self._divisors[number]

    @property
    def divisor(self) -> float:
        return 1.0


def from_row(counts: Sequence[int], start: int) -> Iterator[tuple[int, int]]:
    """Yield the index and the first row of each part that ends after row `start` of all parts."""
    for number, count in enumerate(counts):
        if start < count:
            yield number, start
        start = max(0, start - count)
