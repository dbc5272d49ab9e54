"""Reader and writer for coloured point clouds in .ply files."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.plyfiles import read_element, read_header, require, row_blocks, spread_rows, write_rows
from g2ard.io.stream import PointStream, RawPoints
from g2ard.io.types import Points

_POSITION = ["x", "y", "z"]
_COLOR_NAMES = (["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"])


class Stream(PointStream):
    """Rows of x y z and red green blue: integers, scaled by their range, or floats in [0, 1].

    Text files and those with leading lists are read whole.
    """

    def __init__(self, path: Path) -> None:
        self._vertices, self._names = _vertices(path)
        sample = spread_rows(self._vertices)
        with np.errstate(invalid="ignore"):
            at = np.stack([sample[name].astype(np.float64) for name in _POSITION], axis=1)
        at = at[np.isfinite(at).all(1)]
        low, high = np.percentile(at, (1, 99), axis=0) if len(at) else np.zeros((2, 3))
        super().__init__(path, len(self._vertices), low, high)

    def raw(self, rows: int, start: int) -> Iterator[RawPoints]:
        for _, block in row_blocks(self.path, self._vertices, rows, start):
            yield _points(self.path, block, self._names)


def _vertices(path: Path) -> tuple[NDArray[Any], list[str]]:
    """Return the rows and the names of their colour properties."""
    header = read_header(path)
    properties = header.properties("vertex")
    require(path, properties, _POSITION, "a point cloud")
    names = next((n for n in _COLOR_NAMES if set(n) <= set(properties)), _COLOR_NAMES[0])
    require(path, properties, names, "a coloured point cloud")
    (rows,) = read_element(path, header, "vertex")
    return rows, names


def _points(path: Path, rows: NDArray[Any], names: list[str]) -> RawPoints:
    with np.errstate(invalid="ignore"):  # a signalling NaN
        positions = np.stack([rows[name].astype(np.float64) for name in _POSITION], axis=1)
    return positions, np.stack([_unit(path, rows[name], name) for name in names], axis=1)


def _unit(path: Path, values: NDArray[Any], name: str) -> NDArray[np.float32]:
    if values.dtype.kind in "iu":
        least, most = int(values.min(initial=0)), int(np.iinfo(values.dtype).max)
        if least < 0:
            raise InputError(f"has a value of {least}, expected [0, {most}]", path=path, property=name)
        return (values / np.float32(most)).astype(np.float32)
    finite = values[np.isfinite(values)]
    low, top = float(finite.min(initial=0.0)), float(finite.max(initial=0.0))
    if low < -0.5 or top > 1.5:
        beyond = top if top > 1.5 else low
        raise InputError(f"has a value of {beyond:g}, expected floats in [0, 1]", path=path, property=name)
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return values.astype(np.float32)


def write(path: Path, points: Points, *, overwrite: bool = False) -> None:
    """Write a binary .ply: x y z as float64, red green blue as bytes."""
    write_blocks(path, len(points), [points], overwrite=overwrite)


def write_blocks(path: Path, count: int, blocks: Iterable[Points], *, overwrite: bool = False) -> None:
    """Write `count` points that arrive in blocks, as `write` does."""
    types = dict.fromkeys(_POSITION, "<f8") | dict.fromkeys(_COLOR_NAMES[0], "u1")

    def rows_of(points: Points) -> NDArray[Any]:
        if not (np.isfinite(points.positions).all() and np.isfinite(points.colors).all()):
            raise InputError("not written: a point is not finite", path=path)
        rows = np.empty(len(points), list(types.items()))
        for axis in range(3):
            rows[_POSITION[axis]] = points.positions[:, axis]
            rows[_COLOR_NAMES[0][axis]] = np.rint(np.clip(points.colors[:, axis], 0, 1) * 255)
        return rows

    if not count:
        raise InputError("not written: there are no points", path=path)
    write_rows(path, types, count, map(rows_of, blocks), overwrite)
