"""Scenes and coloured point clouds in blocks, for files larger than memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, Literal, NamedTuple, Self, TypeVar

import numpy as np

from g2ard.arrays import Float, Float32, Mask, Values
from g2ard.config.choices import Axes, RenderModel
from g2ard.errors import InputError
from g2ard.io.judge import HDR, choose_shades, choose_white, has_contrast, note_coarse, spacing
from g2ard.io.paths import file_identity
from g2ard.io.sanitize import BLOCK, Raw, Tally
from g2ard.io.types import Cloud, Note, Notes, Points
from g2ard.progress import plural
from g2ard.scene.splats import ARRAYS, Splats
from g2ard.scene.transform import change_of_axes, common_axes, one_model, restored, stand_as

_DEGREE_OF_REST = {0: 0, 3: 1, 8: 2, 15: 3}
_POINTS_AT_ONCE = 1 << 20

RawPoints = tuple[Float, Float32]
"""(n, 3) positions, world units, and (n, 3) colours in [0, 1]."""

MarkedPoints = tuple[Float, Float32, Mask]
"""(n, 3) positions; (n, 3) colours, (n, 1) intensities or (n, 0); (n,) whether the file marks noise."""

_BLACK = 1.5 / 255  # colours below are taken for none
_FEW_BLACK = 15  # number of black points up to which no note is given
_BLACK_SHARE = 1e-3  # share of black points up to which no note is given
# distance between clouds, in extents, beyond which they may be in several map systems
_APART = 100.0
_FAR = 10.0  # distance from the origin, in extents, beyond which coordinates may be those of a map
_STEEP = 20.0  # extent in z over that in x and y beyond which x and y may be degrees

Names = tuple[str, ...]

Block = TypeVar("Block", Splats, RawPoints)
Read = Literal["blocks", "positions"]


class _Mapped(NamedTuple):
    """Rows that are mapped from a file, for another process to map."""

    file: Any
    dtype: np.dtype[Any]
    offset: int
    shape: tuple[int, ...]


class Stream(ABC, Generic[Block]):
    """Source of Gaussians or points that can be read from any row.

    Attributes:
        path: path for messages.
        count: rows in the source, including those that will be dropped.
        offset: (3,) float64, world = position + offset, where float32 can represent the positions.
        notes: notes on the header.
        tally: counts over the rows that `blocks` has read.
    """

    _reading: tuple[tuple[Read, int], Iterator[Any]] | None = None
    _is_copy = False

    def __init__(
        self,
        path: Path,
        count: int,
        offset: Float | None,
        notes: Notes = (),
        item: str = "Gaussian",
    ) -> None:
        self.path = path
        self.count = count
        self.notes = notes
        self.tally = Tally(item)
        if offset is None:
            self.offset = np.zeros(3)
        else:
            self.offset = offset

    def __len__(self) -> int:
        return self.count

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs to read rows; it maps files that are mapped here."""
        state = vars(self).copy()
        state.pop("sample", None)
        state.pop("_reading", None)
        for name, rows in state.items():
            if isinstance(rows, np.memmap):
                state[name] = _Mapped(rows.filename, rows.dtype, rows.offset, rows.shape)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        for name, rows in state.items():
            if isinstance(rows, _Mapped):
                mapped = np.memmap(rows.file, rows.dtype, "r", rows.offset, rows.shape)
                setattr(self, name, mapped)
        self._is_copy = True

    def absolute(self) -> Self:
        """Return the source for a process that may run in another folder."""
        found = copy(self)
        found.path = self.path.absolute()
        return found

    def identity(self) -> list[Any]:
        """Return JSON that identifies this source, see `file_identity`."""
        return file_identity([self.path])

    def parts(self, rows: int) -> list[tuple[int, int]]:
        """Return the first and last rows of parts, of about `rows` rows each, see `part`."""
        return ranges([self.count], rows)

    def part(
        self,
        kind: Read,
        rows: int,
        first: int,
        last: int,
    ) -> Iterator[Any]:
        """Yield the `blocks` or `positions` of one of `parts(rows)`; `tallies` then count its rows.

        Parts that are read one after the other are read in one pass.
        """
        known = self._reading
        self._reading = None
        if known and known[0] == (kind, first):
            blocks = known[1]
        else:
            blocks = getattr(self, kind)(rows, first)
        for tally in self.tallies():
            tally.clear()
        at = first
        while at < last:
            block = next(blocks, None)
            if block is None:
                raise InputError("was changed while it was read", path=self.path)
            yield block
            if kind == "positions":
                at += len(block)
            else:
                at = first + sum(tally.rows for tally in self.tallies())
        # which would hold itself, and the file, in memory
        if last < self.count and not self._is_copy:
            self._reading = (kind, last), blocks

    def tallies(self) -> list[Tally]:
        """Return the counts over the rows that `blocks` has read, of each of its sources."""
        return [self.tally]

    @abstractmethod
    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        """Yield the (n, 3) positions of rows from `start` in blocks, relative to `offset`, not cleaned."""

    @abstractmethod
    def blocks(self, rows: int, start: int = 0) -> Iterator[Block]:
        """Yield rows from `start` in blocks of at most `rows`, without those that are not finite."""

    def header_notes(self) -> Notes:
        """Return notes other than on rows, known once `blocks` has finished."""
        return self.notes

    def all_notes(self) -> Notes:
        """Return all notes once `blocks` has finished; raise an `InputError` if no row is finite."""
        return (*self.header_notes(), *self.tally.notes(self.path))


