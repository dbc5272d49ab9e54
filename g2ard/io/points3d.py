"""Reader for COLMAP's sparse points as a coloured point cloud."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, damaged
from g2ard.io.colmap import Table, model_folder, number, parsing, points_file, text_lines
from g2ard.io.jsonfile import Place
from g2ard.io.stream import WholeCloud, full_scales

_COLUMNS = tuple((name, at) for at, name in enumerate("XYZRGB", 1))
_POINT = struct.Struct("<QdddBBBdQ")
_NAMES = ("POINT3D_ID", *"XYZRGB", "ERROR", "TRACK")


class Stream(WholeCloud):
    """The points3D.bin or .txt itself, or that of the model in a COLMAP folder."""

    def __init__(self, path: Path) -> None:
        if path.is_dir() or path.stem.lower() != "points3d":
            file = points_file(path)
            if file is None or not file.is_file():
                raise InputError("has no points3D.bin or points3D.txt", path=model_folder(path) or path)
            path = file
        with parsing(path):
            positions, rgb = (_binary if path.suffix.lower() == ".bin" else _text)(path)
        super().__init__(path, positions, rgb.astype(np.float32), full_scales(np.dtype(np.uint8)))


def _binary(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read rows of id, x y z, r g b, error and a track of variable length."""
    table = Table(path)
    count, size = table.count, len(table.data)
    if count * _POINT.size > size:
        raise damaged(f"truncated: {count:,} points in {size:,} bytes", path=path)
    positions, rgb = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for i in range(count):
        _key, x, y, z, r, g, b, _error, track = table.take("point", i, _POINT, _NAMES)
        positions[i], rgb[i] = (x, y, z), (r, g, b)
        table.skip("point", i, 8 * track, "TRACK")
    return positions, rgb


def _text(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    lines = [line for line in text_lines(path) if line.strip()]
    rows = [line.split(maxsplit=7) for line in lines]
    plain = all(line.isascii() and "_" not in line for line in lines)  # float() accepts more
    try:
        values = np.array([words[1:7] for words in rows], np.float64).reshape(-1, 6)
    except ValueError:
        plain = False
    if not plain:  # find the wrong number
        values_read = [[number(path, "point", i, w, *c, float) for c in _COLUMNS] for i, w in enumerate(rows)]
        values = np.array(values_read)
    inside = (values[:, 3:] >= 0) & (values[:, 3:] <= 255)
    if not inside.all():
        i, channel = (int(at) for at in np.argwhere(~inside)[0])
        place = Place(path, i, "point", "RGB"[channel])
        raise place.error(f"is {rows[i][4 + channel]!r}, expected 0 to 255")
    return values[:, :3], values[:, 3:].astype(np.uint8)
