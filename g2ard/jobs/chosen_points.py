"""Choosing points of clouds before they are lifted, and colouring them by intensity or class."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from typing import Any, Self

import numpy as np

from g2ard.arrays import Float, Float32, Mask, Values
from g2ard.config.choices import PointColor
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.io import Source
from g2ard.io.judge import choose_shades
from g2ard.io.sanitize import Tally
from g2ard.io.stream import JoinedClouds, MarkedPoints, PointStream, from_row, ranges
from g2ard.io.types import Note, Notes, Points
from g2ard.progress import Progress, silent
from g2ard.scene.conditions import holds, names_in
from g2ard.scene.splats import Splats
from g2ard.scene.transform import within_box

_ROWS = 1 << 20
"""Points in memory at a time."""

_SAMPLE = 100_000
"""Chosen points that tell where a cloud is and what its intensities are."""

_PLACE = ("x", "y", "z")
_SHADES = ("red", "green", "blue")

_COLUMNS: dict[PointColor, tuple[str, ...]] = {
    "intensity": ("intensity", "reflectance", "reflectivity"),
    "class": ("classification", "class"),
}
"""`PointColor` → names of its column."""

_Ranges = dict[str, tuple[float, float]]

_OTHER_CLASS = 0.55, 0.55, 0.58
_CLASSES = {
    **{2: (0.60, 0.47, 0.34), 3: (0.66, 0.80, 0.46), 4: (0.42, 0.66, 0.34), 5: (0.20, 0.48, 0.24)},
    **{
        6: (0.84, 0.36, 0.30),
        9: (0.26, 0.50, 0.82),
        10: (0.50, 0.38, 0.56),
        11: (0.36, 0.36, 0.40),
    },
    **dict.fromkeys((13, 14, 15, 16), (0.95, 0.76, 0.20)),  # wires and what carries them
    17: (0.72, 0.62, 0.84),
}
"""Class of ASPRS's table → its colour: ground, three heights of vegetation, building, water, and so on."""


@dataclass(frozen=True, eq=False)
class PointChoice(Settings):
    """Points of a cloud to read, and what colours them.

    Args:
        box: lower and upper corner (x, y, z, x, y, z) of the points to keep, in the cloud's coordinates.
        where: condition on the points to keep, such as "classification == 2"; names are x, y and z, red,
            green and blue from 0 to 1, and the file's columns.
        color: "intensity" for grey, or "class" for colours of ASPRS's classes; None takes the file's colours.

    Raises:
        InputError: a box that is not six finite numbers or is empty, or a text that is not a condition.
    """

    box: Sequence[float] | None = None
    where: str | None = None
    color: PointColor | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.box is not None:
            fits = np.shape(self.box) == (6,) and all(map(math.isfinite, self.box))
            require("box", self.box, fits, "6 numbers")
            within_box(np.zeros((0, 3)), self.box[:3], self.box[3:])
        if self.where is not None:
            names_in(self.where)

    @property
    def given(self) -> list[str]:
        """Return the names of the options that are given."""
        return [name for name, value in vars(self).items() if value is not None]

    def narrow(self, source: Source | Splats | Points | None, progress: Progress = silent) -> None:
        """Make a source read only these points; raise an `InputError` if it is no file of points."""
        if not self.given:
            return
        if not isinstance(source, Source) or source.kind != "points":
            what = str(source) if isinstance(source, Source) else "what is given"
            crop = None if self.given == ["color"] else "`g2ard convert` crops scenes"
            text = f"is for files of points, and {what} is none"
            raise InputError(text, parameter=self.given[0], hint=crop)
        source.through = partial(self.of, progress=progress)

    def of(self, stream: PointStream, progress: Progress = silent) -> PointStream:
        """Return the chosen points of a cloud; raise an `InputError` if nothing is chosen."""
        ranges: _Ranges = {}
        found = self._narrowed(stream, progress, ranges)
        if found is None:
            conditions = " and ".join(f"{{{name}}}" for name in self.given if name != "color")
            held = ", ".join(
                f"{name} is {low:.9g} to {high:.9g}" for name, (low, high) in ranges.items()
            )
            raise InputError(
                f"none of {stream.count:,} points is kept: {held}",
                path=stream.path,
                hint=f"change {conditions}",
            )
        return found

    def _narrowed(
        self, stream: PointStream, progress: Progress, ranges: _Ranges
    ) -> PointStream | None:
        """Return the chosen points of a cloud, or None; widen the ranges of columns that were compared."""
        if not isinstance(stream, JoinedClouds):
            chosen = ChosenPoints(stream, self, progress)
            for name, (low, high) in chosen.ranges.items():
                known = ranges.get(name, (low, high))
                ranges[name] = min(low, known[0]), max(high, known[1])
            return chosen if chosen.count else None
        parts = [self._narrowed(part, progress, ranges) for part in stream.streams]
        stream.streams = [part for part in parts if part is not None]
        if not stream.streams:
            return None
        stream.count = sum(part.count for part in stream.streams)
        stream.sample = np.concatenate([part.sample for part in stream.streams])
        stream.channels = max(part.channels for part in stream.streams)
        return stream


