"""3D Tiles: the tree, what each tile holds, and where it stands on the globe."""

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.jobs.levels import lod, save_tileset
from g2ard.levels import Cut, Georeference
from g2ard.levels.tileset import map_system
from g2ard.scene.splats import Splats
from helpers.commands import CommandLine, refused, succeeds
from helpers.glb_files import glb_parts
from helpers.level_files import scattered
from helpers.scenes import checkered_ball

UTM = (443_000.0, 5_411_000.5, 120.25)


def tiles_of(tile: dict, level: int = 0) -> list[tuple[dict, dict | None]]:
    """All tiles below and with this one, each with its parent."""
    below = [(child, tile) for child in tile.get("children", [])]
    return [*below, *(found for child, _ in below for found in tiles_of(child))]


def ends(tile: dict) -> tuple[np.ndarray, np.ndarray]:
    box = np.array(tile["boundingVolume"]["box"])
    half = np.abs(box[3:].reshape(3, 3)).sum(0)
    return box[:3] - half, box[:3] + half


def points_of(file: Path) -> np.ndarray:
    """Means of a tile in its own axes, z up: from the node's matrix and the SPZ, as CesiumJS does."""
    document, binary = glb_parts(file)
    view = document["bufferViews"][0]
    inside = file.with_suffix(".spz")
    inside.write_bytes(binary[: view["byteLength"]])
    stored = read_splats(inside).means * (1, -1, -1)
    inside.unlink()
    x, y, z = (stored + document["nodes"][0]["matrix"][12:15]).T
    return np.stack([x, -z, y], axis=1)


@pytest.mark.parametrize("rule", [Cut(), Cut(most=300), Cut(most=30), Cut(extent=2, least=20)])
def test_each_level_is_whole_and_tiles_shrink_downwards(tmp_path: Path, rule: Cut) -> None:
    levels = [scattered(900), scattered(400, 1), scattered(150, 2), scattered(40, 3)]
    size = save_tileset(tmp_path, levels, up=(0, 0, 1), cut=rule)
    tileset = json.loads((tmp_path / "tileset.json").read_text())
    assert size == sum(file.stat().st_size for file in tmp_path.iterdir())
    root = tileset["root"]
    assert root["geometricError"] <= tileset["geometricError"]
    counts = [0] * 4
    for tile, parent in [(root, None), *tiles_of(root)]:
        low, high = ends(tile)
        if parent is not None:
            assert tile["geometricError"] <= parent["geometricError"]
            assert (low >= ends(parent)[0] - 1e-6).all()
            assert (high <= ends(parent)[1] + 1e-6).all()
        assert tile["refine"] == "REPLACE"
        assert ("children" in tile) == (tile["geometricError"] > 0)
        if "content" not in tile:
            assert tile is root
            continue
        points = points_of(tmp_path / tile["content"]["uri"])
        assert len(points) <= max(rule.most, 1)
        assert (points >= low - 1e-3).all()
        assert (points <= high + 1e-3).all()
        counts[int(tile["content"]["uri"][0])] += len(points)
    assert counts == [900, 400, 150, 40]
    save_tileset(tmp_path, levels[:1], up=(0, 0, 1), overwrite=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["0_0.glb", "tileset.json"]


def geocentric(lon: float, lat: float, height: float) -> np.ndarray:
    """WGS 84 by its two half axes, in the order of a textbook."""
    a, b = 6378137.0, 6356752.314245179
    lon, lat = np.radians((lon, lat))
    n = a * a / np.hypot(a * np.cos(lat), b * np.sin(lat))
    r = (n + height) * np.cos(lat)
    return np.array(
        [r * np.cos(lon), r * np.sin(lon), (b * b / (a * a) * n + height) * np.sin(lat)]
    )


@pytest.mark.parametrize("heading", [0.0, 90.0, 200.0])
@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 1, 0)])
def test_points_lie_where_the_georeference_says(tmp_path: Path, up: tuple, heading: float) -> None:
    forward = {(0, 0, 1): (0, 1, 0), (0, -1, 0): (0, 0, 1), (0, 1, 0): (0, 0, -1)}[up]
    means = np.float32([(0, 0, 0), np.multiply(40, forward), np.multiply(25, up), (30, 0, 0)])
    scene = Splats.create(means, scales=np.full((4, 3), 0.5), offset=UTM)
    lon, lat, height = 24.75, 59.43, 31.5
    save_tileset(tmp_path, [scene], up=up, place=Georeference(lon, lat, height, heading))
    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    found = points_of(tmp_path / root["content"]["uri"]) @ matrix[:3, :3].T + matrix[:3, 3]
    step = 1e-5
    north = (geocentric(lon, lat + step, height) - geocentric(lon, lat - step, height)) / 2
    east = (geocentric(lon + step, lat, height) - geocentric(lon - step, lat, height)) / 2
    north, east = north / np.linalg.norm(north), east / np.linalg.norm(east)
    angle = np.radians(heading)
    ahead = np.cos(angle) * north + np.sin(angle) * east
    right = np.cos(angle) * east - np.sin(angle) * north
    origin = geocentric(lon, lat, height)
    wanted = {(0, 0, 0): origin, (30, 0, 0): origin + 30 * right}
    wanted[tuple(means[1])] = origin + 40 * ahead
    wanted[tuple(means[2])] = geocentric(lon, lat, height + 25)
    for point in wanted.values():
        assert np.linalg.norm(found - point, axis=1).min() < 1e-3


