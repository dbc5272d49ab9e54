"""Writer for 3D Tiles 1.1: a tree of .glb files with SPZ, coarse levels above fine ones, for CesiumJS.

A tile shows one level in one node of the kd-tree. It is replaced by tiles of the next finer level, in the
node's children or in the leaf itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard._core import __version__
from g2ard.arrays import Float, Int
from g2ard.config.checks import Finite, Within
from g2ard.config.schema import Settings
from g2ard.errors import InputError, missing
from g2ard.io.glb import EXTENSION, SPZ_EXTENSION, spz_glb
from g2ard.io.packing import writable
from g2ard.io.paths import naming
from g2ard.io.scene_formats import Rounding
from g2ard.io.spz import check_far
from g2ard.io.types import Note
from g2ard.levels.streamed_sog import read_object, replaced, write_json
from g2ard.levels.tree import Cut, Level, Node, aligned
from g2ard.levels.tree import cut as cut_tree
from g2ard.progress import Progress, silent
from g2ard.scene.shape import longer_axes
from g2ard.scene.splats import Splats
from g2ard.scene.transform import unit_up

TILE_OF_SCENE = np.array(
    [
        [-1.0, 0, 0],
        [0, 0, -1],
        [0, -1, 0],
    ]
)
"""Rotation from the scene's axes to a tile's: glTF's (half a turn about z), then z up instead of y."""

_SCREEN_SPACE_ERROR = 16.0
"""Error on the screen in pixels at which viewers refine a tile by default (maximumScreenSpaceError)."""

_WGS84_RADIUS = 6378137.0  # major half axis of the ellipsoid WGS 84 in metres

_WGS84_FLATTENING = 1 / 298.257223563  # flattening of the ellipsoid WGS 84


@dataclass(frozen=True)
class Georeference(Settings):
    """Place of the scene's local origin, its `offset`, on the ellipsoid WGS 84.

    Args:
        longitude, latitude: degrees.
        height: metres above the ellipsoid.
        heading: direction of the scene's y axis if z is up, of z if −y is up, degrees clockwise from north.

    Raises:
        InputError: a value out of range.
    """

    longitude: Annotated[float, Within("[-180, 180]")]
    latitude: Annotated[float, Within("[-90, 90]")]
    height: Finite
    heading: Finite = 0.0

    @classmethod
    def of_map(cls, system: Any, offset: ArrayLike) -> Georeference:
        """Return the place of an offset in map coordinates, with the direction of grid north as heading.

        The offset is easting, northing and height in the unit of a system of `map_system`.
        """
        import pyproj

        east, north, height = np.asarray(offset, float).tolist()
        if len(system.axis_info) == 2:  # heights of such a system are metres to pyproj
            height *= metres_of(system)
        to_globe = pyproj.Transformer.from_crs(system, "EPSG:4979", always_xy=True)
        lon, lat, up = to_globe.transform(east, north, height)
        ahead_lon, ahead_lat, _ = to_globe.transform(east, north + 100, height)
        ellipsoid = pyproj.Geod(ellps="WGS84")
        heading, _, _ = ellipsoid.inv(lon, lat, ahead_lon, ahead_lat)
        place = cls(lon, lat, up)
        return replace(place, heading=heading)

    def matrix(self) -> Float:
        """Return the (4, 4) matrix from x, y (along the heading), z up to earth-centred coordinates."""
        angles = np.radians((self.longitude, self.latitude, self.heading))
        sin_lon, sin_lat, sin_turn = np.sin(angles)
        cos_lon, cos_lat, cos_turn = np.cos(angles)
        east = np.array([-sin_lon, cos_lon, 0])
        up = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
        north = np.cross(up, east)
        squared = _WGS84_FLATTENING * (2 - _WGS84_FLATTENING)
        normal = _WGS84_RADIUS / np.sqrt(1 - squared * sin_lat**2)
        matrix = np.eye(4)
        matrix[:3, 0] = cos_turn * east - sin_turn * north
        matrix[:3, 1] = sin_turn * east + cos_turn * north
        matrix[:3, 2] = up
        matrix[:3, 3] = (normal + self.height) * up
        matrix[2, 3] -= squared * normal * sin_lat
        return matrix


def map_system(name: str) -> Any:
    """Return pyproj's coordinate system of a name such as EPSG:32635, projected and of one unit."""
    try:
        import pyproj
    except ImportError as error:
        raise missing("a coordinate system by name", "pyproj", parameter="place") from error
    try:
        system = pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError:
        text = f"unknown coordinate system {name!r}; expected EPSG:CODE"
        raise InputError(text, parameter="place") from None
    units = {axis.unit_conversion_factor for axis in system.axis_info}
    if not system.is_projected or len(units) > 1:
        raise InputError(
            f"{system.name} is not a projected system of one unit",
            parameter="place",
            hint="give another EPSG:CODE, or LON,LAT,HEIGHT",
        )
    return system


def metres_of(system: Any) -> float:
    """Return the metres of the unit of a system of `map_system`."""
    return float(system.axis_info[0].unit_conversion_factor)


def is_outside(system: Any, place: Georeference) -> bool:
    """Return whether a place lies outside the area that a system of `map_system` is made for."""
    area = system.area_of_use
    if area is None:
        return False
    width = (area.east - area.west) % 360
    if (place.longitude - area.west) % 360 > width:
        return True
    return not area.south <= place.latitude <= area.north


