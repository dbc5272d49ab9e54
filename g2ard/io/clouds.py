"""Reading and writing coloured point clouds of any format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.config.checks import checks_arguments
from g2ard.errors import InputError, OutputError
from g2ard.io.detect import reader

if TYPE_CHECKING:
    from collections.abc import Sequence

    from g2ard.io.stream import PointStream
    from g2ard.io.types import Cloud, Points


@checks_arguments
def read_points(path: str | Path) -> Points:
    """Read a coloured point cloud.

    Args:
        path: .ply with x y z red green blue, .las, .laz, .e57, COLMAP's points3D.bin or .txt, or a COLMAP
            folder.

    Returns:
        Positions in float64, world units; colours in [0, 1].

    Raises:
        InputError: the file is missing, damaged, has no colours, or no finite point.
        MissingDependencyError: .las or .laz without laspy and lazrs, .e57 without pye57.

    >>> import tempfile, g2ard
    >>> path = Path(tempfile.mkdtemp()) / "cloud.ply"
    >>> vertices = "property float x\\nproperty float y\\nproperty float z\\n"
    >>> colours = "property uchar red\\nproperty uchar green\\nproperty uchar blue\\nend_header\\n"
    >>> header = "ply\\nformat ascii 1.0\\nelement vertex 1\\n" + vertices + colours
    >>> _ = path.write_text(header + "1 2 3 255 0 51\\n")
    >>> points = g2ard.load_points(path)
    >>> points.positions.tolist(), points.colors.round(2).tolist()[0][:2]
    ([[1.0, 2.0, 3.0]], [1.0, 0.0])
    """
    return read_cloud(path).points


def read_cloud(path: str | Path) -> Cloud:
    """Read a coloured point cloud with notes on the file."""
    return open_point_stream(path).whole()


def open_point_stream(path: str | Path | Sequence[str | Path]) -> PointStream:
    """Open a coloured point cloud, or several as one, for reading in blocks.

    Memory holds one block of a .ply, .las, .laz or .e57, or the whole file of other formats. Several clouds
    get the offset of the first.
    """
    from g2ard.io.stream import JoinedClouds

    if not isinstance(path, str | Path):
        streams = [open_point_stream(part) for part in path]
        if not streams:
            raise InputError("no point cloud given")
        return streams[0] if len(streams) == 1 else JoinedClouds(streams)
    path, module = reader(path, "points")
    stream: PointStream = module.Stream(path)
    return stream


def write_points(path: str | Path, points: Points, *, overwrite: bool = False) -> None:
    """Write a coloured point cloud as .ply (float64 positions, 8-bit colours) atomically."""
    from g2ard.io import cloud_ply

    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise OutputError("point clouds are written as .ply", path=path)
    cloud_ply.write_blocks(path, len(points), [points], overwrite=overwrite)