def test_an_impossible_place_is_refused() -> None:
    with pytest.raises(InputError, match="latitude: expected"):
        Georeference(0, 91, 0)
    with pytest.raises(InputError, match="heading: expected"):
        Georeference(0, 0, 0, float("nan"))


def test_a_map_system_gives_the_place_and_grid_north(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    middle = Georeference.of_map(map_system("EPSG:32635"), (500_000, 6_590_000, 12))
    assert (middle.longitude, middle.height) == (pytest.approx(27, abs=1e-9), 12)
    assert middle.heading == pytest.approx(0, abs=1e-6)
    east = Georeference.of_map(map_system("EPSG:32635"), (620_000, 6_590_000, 0))
    turned = np.degrees(
        np.arctan(np.tan(np.radians(east.longitude - 27)) * np.sin(np.radians(east.latitude)))
    )
    assert east.heading == pytest.approx(turned, abs=2e-3)
    for name, message in (
        ("EPSG:4326", "not a projected"),
        ("X", "unknown"),
    ):
        with pytest.raises(InputError, match=message):
            map_system(name)


def test_a_map_system_in_feet_gives_metres(tmp_path: Path) -> None:
    pyproj = pytest.importorskip("pyproj")
    offset = np.array((637_000.0, 851_000.0, 400.0))  # Autzen, Oregon
    scene = Splats.create([(0, 0, 0), (1000, 0, 0)], scales=np.full((2, 3), 5), offset=offset)
    told: list[str] = []
    save_tileset(tmp_path, [scene], up=(0, 0, 1), place="EPSG:2994", say=told.append)
    assert not any("warning" in line for line in told)
    matrix = (
        np.array(json.loads((tmp_path / "tileset.json").read_text())["root"]["transform"])
        .reshape(4, 4)
        .T
    )
    lon, lat = pyproj.Transformer.from_crs("EPSG:2994", "EPSG:4326", always_xy=True).transform(
        *offset[:2]
    )
    np.testing.assert_allclose(matrix[:3, 3], geocentric(lon, lat, 400 * 0.3048), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(matrix[:3, 0]), 0.3048)
    save_tileset(
        tmp_path, [scene], up=(0, 0, 1), place="EPSG:3301", overwrite=True, say=told.append
    )
    assert "warning: the scene lies outside the area of EPSG:3301" in "\n".join(told)


@pytest.mark.parametrize(
    ("unit", "metres"), [("", 1), ("--unit ft", 0.3048), ("--unit us-ft", 1200 / 3937)]
)
def test_the_unit_scales_the_tiles(
    unit: str, metres: float, tmp_path: Path, command_line: CommandLine
) -> None:
    write_splats(tmp_path / "a.ply", checkered_ball(400))
    words = [
        "lod",
        "a.ply",
        "-r",
        "1",
        "--merge-only",
        "--size",
        "48",
        "--format",
        "3dtiles",
        "-o",
        "out",
    ]
    error = succeeds(command_line, tmp_path, *words, "--georeference", "0,0,0", *unit.split()).err
    assert ("if its unit is the metre; --unit ft otherwise" in error) == (not unit)
    assert "m across" in error
    tileset = json.loads((tmp_path / "out" / "tileset.json").read_text())
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(np.linalg.norm(matrix[:3, :3], axis=0), metres)
    assert tileset["geometricError"] == pytest.approx(metres * 2 * 3**0.5, rel=0.3)
    assert "--unit needs" in refused(command_line, tmp_path, *words[:-1], "b", "--unit", "ft")


def test_the_unit_of_a_scan_is_used(tmp_path: Path, command_line: CommandLine) -> None:
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, 1e-3)
    header.vlrs.append(
        laspy.vlrs.known.WktCoordinateSystemVlr('PROJCS["Oregon",UNIT["foot",0.3048]]')
    )
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = checkered_ball(400).means.T
    scan.red = scan.green = scan.blue = np.arange(400) * 99
    scan.write(str(tmp_path / "a.las"))
    ask = (
        "lod",
        "a.las",
        "-r",
        "1",
        "--merge-only",
        "--tile-rows",
        200,
        "--format",
        "3dtiles",
        "-o",
        "out",
    )
    error = succeeds(command_line, tmp_path, *ask, "--georeference", "0,0,0").err
    assert "if its unit" not in error
    matrix = json.loads((tmp_path / "out" / "tileset.json").read_text())["root"]["transform"]
    np.testing.assert_allclose(np.linalg.norm(matrix[:3]), 0.3048)