def save_tileset(
    path: str | Path,
    levels: Sequence[Level],
    *,
    axis: ArrayLike,
    place: Georeference | None = None,
    unit: float = 1.0,
    cut: Cut | None = None,
    overwrite: bool = False,
    work: Path | None = None,
    progress: Progress = silent,
) -> tuple[int, list[Note]]:
    """Write `tileset.json` and `LEVEL_N.glb`; see `g2ard.jobs.levels.save_tileset`, with `up` and `place`
    decided. Return bytes and notes."""
    path = Path(path)
    rule = cut or Cut()
    levels, error, moved = aligned(levels)
    tree = cut_tree(levels, rule, work)
    tiles = _Tiles(
        levels,
        rule.most,
        path,
        Rounding(moved),
        error,
    )
    parts = tiles.of(tree, len(levels) - 1)
    size = float(np.linalg.norm(tree.high - tree.low))
    root = parts[0]
    if len(parts) > 1:
        root = _describe_tile(tree, size, parts)
    matrix = np.eye(4)
    if place is not None:
        matrix = place.matrix()
    turn = np.eye(4)
    turn[:3, :3] = unit * _turn_upright(axis) @ TILE_OF_SCENE.T
    root["transform"] = (matrix @ turn).T.ravel().tolist()
    extensions = [EXTENSION, SPZ_EXTENSION]
    tileset = {
        "asset": {"version": "1.1", "generator": f"g2ard {__version__}"},
        "extras": {"counts": [len(level) for level in levels]},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {
            "3DTILES_content_gltf": {
                "extensionsUsed": extensions,
                "extensionsRequired": extensions,
            }
        },
        "geometricError": unit * max(size, root["geometricError"]),
        "root": root,
    }
    with replaced(path, overwrite, _list_named(path / "tileset.json")) as (folder, written):
        for number, name in enumerate(tiles.files, start=1):
            (folder / name).write_bytes(b"".join(tiles.content(name)))
            progress("write", number, len(tiles.files))
        write_json(folder / "tileset.json", tileset)
    return sum(written.values()), tiles.rounding.notes


def check_tiles(
    path: Path,
    splats: Splats,
    ratio: float,
    cut: Cut | None = None,
) -> None:
    """Raise the `InputError` of a tile with far rows, before the levels are made.

    The coarsest level, reduced by `ratio`, is one tile of the whole scene unless it exceeds the rule.
    """
    if len(splats) > ratio * (cut or Cut()).most:
        return
    means = splats.means.astype(float)
    middle = np.rint((means.min(axis=0) + means.max(axis=0)) / 2)
    with naming(path):
        check_far(splats, means - middle, ratio**0.5, movable=True)


def _turn_upright(direction: ArrayLike) -> Float:
    """Return the (3, 3) rotation of `up` to z, which keeps x in the plane of x and z."""
    axis = unit_up(direction)
    across = 0 if abs(axis[0]) < 0.9 else 1
    east = np.eye(3)[across]
    east -= (east @ axis) * axis
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(axis, east), axis])


@dataclass
class _Tiles:
    """The tiles of a tree, the rows of their files, and the rounding in them and before (`error`)."""

    levels: Sequence[Level]
    most: int
    path: Path
    rounding: Rounding
    error: float
    files: dict[str, tuple[int, list[Int], Float]] = field(default_factory=dict)

    def of(self, node: Node, level: int) -> list[dict[str, Any]]:
        """Return tiles that together show a level, or finer ones where it is empty, and all below it."""
        rows = [leaf.rows[level] for leaf in node.leaves()]
        count = sum(map(len, rows))
        finer = []
        if count > self.most and node.children:
            for part in node.children:
                finer += self.of(part, level)
            return finer
        if level:
            for part in node.children or (node,):
                finer += self.of(part, level - 1)
        if not count:
            return finer
        error = 0.0
        if finer:
            error = max(tile["geometricError"] for tile in finer)
            error = max(error, self._error(level, rows))
        name = f"{level}_{len(self.files)}.glb"
        self.files[name] = level, rows, (node.low + node.high) / 2
        return [_describe_tile(node, error, finer) | {"content": {"uri": name}}]

    def _error(self, level: int, rows: list[Int]) -> float:
        """Return 16 standard deviations of the median Gaussian, along its two longer axes."""
        splats = self.levels[level].take(np.concatenate(rows))
        axes = longer_axes(splats.scales).astype(float)
        sigmas = np.sqrt(axes.prod(axis=1))
        return _SCREEN_SPACE_ERROR * float(np.median(sigmas))

    def content(self, name: str) -> list[bytes]:
        """Return the .glb of a tile, whose node is moved to the middle of its box."""
        level, rows, middle = self.files[name]
        some = self.levels[level].take(np.concatenate(rows))
        splats = replace(some, offset=np.zeros(3), axes="RDF")
        with naming(self.path / name):
            parts, error = spz_glb(writable(splats), np.rint(middle))
        self.rounding.add(self.error + error, splats)
        return parts


def _describe_tile(
    node: Node,
    error: float,
    children: list[dict[str, Any]],
) -> dict[str, Any]:
    middle = TILE_OF_SCENE @ (node.low + node.high) / 2
    half = np.abs(TILE_OF_SCENE @ (node.high - node.low)) / 2
    half_axes = np.diag(half).ravel()
    tile: dict[str, Any] = {
        "boundingVolume": {"box": [*middle.tolist(), *half_axes.tolist()]},
        "geometricError": error,
        "refine": "REPLACE",
    }
    if children:
        tile["children"] = children
    return tile


def _list_named(file: Path) -> set[Path]:
    """Return the names of the .glb files beside a tileset.json that it names."""
    tiles = [read_object(file).get("root", {})]
    named = set()
    while tiles:
        tile = tiles.pop()
        tiles += tile.get("children", [])
        name = str(tile.get("content", {}).get("uri", ""))
        if name.endswith(".glb") and "/" not in name and "\\" not in name:
            named.add(Path(name))
    return named