class SceneStream(Stream[Splats]):
    """Scene in blocks.

    Attributes:
        sh_degree: 0–3.
        render_model: see `Splats`; may be changed before reading.
        up: the up direction that the source states.
        axes: axes of the coordinates, see `Splats`.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        rest: int = 0,
        offset: Float | None = None,
        notes: Notes = (),
        render_model: RenderModel = "classic",
    ) -> None:
        super().__init__(path, count, offset, notes)
        self.render_model = render_model
        self.sh_degree = _DEGREE_OF_REST[rest]
        self.up: tuple[float, float, float] | None = None
        self.axes: Axes = "RDF"

    def whole(self) -> Splats:
        """Read all rows into memory; `all_notes` are then those on these rows."""
        self.tally = Tally()
        raw = Raw.empty(self.count, (self.sh_degree + 1) ** 2 - 1)
        kept = 0
        for block in self.blocks(BLOCK):
            rows = slice(kept, kept + len(block))
            raw.take(rows).fill(getattr(block, name) for name in ARRAYS)
            kept = rows.stop
        self.all_notes()  # raises if no row is finite
        return self.placed(raw.take(slice(kept)))

    def placed(self, rows: Raw) -> Splats:
        """Return activated rows as a scene that stands as this one does."""
        return replace(rows.activated(self.render_model, self.offset, self.up), axes=self.axes)


class RawStream(SceneStream):
    """Scene of a file's `raw` rows, which `Tally.clean` cleans, and which `restore` may turn."""

    def restore(self, axes: Axes) -> None:
        """Turn what the file holds, y down, to coordinates of these axes."""
        found = restored(self.placed(Raw.empty(0, 0)), axes)
        self.axes = axes
        self.offset = found.offset
        self.up = found.up

    def in_axes(self, means: Float32) -> Float32:
        """Return stored means in the scene's axes."""
        if self.axes == "RDF":
            return means
        turn = change_of_axes("RDF", self.axes).astype(np.float32)
        return np.asarray(means @ turn.T, np.float32)

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        """Yield the source's rows from `start`, at most `rows` at a time; callers may change the arrays."""

    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        return (self.in_axes(raw.means) for raw in self.raw(rows, start))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for raw in self.raw(rows, start):
            before = self.tally.dropped
            keep = self.tally.clean(raw)
            stored = raw.activated(self.render_model, np.zeros(3))
            splats = replace(restored(stored, self.axes), offset=self.offset)
            splats = stand_as(splats, self)
            if self.tally.dropped > before:
                splats = splats.take(keep)
            yield splats