def test_the_command_writes_3d_tiles(tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "a.ply", replace(checkered_ball(800), offset=np.array(UTM)))
    words = [
        "lod",
        "a.ply",
        "-r",
        "1,4",
        "--merge-only",
        "--size",
        "48",
        "--format",
        "3dtiles",
        "-o",
    ]
    there = ["--georeference", "24.75,59.43,31.5,45"]
    error = succeeds(command_line, tmp_path, *words, "out", *there).err
    assert "up is 0,0,1" in error
    assert "http://localhost:8000/?cesium=" in error
    tileset = json.loads((tmp_path / "out" / "tileset.json").read_text())
    assert tileset["extras"]["counts"] == [800, 200]
    origin = np.array(tileset["root"]["transform"][12:15])
    np.testing.assert_allclose(origin, geocentric(24.75, 59.43, 31.5), atol=1e-6)
    succeeds(command_line, tmp_path, *words, "tiled", *there, "--tile-rows", "300")
    tiled = json.loads((tmp_path / "tiled" / "tileset.json").read_text())
    assert tiled["root"]["transform"] == tileset["root"]["transform"]
    assert tiled["extras"] == tileset["extras"]
    message = refused(command_line, tmp_path, "lod", "a.ply", "-o", "b", "--georeference", "0,0,0")
    assert "--format 3dtiles" in message
    assert "latitude" in refused(command_line, tmp_path, *words, "c", "--georeference", "0,99,0")


def test_python_decides_up_and_place_as_the_command_does(
    tmp_path: Path, command_line: CommandLine
) -> None:
    pytest.importorskip("pyproj")
    write_splats(tmp_path / "ball.ply", checkered_ball(400))
    ask = (
        "-r",
        "1,4",
        "--merge-only",
        "--size",
        48,
        "--format",
        "3dtiles",
        "--georeference",
        "EPSG:32635",
    )
    succeeds(command_line, tmp_path, "lod", "ball.ply", *ask, "-o", "globe")
    levels = lod(tmp_path / "ball.ply", ratios=(1, 4), recover=False, size=48).splats
    save_tileset(
        tmp_path / "python", levels, place="EPSG:32635", cut=Cut(512 * 1024, 16.0, 8 * 1024)
    )
    for file in (tmp_path / "python").iterdir():
        assert (tmp_path / "globe" / file.name).read_bytes() == file.read_bytes(), file.name