class ChosenPoints(PointStream):
    """The points of a cloud that a choice keeps; they are counted once when it is opened.

    Attributes:
        ranges: least and largest value of each column that was compared.
    """

    def __init__(self, stream: PointStream, choice: PointChoice, progress: Progress) -> None:
        vars(self).update(vars(stream))  # the same cloud, of which `raw` yields less
        self.tally = Tally("point")
        self._whole = stream
        self._choice = choice
        self.ranges: _Ranges = {}
        self._fields = {
            name.lower(): name for name in reversed(stream.fields) if name.isidentifier()
        }
        self._shade = self._column_of_color()
        wanted = set() if choice.where is None else names_in(choice.where) & set(self._fields)
        wanted -= {*_PLACE, *_SHADES}
        self._also = sorted(wanted | ({self._shade} if self._shade else set()))
        stream.also = tuple(self._fields[name] for name in self._also)
        blocks = -(-stream.count // _ROWS)
        places = [np.zeros((0, 3))]
        shades = [np.zeros((0, 1), np.float32)]
        read = 0
        self._counts = list[int]()
        for positions, values, noise in self._chosen():
            read = min(stream.count, read + _ROWS)
            progress("points", read, stream.count)
            self._counts.append(len(positions))
            good = np.flatnonzero(np.isfinite(positions).all(axis=1) & ~noise)
            some = good[:: max(1, -(-len(good) * blocks // _SAMPLE))]
            places.append(positions[some])
            shades.append(values[some, :1] if self._shade else np.zeros((0, 1), np.float32))
        self.count = sum(self._counts)
        self.sample = np.concatenate(places)
        if self._shade:
            found = np.concatenate(shades)
            if len(found) and not np.ptp(found):
                text = f"colours nothing: it is {found[0, 0]:g} at all points"
                raise InputError(text, path=stream.path, property=self._shade)
            self.channels = 1
            self._dark, self._full = choose_shades(found)

    def identity(self) -> list[Any]:
        return [*self._whole.identity(), list(astuple(self._choice))]

    def header_notes(self) -> Notes:
        kept = Note(
            "chosen", self.count, f"{self.count:,} of {self._whole.count:,} points are read"
        )
        return (*(self.notes if self._shade else super().header_notes()), kept)

    def shown(self, values: Float32) -> Float32:
        if self._choice.color != "class":
            return super().shown(values)
        table = np.full((256, 3), _OTHER_CLASS, np.float32)
        table[list(_CLASSES)] = list(_CLASSES.values())
        return table[np.clip(np.nan_to_num(values[:, 0]), 0, 255).astype(int)]

    def absolute(self) -> Self:
        found = super().absolute()
        found._whole = self._whole.absolute()
        return found

    def parts(self, rows: int) -> list[tuple[int, int]]:
        """Return the chosen points of each block of the cloud."""
        return ranges(self._counts, _ROWS)

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        number, begin = next(from_row(self._counts, start), (len(self._counts), 0))
        for block in self._chosen(number):
            for first in range(begin, len(block[0]), rows):
                part = slice(first, first + rows)
                yield block[0][part], block[1][part], block[2][part]
            begin = 0

    def _chosen(self, block: int = 0) -> Iterator[MarkedPoints]:
        """Yield the chosen points of each block of the cloud from one on, with what colours them."""
        for positions, values, noise in self._whole.marked(_ROWS, block * _ROWS):
            keep = self._kept(positions, values)
            own = values.shape[1] - len(self._also)
            columns = values[:, :own]
            if self._shade:
                columns = values[:, own + self._also.index(self._shade) :][:, :1]
            yield positions[keep], columns[keep], noise[keep]

    def _kept(self, positions: Float, values: Float32) -> Mask:
        """Return the (n,) mask of points to keep.

        Args:
            values: (n, k) colours, then the further columns.
        """
        keep = np.ones(len(positions), bool)
        box = self._choice.box
        where = self._choice.where
        own = values.shape[1] - len(self._also)
        if box is not None:
            keep &= within_box(positions, box[:3], box[3:])
            for name in _PLACE:
                self._widen(name, positions[:, _PLACE.index(name)])
        if where is None:
            return keep

        def column(name: str) -> Values:
            found: Values
            if name in _PLACE:
                found = positions[:, _PLACE.index(name)]
            elif name in _SHADES:
                found = self._whole.shown(values[:, :own])[:, _SHADES.index(name)]
            else:
                found = values[:, own + self._also.index(name)]
            self._widen(name, found)
            return found

        names = dict.fromkeys(
            (*_PLACE, *(_SHADES if self._whole.channels else ()), *sorted(self._fields))
        )
        try:
            return keep & holds(where, list(names), column, len(positions))
        except InputError as error:
            raise error.at(path=self.path) from None

    def _widen(self, name: str, values: Values) -> None:
        finite = values[np.isfinite(values)]
        if finite.size:
            known = self.ranges.get(name, (np.inf, -np.inf))
            self.ranges[name] = (
                min(known[0], float(finite.min())),
                max(known[1], float(finite.max())),
            )

    def _column_of_color(self) -> str | None:
        """Return the name of the column that colours points; None for the cloud's own colours."""
        if self._choice.color is None:
            return None
        names = _COLUMNS[self._choice.color]
        found = next((name for name in names if name in self._fields), None)
        if found is None:
            columns = ", ".join(sorted(self._fields)) or "no columns"
            raise InputError(
                f"has no column {names[0]!r} (found {columns})",
                path=self.path,
                parameter="color",
            )
        return found