class PartsStream(SceneStream):
    """Scene of clean parts that `part` loads by index, one at a time.

    Args:
        identity: of the parts; None is that of the file.
    """

    def __init__(
        self,
        path: Path,
        counts: Sequence[int],
        part: Callable[[int], Splats],
        sh_degree: int,
        offset: Float,
        identity: list[Any] | None = None,
        notes: Notes = (),
        render_model: RenderModel = "classic",
    ) -> None:
        super().__init__(
            path,
            sum(counts),
            (sh_degree + 1) ** 2 - 1,
            offset,
            notes,
            render_model,
        )
        self.counts = counts
        self._part = part
        self._identity = identity

    @classmethod
    def of(cls, path: Path, splats: Splats, notes: Notes) -> PartsStream:
        """Return the scene of a file that was read as a whole."""
        stream = cls(
            path,
            [len(splats)],
            lambda _: splats,
            splats.sh_degree,
            splats.offset,
            notes=notes,
        )
        stream.render_model = splats.render_model
        stream.up = splats.up
        stream.axes = splats.axes
        return stream

    def identity(self) -> list[Any]:
        if self._identity is None:
            return super().identity()
        return self._identity

    def whole(self) -> Splats:
        if len(self.counts) > 1:
            return super().whole()
        return replace(self._part(0), render_model=self.render_model, axes=self.axes)

    def parts(self, rows: int) -> list[tuple[int, int]]:
        return ranges(self.counts, rows)

    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        return (block.means for block in self._rows(rows, start))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for block in self._rows(rows, start):
            self.tally.add(block)
            yield replace(block, render_model=self.render_model, axes=self.axes)

    def _rows(self, rows: int, start: int) -> Iterator[Splats]:
        for number, begin in from_row(self.counts, start):
            part = self._part(number)
            for first in range(begin, len(part), rows):
                yield part.take(slice(first, first + rows))

    def all_notes(self) -> Notes:
        return self.notes


