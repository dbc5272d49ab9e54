"""Reader for COLMAP's sparse points as a coloured point cloud."""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float
from g2ard.errors import InputError, damaged
from g2ard.io.colmap import (
    Columns,
    Table,
    TextTable,
    model_folder,
    numbers_of,
    parsing,
    points_file,
)
from g2ard.io.jsonfile import Place
from g2ard.io.stream import HeldPoints

_POINT = Columns.of("QdddBBBdQ", "POINT3D_ID", *"XYZRGB", "ERROR", "TRACK")
_NUMBERS = Columns.of("ddddddd", "POINT3D_ID", *"XYZRGB")


_LEAST_IMAGES = 2  # least images that place a point


class Stream(HeldPoints):
    """The points3D.bin or .txt itself, or that of the model in a COLMAP folder, in memory.

    Args:
        names: images that points may come from: those that fewer than two of them see are skipped, except
            points that state no image. None of the model's images keeps all.
    """

    def __init__(self, path: Path, names: Sequence[str] = ()) -> None:
        if path.is_dir() or path.stem.lower() != "points3d":
            file = points_file(path)
            if file is None or not file.is_file():
                place = model_folder(path) or path
                raise InputError("has no points3D.bin or points3D.txt", path=place)
            path = file
        with parsing(path):
            self._numbers = set[int]()
            if names:
                self._numbers = numbers_of(path.parent, names)
            if path.suffix.lower() == ".bin":
                rows = _binary(path, self._numbers)
            else:
                rows = _text(path, self._numbers)
        colors = rows[:, 3:]
        scales: tuple[float, ...] = (1.0, 255.0)
        if (colors == np.rint(colors)).all():
            scales = (255.0,)
        super().__init__(path, rows[:, :3], colors, scales)
        self.axes = self.axes or "RDF"

    def identity(self) -> list[Any]:
        return [*super().identity(), *sorted(self._numbers)]


def _binary(path: Path, numbers: set[int]) -> Float:
    """Read x y z, r g b of placed points, from rows of id, these, error and a track of variable length."""
    table = Table(path, "point")
    kept = 0
    count = table.count
    size = len(table.data)
    if count * _POINT.packed.size > size:
        raise damaged(f"truncated: {count:,} points in {size:,} bytes")
    rows = np.empty((count, 6))
    for _ in table:
        _key, *row, _error, track = table.take(_POINT)
        pairs = struct.unpack(f"<{2 * track}I", table.skip(8 * track, "TRACK"))
        if _is_placed(pairs[::2], numbers):
            rows[kept] = row
            kept += 1
    return rows[:kept]


def _text(path: Path, numbers: set[int]) -> Float:
    """Read the same from text, whose colours must be those of bytes."""
    table = TextTable(path, "point")
    lines = []
    for _ in table:
        pairs = " ".join(table.words[7:]).split()[1:]
        if _is_placed(map(int, pairs[::2]), numbers):
            lines.append(" ".join(table.words[1:7]))
    try:
        rows = np.loadtxt(lines, ndmin=2).reshape(len(lines), 6)
    except ValueError:  # find the wrong number
        table = TextTable(path, "point")
        rows = np.array([table.take(_NUMBERS)[1:] for _ in table])
    colors = rows[:, 3:]
    inside = (colors >= 0) & (colors <= 255)
    for i, channel in np.argwhere(~inside)[:1].tolist():
        place = Place(path, i, "point", "RGB"[channel])
        raise place.error(f"is {colors[i, channel]:g}, expected 0 to 255")
    return rows


def _is_placed(seen: Iterable[int], numbers: set[int]) -> bool:
    """Return whether enough of some images see a point, or no image does, or any may."""
    if not numbers:
        return True
    track = set(seen)
    return not track or len(track & numbers) >= _LEAST_IMAGES
