"""LiDAR clouds, .las and .laz, through laspy with lazrs."""

from __future__ import annotations

import struct
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
        import lazrs  # noqa: F401 - what laspy reads .laz with
    except ImportError as error:
        raise MissingDependencyError(f"{path}: .las and .laz need `pip install g2ard[las]`") from error
    _check_records(path)
    try:
        with laspy.open(path) as reader:
            header = reader.header
            names = set(header.point_format.dimension_names)
            if not {"red", "green", "blue"} <= names:
                raise InputError(
                    f"{path}: its point format {header.point_format.id} has no 'red', 'green', 'blue'"
                )
            if header.are_points_compressed:
                _check_chunk_table(path, header.offset_to_point_data, header.point_count)
            else:
                _check_size(path, header.offset_to_point_data, header.point_count, header.point_format.size)
            las = reader.read()
    except InputError:
        raise
    except Exception as error:  # on damaged headers laspy raises whatever its parsing stumbles over
        raise InputError(f"{path}: cannot be read as LAS: {error}") from error
    if len(las.points) < header.point_count:
        raise InputError(
            f"{path}: truncated: {header.point_count:,} points promised, {len(las.points):,} there"
        )
    rgb = np.stack([np.asarray(las[name]) for name in ("red", "green", "blue")], axis=1)
    eight_bit = int(rgb.max(initial=0)) <= 255
    notes = (Note("eight_bit_colors", len(rgb), "8-bit colours in 16-bit fields"),) if eight_bit else ()
    colors = rgb / np.float32(255 if eight_bit else 65535)
    positions = np.stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)], axis=1)
    return finite_cloud(path, positions, colors.astype(np.float32), notes)


def _check_records(path: Path) -> None:
    """Refuse a count of variable-length records that the file has no room for: laspy would try them all."""
    with path.open("rb") as file:
        head = file.read(375).ljust(375, b"\0")
    if head[:4] != b"LASF":
        raise InputError(f"{path}: cannot be read as LAS (begins with {head[:4]!r})")
    points_at, records = struct.unpack_from("<II", head, 96)
    (extended,) = struct.unpack_from("<I", head, 243) if head[25] >= 4 else (0,)
    if records * 54 > points_at or extended * 60 > path.stat().st_size:
        raise InputError(f"{path}: broken header: {records + extended:,} variable-length records")


def _check_size(path: Path, points_at: int, promised: int, point_size: int) -> None:
    there = max(0, path.stat().st_size - points_at) // point_size
    if there < promised:
        raise InputError(f"{path}: truncated: {promised:,} points promised, {there:,} there")


def _check_chunk_table(path: Path, points_at: int, promised: int) -> None:
    """Refuse a table of more chunks than points: lazrs would end the whole process for want of memory."""
    with path.open("rb") as file:
        file.seek(points_at)
        (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        size = file.seek(0, 2)
        if table == -1:  # written without seeking back: its place is the last thing in the file
            file.seek(-8, 2)
            (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if not points_at < table <= size - 8:
            raise InputError(f"{path}: truncated: its chunk table is cut off")
        file.seek(table)
        _version, chunks = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    if chunks > max(promised, 1):
        raise InputError(f"{path}: broken chunk table: {chunks:,} chunks for {promised:,} points")