class PointStream(Stream[RawPoints]):
    """Point cloud in blocks, with colours, or grey from intensities, by the range that most of them have.

    Attributes:
        sample: (n, 3) finite positions from all parts of the cloud, without noise.
        channels: 3 for colours, 1 for intensities, 0 if there is nothing to colour points by.
        lack: why there are no colours.
        todo: what to do then, if not the usual.
        system: the map system that the file states.
        metres_per_unit: of its positions, if the file states it.
        axes: axes of the coordinates: z is up in maps; None if neither the format nor a map tells.
        fields: names of the file's columns.
        also: those that `raw` yields behind the colours.
    """

    fields: Names = ()
    also: Names = ()

    def __init__(
        self,
        path: Path,
        count: int,
        sample: MarkedPoints,
        scales: Sequence[float] = (1.0,),
        limits: tuple[float, float] | None = None,
        notes: Notes = (),
    ) -> None:
        """Open a cloud, whose centre becomes the offset if it is far from the origin.

        The sample is of all parts of the cloud, since files' own bounds may be wrong.
        """
        positions, values, noise = sample
        good = np.isfinite(positions).all(axis=1) & ~noise
        placed = good & positions.any(axis=1)
        low, high = np.zeros((2, 3))
        if placed.any():
            low, high = np.percentile(positions[placed], (1, 99), axis=0)
        middle = (low + high) / 2
        extent = high - low
        size = np.linalg.norm(extent)
        farthest = np.abs(middle).max()
        offset = None
        if np.isfinite(middle).all() and farthest > size:
            offset = np.rint(middle)
        zeros = np.count_nonzero(good & ~placed)
        away = farthest > _FAR * size and extent.any()
        self._zeros_are_lost = away or zeros > max(_FEW_BLACK, _BLACK_SHARE * len(good))
        if self._zeros_are_lost and placed.any():
            good = placed
        self.sample = positions[good]
        notes = (*notes, *note_coarse(self.sample, spacing(self.sample, count)))
        if _in_degrees(middle, extent):
            notes = (*notes, _DEGREES)
        super().__init__(path, count, offset, notes, "point")
        self.channels = values.shape[1]
        self.scales = scales
        self.lack = "has neither colours nor intensities that vary"
        self.todo = ""
        self.system: str | None = None
        self.metres_per_unit: float | None = None
        self.axes: Axes | None = None
        if offset is not None:
            self.axes = "RFU"
        self._dark = 0.0
        self._full = 1.0
        if self.channels == 3:
            self._full = choose_white(values[good], scales)
        elif self.channels == 1:
            self._dark, self._full = choose_shades(values[good], limits)
            self.channels = int(self._dark < self._full)

    def shown(self, values: Float32) -> Float32:
        """Return stored values as (n, 3) colours in [0, 1]."""
        if not self.channels:
            return np.zeros((len(values), 3), np.float32)
        dark = np.float32(self._dark)
        extent = np.float32(self._full - self._dark)
        with np.errstate(invalid="ignore"):
            shades = (values - dark) / extent
        bright = (shades > HDR).any(axis=1)
        self.tally.bright += int(np.count_nonzero(bright))
        return np.broadcast_to(np.clip(shades, 0, 1), (len(values), 3))

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        """Yield the source's points from `start`, at most `rows` at a time."""

    def marked(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        """Yield `raw` with points as noise that scanners store at 0 0 0 for want of a return."""
        for positions, values, noise in self.raw(rows, start):
            if self._zeros_are_lost:
                noise = noise | ~positions.any(axis=1)
            yield positions, values, noise

    def header_notes(self) -> Notes:
        tally = self.tally
        rows = tally.rows - tally.dropped - tally.noise
        if not rows:
            return self.notes
        notes = list(self.notes)
        full = self._full
        if self.channels == 1:
            text = f"no colours; intensities of {self._dark:g} to {full:g} are shown as grey"
            notes.append(Note("grey", rows, text))
        elif tally.black == rows:
            text = "no colours"
            if self.channels:
                text = (
                    "all colours are 0; add colours, for example with PDAL's filters.colorization"
                )
            notes.append(Note("black", rows, text))
        elif tally.black > max(_FEW_BLACK, _BLACK_SHARE * rows):
            text = f"{plural(tally.black, 'point')} are black, perhaps without colours"
            notes.append(Note("black_points", tally.black, text))
        if self.channels != 3:
            return tuple(notes)
        if 1 < full < self.scales[-1]:
            code = "color_range"
            if full == 255:
                code = "eight_bit_colors"
            text = f"colours up to {full:,.0f} in fields of a larger range"
            notes.append(Note(code, rows, text))
        if tally.bright:
            points = plural(tally.bright, "point")
            text = f"{points} brighter than the range of most colours taken as white"
            notes.append(Note("bright_points", tally.bright, text))
        return tuple(notes)

    def near(self, positions: Float) -> Float32:
        """Return positions relative to `offset`."""
        with np.errstate(over="ignore", invalid="ignore"):
            return (positions - self.offset).astype(np.float32)

    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        for positions, _, noise in self.marked(rows, start):
            near = self.near(positions)
            near[noise] = np.nan
            yield near

    def blocks(self, rows: int, start: int = 0) -> Iterator[RawPoints]:
        for positions, values, noise in self.marked(rows, start):
            good = self.tally.keep(positions, values, noise)
            if not good.all():
                positions = positions[good]
                values = values[good]
            colors = self.shown(values)
            black = colors.max(axis=1, initial=0) < _BLACK
            self.tally.black += int(np.count_nonzero(black))
            yield positions, colors

    def whole(self) -> Cloud:
        """Read all points."""
        positions = np.empty((self.count, 3))
        colors = np.empty((self.count, 3), np.float32)
        kept = 0
        for block in self.blocks(_POINTS_AT_ONCE):
            rows = slice(kept, kept + len(block[0]))
            positions[rows], colors[rows] = block
            kept = rows.stop
        notes = self.all_notes()
        colors = colors[:kept]
        lit = colors.max(axis=1, initial=0) >= _BLACK
        colored = lit & (self.channels == 3)
        return Cloud(Points(positions[:kept], colors), notes, colored, self.axes)


class HeldPoints(PointStream):
    """Point cloud in memory, of which nothing is marked as noise."""

    def __init__(
        self,
        path: Path,
        positions: Float,
        values: Values,
        scales: Sequence[float],
        columns: Mapping[str, Values] = MappingProxyType({}),
    ) -> None:
        noise = np.zeros(len(positions), bool)
        self._held = positions, values.astype(np.float32), noise
        self.fields = tuple(columns)
        self._columns = columns
        super().__init__(path, len(positions), self._held, scales)

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        positions, values, noise = self._held
        further = [self._columns[name] for name in self.also]
        values = np.column_stack([values, *further]).astype(np.float32)
        for first in range(start, self.count, rows):
            part = slice(first, first + rows)
            yield positions[part], values[part], noise[part]


_DEGREES = Note(
    "degrees",
    1,
    "x and y look like degrees of longitude and latitude, and z like metres; project them to metres, for "
    "example with `pdal translate IN OUT reprojection --filters.reprojection.out_srs=EPSG:32633`",
)


def _in_degrees(middle: Float, extent: Float) -> bool:
    """Return whether x and y may be degrees, z metres: far from 0, and of much smaller extent than z."""
    wide = float(extent[:2].max())
    low, high = sorted(np.abs(middle[:2]))
    on_globe = low <= 90 and high <= 180
    is_far = high > _FAR * wide
    is_steep = extent[2] > _STEEP * wide
    return bool(on_globe and is_far and is_steep)


class Joined(Stream[Block]):
    """Several sources as one."""

    streams: Sequence[Stream[Block]]

    def identity(self) -> list[Any]:
        return [stream.identity() for stream in self.streams]

    def absolute(self) -> Self:
        found = super().absolute()
        found.streams = [stream.absolute() for stream in self.streams]  # type: ignore[misc]
        return found

    def parts(self, rows: int) -> list[tuple[int, int]]:
        begins = accumulate((stream.count for stream in self.streams), initial=0)
        return [
            (begin + first, begin + last)
            for begin, stream in zip(begins, self.streams, strict=False)
            for first, last in stream.parts(rows)
        ]

    def header_notes(self) -> Notes:
        notes = []
        for stream in self.streams:
            for note in stream.header_notes():
                text = f"{stream.path}: {note}"
                notes.append(replace(note, text=text))
        return tuple(notes)

    def _from(self, start: int) -> Iterator[tuple[int, int]]:
        return from_row([stream.count for stream in self.streams], start)


class JoinedScenes(Joined[Splats], SceneStream):
    """Several scenes as one, with the offset of the first and the highest of their SH degrees."""

    streams: Sequence[SceneStream]

    def __init__(self, streams: Sequence[SceneStream]) -> None:
        self.streams = streams
        rest = (max(stream.sh_degree for stream in streams) + 1) ** 2 - 1
        first = streams[0]
        SceneStream.__init__(
            self,
            first.path,
            sum(stream.count for stream in streams),
            rest,
            first.offset,
            render_model=one_model([stream.render_model for stream in streams]),
        )
        ups = {stream.up for stream in streams}
        if len(ups) == 1:
            self.up = ups.pop()
        self.axes = common_axes([stream.axes for stream in streams])

    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        for number, begin in self._from(start):
            stream = self.streams[number]
            for means in stream.positions(rows, begin):
                yield self._moved(means, stream.offset)

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for number, begin in self._from(start):
            stream = self.streams[number]
            stream.tally = self.tally
            for block in stream.blocks(rows, begin):
                block = block.with_sh_degree(self.sh_degree)
                means = self._moved(block.means, stream.offset)
                yield replace(block, means=means, offset=self.offset)

    def _moved(self, means: Float32, offset: Float) -> Float32:
        shift = offset - self.offset
        if not shift.any():
            return means
        return (means + shift).astype(np.float32)


class JoinedClouds(Joined[RawPoints], PointStream):
    """Several point clouds as one, with the offset of all.

    Raises:
        InputError: they state different map systems.
    """

    streams: Sequence[PointStream]

    def __init__(self, streams: Sequence[PointStream]) -> None:
        self.streams = streams
        at = np.concatenate([stream.sample for stream in streams])
        bare = np.zeros((len(at), 0), np.float32)
        sample = at, bare, np.zeros(len(at), bool)
        count = sum(stream.count for stream in streams)
        PointStream.__init__(self, streams[0].path, count, sample)
        self.channels = max(stream.channels for stream in streams)
        self.lack = streams[0].lack
        if len({stream.axes for stream in streams}) == 1:
            self.axes = streams[0].axes
        stated = {stream.system: stream.path.name for stream in reversed(streams) if stream.system}
        if len(stated) > 1:
            named = [f"{name} in {system}" for system, name in reversed(stated.items())]
            text = f"several map systems: {', '.join(named)}; project all to one first"
            raise InputError(text, path=streams[0].path)
        self.system = next(iter(stated), None)
        units = filter(None, (stream.metres_per_unit for stream in streams))
        self.metres_per_unit = next(units, None)
        self.notes = tuple(_far_apart(streams))

    def header_notes(self) -> Notes:
        return (*self.notes, *super().header_notes())

    def all_notes(self) -> Notes:
        self.tally.clear()
        for tally in self.tallies():
            self.tally.join(tally.counts())
        return super().all_notes()

    def tallies(self) -> list[Tally]:
        return [tally for stream in self.streams for tally in stream.tallies()]

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for number, begin in self._from(start):
            yield from self.streams[number].marked(rows, begin)

    def blocks(self, rows: int, start: int = 0) -> Iterator[RawPoints]:
        for number, begin in self._from(start):
            stream = self.streams[number]
            for tally in stream.tallies():
                tally.clear()
            yield from stream.blocks(rows, begin)


def joined_clouds(streams: Sequence[PointStream]) -> PointStream:
    """Return several point clouds as one."""
    if len(streams) == 1:
        return streams[0]
    return JoinedClouds(streams)


def _far_apart(streams: Sequence[PointStream]) -> Iterator[Note]:
    """Yield a note if clouds lie so far apart that they may be in several map systems."""
    placed = [stream for stream in streams if len(stream.sample)]
    if len(placed) < 2:
        return
    boxes = np.array([np.percentile(stream.sample, (1, 99), axis=0) for stream in placed])
    lows, highs = boxes.swapaxes(0, 1)
    size = (highs - lows).max()
    for number, stream in enumerate(placed):
        above = lows[number] - highs
        below = lows - highs[number]
        gaps = np.maximum(above, below).max(axis=1)
        nearest = np.delete(gaps, number).min()
        if nearest > _APART * size > 0:
            text = f"{stream.path.name} lies {nearest:,.0f} units from the others, "
            yield Note("map_systems", 1, f"{text}perhaps in another coordinate system")
            return


def telling(
    choices: Sequence[Names], read: Callable[[Names], Iterable[MarkedPoints]]
) -> tuple[Names, MarkedPoints]:
    """Return the first of several names of colours whose sample is not black, or constant, and the sample.

    Args:
        read: returns the parts of the sample, of which there is at least one.
    """
    found = []
    for names in choices or [()]:
        columns = zip(*read(names), strict=True)
        positions, values, noise = map(np.concatenate, columns)
        found.append((names, (positions, values, noise)))
    for names, sample in found:
        _, values, noise = sample
        if has_contrast(values[~noise]):
            return names, sample
    return found[0]


def ranges(counts: Sequence[int], rows: int) -> list[tuple[int, int]]:
    """Return the first and last rows of ranges of at most `rows` rows that lie in one part each.

    >>> ranges([5, 2], 3)
    [(0, 3), (3, 5), (5, 7)]
    """
    begins = zip(accumulate(counts, initial=0), counts, strict=False)
    return [
        (begin + first, begin + min(first + rows, count))
        for begin, count in begins
        for first in range(0, count, rows)
    ]


def from_row(counts: Sequence[int], start: int) -> Iterator[tuple[int, int]]:
    """Yield the index and the first row of each part that ends after row `start` of all parts."""
    for number, count in enumerate(counts):
        if start < count:
            yield number, start
        start = max(0, start - count)
