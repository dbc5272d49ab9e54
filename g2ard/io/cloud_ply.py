"""Reader and writer for coloured point clouds in .ply files."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io import judge
from g2ard.io.plyfiles import (
    COLOR_NAMES,
    read_element,
    read_header,
    require,
    row_blocks,
    spread_rows,
    write_rows,
)
from g2ard.io.stream import MarkedPoints, Names, PointStream, telling
from g2ard.io.types import Points

_POSITION = ["x", "y", "z"]


_INTENSITIES = ("intensity", "reflectance", "reflectivity")


class Stream(PointStream):
    """Rows of x y z and red green blue, or intensity, of any type.

    Text files and those with leading lists are read whole.
    """

    def __init__(self, path: Path) -> None:
        header = read_header(path)
        properties = header.properties("vertex")
        require(path, properties, _POSITION, "a point cloud")
        (self._vertices,) = read_element(path, header, "vertex")
        rows = spread_rows(self._vertices)
        choices = [names for names in COLOR_NAMES if set(names) <= set(properties)]
        named = {word.lower().removeprefix("scalar_"): word for word in properties}
        choices += [[named[word]] for word in _INTENSITIES if word in named]

        def sampled(names: Names) -> MarkedPoints:
            return _positions(rows), _colors(path, rows, names), np.zeros(len(rows), bool)

        self._names, sample = telling(map(tuple, choices), sampled)
        kinds = [self._vertices.dtype[name] for name in self._names]
        widest = max(map(judge.full_scales, kinds), key=lambda scales: scales[-1], default=(1.0,))
        super().__init__(path, len(self._vertices), sample, widest)
        missing = ", ".join(repr(name) for name in COLOR_NAMES[0] if name not in properties)
        if missing:
            self.lack = f"a coloured point cloud needs the vertex property {missing}, or intensities"

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for _, block in row_blocks(self.path, self._vertices, rows, start):
            yield _positions(block), _colors(self.path, block, self._names), np.zeros(len(block), bool)


def _positions(rows: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return np.stack([rows[name].astype(np.float64) for name in _POSITION], axis=1)


def _colors(path: Path, rows: NDArray[Any], names: Names) -> NDArray[np.float32]:
    """Return (n, 3) colours, (n, 1) intensities or (n, 0)."""
    columns = [_color(path, rows[name], name) if len(names) == 3 else rows[name] for name in names]
    with np.errstate(invalid="ignore", over="ignore"):
        return np.stack([np.zeros(len(rows)), *columns], axis=1)[:, 1:].astype(np.float32)


def _color(path: Path, values: NDArray[Any], name: str) -> NDArray[np.float32]:
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    scales = judge.full_scales(values.dtype)
    low, top = float(finite.min(initial=0)), float(finite.max(initial=0))
    if low < (-0.5 if values.dtype.kind == "f" else 0) or top > scales[-1] * 1.001:
        beyond = low if low < 0 else top
        raise InputError(f"has a value of {beyond:g}, expected [0, {scales[-1]:g}]", path=path, property=name)
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return values.astype(np.float32)


def write_blocks(path: Path, count: int, blocks: Iterable[Points], *, overwrite: bool = False) -> None:
    """Write a binary .ply of `count` points that arrive in blocks: float64 positions, 8-bit colours."""
    types = dict.fromkeys(_POSITION, "<f8") | dict.fromkeys(COLOR_NAMES[0], "u1")

    def rows_of(points: Points) -> NDArray[Any]:
        if not (np.isfinite(points.positions).all() and np.isfinite(points.colors).all()):
            raise InputError("not written: a point is not finite", path=path)
        rows = np.empty(len(points), list(types.items()))
        for axis in range(3):
            rows[_POSITION[axis]] = points.positions[:, axis]
            rows[COLOR_NAMES[0][axis]] = np.rint(np.clip(points.colors[:, axis], 0, 1) * 255)
        return rows

    if not count:
        raise InputError("not written: there are no points", path=path)
    write_rows(path, types, count, map(rows_of, blocks), overwrite)
