"""Reader for COLMAP's sparse points as a coloured point cloud."""

import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from g2ard.errors import InputError, damaged
from g2ard.io.colmap import Columns, Table, TextTable, model_folder, numbers_of, parsing, points_file
from g2ard.io.jsonfile import Place
from g2ard.io.stream import HeldPoints
from g2ard.io.types import Bytes, Float, Mask

_POINT = Columns.of("QdddBBBdQ", "POINT3D_ID", *"XYZRGB", "ERROR", "TRACK")
_NUMBERS = Columns.of("ddddddd", "POINT3D_ID", *"XYZRGB")


_LEAST_IMAGES = 2
"""Least images that place a point."""


class Stream(HeldPoints):
    """The points3D.bin or .txt itself, or that of the model in a COLMAP folder, in memory.

    Args:
        images: names of the images that points may come from: those that fewer than two of them see are
            skipped, except points that state no image. None of the model's images keeps all.
    """

    def __init__(self, path: Path, images: Sequence[str] = ()) -> None:
        if path.is_dir() or path.stem.lower() != "points3d":
            file = points_file(path)
            if file is None or not file.is_file():
                raise InputError("has no points3D.bin or points3D.txt", path=model_folder(path) or path)
            path = file
        with parsing(path):
            positions, rgb = (_binary if path.suffix.lower() == ".bin" else _text)(path)
            if numbers := numbers_of(path.parent, images) if images else set():
                placed = _placed(_tracks(path), numbers)
                positions, rgb = positions[placed], rgb[placed]
        whole = (rgb == np.rint(rgb)).all()
        super().__init__(path, positions, rgb, (255.0,) if whole else (1.0, 255.0))
        self.axes = self.axes or "RDF"


def _binary(path: Path) -> tuple[Float, Bytes]:
    """Read rows of id, x y z, r g b, error and a track of variable length."""
    table = Table(path, "point")
    count, size = table.count, len(table.data)
    if count * _POINT.packed.size > size:
        raise damaged(f"truncated: {count:,} points in {size:,} bytes", path=path)
    positions, rgb = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for i in table:
        _key, x, y, z, r, g, b, _error, track = table.take(_POINT)
        positions[i], rgb[i] = (x, y, z), (r, g, b)
        table.skip(8 * track, "TRACK")
    return positions, rgb


def _text(path: Path) -> tuple[Float, Float]:
    table = TextTable(path, "point")
    lines = [" ".join(table.words[1:7]) for _ in table]
    try:
        values = np.loadtxt(lines, ndmin=2).reshape(len(lines), 6)
    except ValueError:  # find the wrong number
        table = TextTable(path, "point")
        values = np.array([table.take(_NUMBERS)[1:] for _ in table])
    inside = (values[:, 3:] >= 0) & (values[:, 3:] <= 255)
    if not inside.all():
        i, channel = (int(at) for at in np.argwhere(~inside)[0])
        raise Place(path, i, "point", "RGB"[channel]).error(
            f"is {values[i, 3 + channel]:g}, expected 0 to 255"
        )
    return values[:, :3], values[:, 3:]


def _tracks(path: Path) -> Iterator[Iterable[int]]:
    """Yield the numbers of the images that see each point."""
    if path.suffix.lower() == ".bin":
        table = Table(path, "point")
        for _ in table:
            count = table.take(_POINT)[-1]
            yield struct.unpack(f"<{2 * count}I", table.skip(8 * count, "TRACK"))[::2]
    else:
        text = TextTable(path, "point")
        for _ in text:
            yield map(int, " ".join(text.words[7:]).split()[1::2])


def _placed(tracks: Iterable[Iterable[int]], numbers: set[int]) -> Mask:
    """Return whether enough of some images see each point, or no image at all does."""
    seen = (set(track) for track in tracks)
    return np.array([not track or len(track & numbers) >= _LEAST_IMAGES for track in seen], bool)
