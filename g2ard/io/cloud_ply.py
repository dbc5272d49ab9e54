"""Reader and writer for coloured point clouds in .ply files."""

from collections.abc import Iterable, Iterator
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

from g2ard.arrays import Float32, Values
from g2ard.errors import InputError
from g2ard.io.judge import full_scales, unpack_colors
from g2ard.io.plyfiles import (
    COLOR_NAMES,
    is_mesh,
    read_element,
    read_header,
    require,
    row_blocks,
    scene_names,
    spread_rows,
    write_rows,
)
from g2ard.io.signs import MESH
from g2ard.io.stream import MarkedPoints, Names, PointStream, telling
from g2ard.io.types import Points

_POSITION = ["x", "y", "z"]


_PACKED = ("rgb", "rgba")
_INTENSITIES = ("intensity", "reflectance", "reflectivity")


class Stream(PointStream):
    """Rows of x y z and red green blue, or a packed rgb, or intensity, of any type, in small letters or not.

    Text files and those with leading lists are read whole.
    """

    def __init__(self, path: Path) -> None:
        header = read_header(path)
        self.path = path
        self._named = scene_names(header.properties("vertex"))
        require(list(self._named), _POSITION, "a point cloud")
        self.fields = tuple(self._named)
        (self._vertices,) = read_element(path, header, "vertex")
        rows = spread_rows(self._vertices)
        kinds = {name: self._vertices.dtype[own] for name, own in self._named.items()}
        choices = [names for names in COLOR_NAMES if kinds.keys() >= set(names)]
        choices += [(name,) for name in _PACKED if name in kinds and kinds[name].itemsize == 4]
        choices += [(name,) for name in _INTENSITIES if name in kinds]

        def sampled(names: Names) -> list[MarkedPoints]:
            self._names = names
            return [self._marked(rows)]

        self._names, sample = telling(choices, sampled)
        packed = self._names and self._names[0] in _PACKED
        scales = [full_scales(kinds[name]) for name in self._names]
        if packed:
            scales = [(255.0,)]
        widest = max(scales, key=lambda scales: scales[-1], default=(1.0,))
        super().__init__(path, len(self._vertices), sample, widest)
        if choices:
            return
        found = " ".join(header.properties("vertex"))
        self.lack = (
            "needs the vertex properties 'red', 'green', 'blue' of a coloured point cloud, or "
            f"intensities (found {found}); rename its colours if they have other names"
        )
        if is_mesh(header):
            self.lack = "is a mesh without colours at its vertices"
            self.todo = MESH

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for _, block in row_blocks(self.path, self._vertices, rows, start):
            yield self._marked(block)

    def _marked(self, rows: Values) -> MarkedPoints:
        """Return positions, (n, 3) colours, (n, 1) intensities or (n, 0), and that none is noise."""
        columns = [rows[self._named[name]] for name in self._names]
        if len(columns) == 3:
            columns = list(map(_color, repeat(self.path), columns, self._names))
        elif columns and self._names[0] in _PACKED:
            columns = unpack_colors(columns[0])
        columns += [rows[self._named[name]] for name in self.also]
        noise = np.zeros(len(rows), bool)
        with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN
            places = [rows[self._named[axis]].astype(float) for axis in _POSITION]
            values = np.stack([noise, *columns], axis=1)[:, 1:]  # `stack` needs a column
            return np.stack(places, axis=1), values.astype(np.float32), noise


def _color(path: Path, values: Values, name: str) -> Float32:
    finite = values[np.isfinite(values)]
    scales = full_scales(values.dtype)
    low = float(finite.min(initial=0))
    top = float(finite.max(initial=0))
    least = 0.0
    if values.dtype.kind == "f":
        least = -0.5
    if low < least or top > scales[-1] * 1.001:
        beyond = low if low < 0 else top
        raise InputError(
            f"has a value of {beyond:g}, expected [0, {scales[-1]:g}]",
            path=path,
            property=name,
        )
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return values.astype(np.float32)


def write_blocks(
    path: Path,
    count: int,
    blocks: Iterable[Points],
    *,
    overwrite: bool = False,
) -> None:
    """Write a binary .ply of `count` points that arrive in blocks: float64 positions, 8-bit colours."""
    types = dict.fromkeys(_POSITION, "<f8") | dict.fromkeys(COLOR_NAMES[0], "u1")

    def rows_of(points: Points) -> Values:
        if not (np.isfinite(points.positions).all() and np.isfinite(points.colors).all()):
            raise InputError("not written: a point is not finite")
        colors = np.rint(np.clip(points.colors, 0, 1) * 255)
        rows = np.hstack([points.positions, colors])
        return unstructured_to_structured(rows, np.dtype([*types.items()]))

    if not count:
        raise InputError("not written: there are no points", path=path)
    write_rows(path, types, count, map(rows_of, blocks), overwrite)
