"""LiDAR clouds, .las and .laz, through laspy with lazrs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from g2ard.errors import InputError, MissingDependencyError
from g2ard.io.cloud_ply import finite_cloud
from g2ard.io.types import Cloud, Note

__all__ = ["read"]


def read(path: Path) -> Cloud:
    """Read positions in float64 and colours; colours that never pass 255 are taken as 8-bit and noted.

    Raises:
        InputError: not a LAS file, truncated, its point format has no colour, or no finite point.
        MissingDependencyError: laspy or its lazrs backend is not installed.
    """
    try:
        import laspy
        import lazrs
    except ImportError as error:
        raise MissingDependencyError(f"{path}: .las and .laz need `pip install g2ard[las]`") from error
    try:
        with laspy.open(path) as reader:
            names = set(reader.header.point_format.dimension_names)
            if not {"red", "green", "blue"} <= names:
                number = reader.header.point_format.id
                raise InputError(f"{path}: its point format {number} has no 'red', 'green', 'blue'")
            promised, las = reader.header.point_count, reader.read()
    except (laspy.LaspyException, lazrs.LazrsError, OSError, ValueError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read as LAS: {error}") from error
    if len(las.points) < promised:
        raise InputError(f"{path}: truncated: {promised:,} points promised, {len(las.points):,} there")
    rgb = np.stack([np.asarray(las[name]) for name in ("red", "green", "blue")], axis=1)
    eight_bit = int(rgb.max(initial=0)) <= 255
    notes = (Note("eight_bit_colors", len(rgb), "8-bit colours in 16-bit fields"),) if eight_bit else ()
    colors = rgb / np.float32(255 if eight_bit else 65535)
    positions = np.stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)], axis=1)
    return finite_cloud(path, positions, colors.astype(np.float32), notes)
