"""Reader and writer for coloured point clouds in .ply files."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.plyfiles import (
    COLOR_NAMES,
    read_element,
    read_header,
    require,
    row_blocks,
    spread_rows,
    write_rows,
)
from g2ard.io.stream import MarkedPoints, PointStream, full_scales
from g2ard.io.types import Points

_POSITION = ["x", "y", "z"]


class Stream(PointStream):
    """Rows of x y z and red green blue, of any type.

    Text files and those with leading lists are read whole.
    """

    def __init__(self, path: Path) -> None:
        self._vertices, self._names = _vertices(path)
        kinds = [self._vertices.dtype[name] for name in self._names]
        widest = max((full_scales(kind) for kind in kinds), key=lambda scales: scales[-1])
        super().__init__(path, len(self._vertices), _positions(spread_rows(self._vertices)), widest)

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for _, block in row_blocks(self.path, self._vertices, rows, start):
            colors = [_color(self.path, block[name], name) for name in self._names]
            yield _positions(block), np.stack(colors, axis=1), np.zeros(len(block), bool)


def _positions(rows: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return np.stack([rows[name].astype(np.float64) for name in _POSITION], axis=1)


def _vertices(path: Path) -> tuple[NDArray[Any], list[str]]:
    """Return the rows and the names of their colour properties."""
    header = read_header(path)
    properties = header.properties("vertex")
    require(path, properties, _POSITION, "a point cloud")
    names = next((n for n in COLOR_NAMES if set(n) <= set(properties)), COLOR_NAMES[0])
    require(path, properties, names, "a coloured point cloud")
    (rows,) = read_element(path, header, "vertex")
    return rows, names


def _color(path: Path, values: NDArray[Any], name: str) -> NDArray[np.float32]:
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    scales = full_scales(values.dtype)
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
