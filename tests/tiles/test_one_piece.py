"""One piece and tiles: all that differs is listed in docs/methods/tiles.md."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.io import read_view_set, write_points
from g2ard.io.types import Points
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.simplify.gaps import opacity_lost
from g2ard.tiles.ingest import ingest
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed
from helpers.ply_files import save
from helpers.scenes import around, checkered_ball, under_a_sky
from helpers.skies import courtyard
from helpers.tiled_scenes import ring, town

SCENES: dict[str, Callable[[], Splats]] = {
    "object": lambda: checkered_ball(2000),
    "landscape": lambda: town(2000),
    "sky": lambda: under_a_sky(checkered_ball(1800), 200),
    "courtyard": lambda: courtyard(0.24),
    "map": lambda: replace(town(2000), offset=np.array([5e5, 5e6, 300.0])),
}

WAYS: dict[str, tuple[object, ...]] = {"whole": (), "tiles": ("--tile-rows", 700, "--workers", 1)}

_LOST, _LOST_BY_FEW = 0.7, 1.2
"""PSNR in dB that tiles of some hundred Gaussians may cost."""

UNCOUNTED = {".skipped.sh_bands"}
"""Values that reports of tiles do not count."""


def both(
    command_line: CommandLine, folder: Path, *call: object, output: str
) -> list[dict[str, Any]]:
    """Run a command in one piece and in tiles, and return the report of each."""
    reports = []
    for way, options in WAYS.items():
        told = folder / f"{way}.json"
        succeeds(command_line, folder, *call, *options, "-o", f"{way}{output}", "--json", told)
        reports.append(json.loads(told.read_text()))
    return reports


def keys(report: Any, name: str = "") -> set[str]:
    """Return the paths of all values of a report, with one entry for each list."""
    if isinstance(report, dict):
        return {name}.union(*(keys(value, f"{name}.{key}") for key, value in report.items()))
    if isinstance(report, list) and report and isinstance(report[0], dict):
        return keys(report[0], f"{name}[]")
    return {name}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    for name, make in SCENES.items():
        g2ard.save(folder / f"{name}.ply", make())
    dense = g2ard.load(folder / "landscape.ply")
    colors = np.clip(0.5 + 0.28 * dense.sh0[:, 0], 0, 1)
    write_points(folder / "cloud.ply", Points(dense.means.astype(float), colors))
    save(
        folder / "bare.ply", dict(zip("xyz", dense.means.T.astype(float), strict=True)), dtype="f8"
    )
    g2ard.save_views(folder / "around.json", around(24, (64, 48)))
    views, splits = ring(16), ["train"] * 12 + ["test"] * 4
    g2ard.save_views(folder / "views.json", views, splits=splits)
    g2ard.save_views(folder / "photos.json", photographed(folder, dense, views), splits=splits)
    return folder


@pytest.mark.parametrize("name", [name for name in SCENES if name != "landscape"])  # "map" is one
def test_simplified_scenes_look_alike(
    name: str, inputs: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    """Also where colours are fitted, from 20×: without that, tiles lose 1 dB."""
    dense = g2ard.load(inputs / f"{name}.ply")
    targets = TeacherRenders(dense, g2ard.make_pool(dense, 12, size=(120, 90)))
    call = ("simplify", inputs / f"{name}.ply", "-r", "10,30")
    whole, tiles = both(command_line, tmp_path, *call, output="{ratio}.ply")
    for ratio, one, other in zip((10, 30), whole["runs"], tiles["runs"], strict=True):
        small, tiled = (g2ard.load(tmp_path / f"{way}{ratio}.ply") for way in WAYS)
        assert len(small) == len(tiled) == one["output_count"]
        assert keys(other) - keys(one) == {".tiles"}
        assert keys(one) - keys(other) == UNCOUNTED
        assert one["warnings"] == other["warnings"]
        scores = [g2ard.evaluate(each, targets).psnr for each in (small, tiled)]
        assert scores[1] > scores[0] - _LOST, scores
        lost = opacity_lost(dense, tiled, targets.cameras)
        assert other["opacity_lost"] == pytest.approx(lost, rel=0.5, abs=0.005)


METHODS = {
    "fast": ("--method", "fast"),
    "fast, seen": ("--method", "fast", "--views", "views.json"),
    "paper": ("--preset", "paper"),
    "two steps": ("--set", "simplify.morton_premerge_steps=2"),
}


@pytest.mark.parametrize("name", METHODS)
def test_every_method_works_in_tiles(
    name: str, inputs: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "there")
    dense = g2ard.load(folder / "landscape.ply")
    targets = TeacherRenders(dense, g2ard.make_pool(dense, 12, size=(120, 90)))
    both(
        command_line, folder, "simplify", "landscape.ply", "-n", 200, *METHODS[name], output=".ply"
    )
    small = [g2ard.load(folder / f"{way}.ply") for way in WAYS]
    assert [len(each) for each in small] == [200, 200]
    scores = [g2ard.evaluate(each, targets).psnr for each in small]
    assert scores[1] > scores[0] - _LOST_BY_FEW, scores


def test_rounds_begin_where_memory_holds_them(
    inputs: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    call = ("distill", inputs / "object.ply", "-n", 300, "--preset", "paper", "--no-page")
    given = ("--views", inputs / "around.json", "--focus", "far")
    few = ("--set", "recover.schedule.round_steps=5", "--steps", 10)
    one, other = both(command_line, tmp_path, *call, *given, *few, output="")
    counts, tiled = ([entry["count"] for entry in report["rounds"]] for report in (one, other))
    assert tiled == [count for count in counts if count <= 700]
    assert len(tiled) > 1
    # flags of the tiles reach the next round
    assert other["rounds"][1]["simplify"]["protected"] > 0
    psnr = [report["scores"]["recovered"]["psnr"] for report in (one, other)]
    assert psnr[1] > psnr[0] - _LOST_BY_FEW, psnr


def test_clutter_is_removed_alike(inputs: Path, command_line: CommandLine, tmp_path: Path) -> None:
    dense = g2ard.load(inputs / "landscape.ply")
    rng = np.random.default_rng(1)
    giant = Splats.create(np.zeros((1, 3)), scales=np.full((1, 3), 40.0), logit_opacities=[-3])
    some = dense.take(rng.integers(0, 2000, 400))
    dust = replace(some, scales=some.scales / 50, logit_opacities=np.full(400, -4.0, np.float32))
    g2ard.save(tmp_path / "cluttered.ply", join([dense, giant, dust]))
    call = (
        "distill",
        "cluttered.ply",
        "-n",
        300,
        "--clean",
        "--steps",
        10,
        "--size",
        64,
        "--no-page",
    )
    given = ("--views", inputs / "views.json", "--focus", "far")
    one, other = both(command_line, tmp_path, *call, *given, output="")
    for kind, count in one["cleaned"].items():
        assert other["cleaned"][kind] == pytest.approx(count, rel=0.1, abs=8), (kind, one, other)
    assert other["cleaned"]["giant"] == 1
    assert other["cleaned"]["invisible"] > 150
    psnr = [report["scores"]["recovered"]["psnr"] for report in (one, other)]
    assert psnr[1] > psnr[0] - _LOST_BY_FEW, psnr


@pytest.mark.parametrize("tiles", [False, True])
def test_parents_are_of_the_rows_of_the_file(
    tiles: bool, inputs: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    source = tmp_path / "scene.ply"
    head, end, data = (inputs / "landscape.ply").read_bytes().partition(b"end_header\n")
    values = np.frombuffer(data, "<f4").reshape(2000, -1).copy()
    values[::7, 4] = np.nan  # rows that are not read
    source.write_bytes(head + end + values.tobytes())
    if tiles:
        source = ingest(source, tmp_path / "tiles", tile_rows=700).folder
    rows = g2ard.load(source)
    call = (
        "simplify",
        source,
        "-n",
        200,
        "--no-views",
        "--parents",
        "parents.npy",
        *WAYS["tiles"][2:],
    )
    most = () if tiles else WAYS["tiles"][:2]
    succeeds(command_line, tmp_path, *call, *most, "-o", "small.ply")
    small, parents = g2ard.load(tmp_path / "small.ply"), np.load(tmp_path / "parents.npy")
    assert parents.shape == (len(rows),)
    assert set(parents) - {-1} == set(range(200))
    away = np.linalg.norm(rows.means - small.means[parents], axis=1)[parents >= 0]
    assert (
        np.median(away)
        < 0.6
        < np.median(np.linalg.norm(rows.means - small.means[::-1][parents], axis=1))
    )


INPUTS = {
    "object": ("object.ply",),
    "views": ("landscape.ply", "--views", "views.json"),
    "photos": ("landscape.ply", "--views", "photos.json"),
    "cloud": ("cloud.ply",),
    "cloud and photos": ("cloud.ply", "--views", "photos.json"),
    "cloud without colours": ("bare.ply", "--views", "photos.json"),
}


@pytest.mark.parametrize("name", INPUTS)
def test_runs_have_the_same_parts(
    name: str, inputs: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    """Views of as many kinds, each weighing as much: as usual ones, others cost 1.5 dB."""
    folder = shutil.copytree(inputs, tmp_path / "there")
    call = ("distill", *INPUTS[name], "-r", 10, "--steps", 30, "--size", 64, "--no-page", "--keep")
    one, other = both(command_line, folder, *call, output="")
    assert keys(other) - keys(one) == {".tiles", ".peak_rss_bytes", ".rounds[].simplify.tiles"}
    assert keys(one) - keys(other) == {f".rounds[].simplify{key}" for key in UNCOUNTED}
    for key in (
        "against",
        "size",
        "lifted",
        "preset",
        "photos",
        "cleaned",
        "input_count",
        "output_count",
    ):
        assert one[key] == other[key], key
    assert [kind["kind"] for kind in one["kinds"]] == [kind["kind"] for kind in other["kinds"]]
    views, tiled = (read_view_set(folder / way / "views.json") for way in WAYS)
    counts = [Counter(zip(v.cameras.kinds, v.splits, strict=True)) for v in (views, tiled)]
    assert counts[0].keys() == counts[1].keys()
    for key, count in counts[0].items():
        assert abs(counts[1][key] - count) <= 0.1 * count + 2, counts
    shown = g2ard.load(folder / "object.ply" if name == "object" else folder / "landscape.ply")
    shown = (
        shown
        if name != "cloud"
        else g2ard.lift(*vars(g2ard.load_points(folder / "cloud.ply")).values())
    )
    bare = replace(views.cameras, image_paths=())
    targets = TeacherRenders(
        shown, bare.take([i for i, split in enumerate(views.splits) if split == "test"])
    )
    least: list[float] = []
    for file in ("simplified/scene.ply", "scene.ply"):
        scores = [g2ard.evaluate(g2ard.load(folder / way / file), targets).psnr for way in WAYS]
        least.append(scores[0])  # so few steps gain, or the guard takes them back
        assert scores[1] > min(least) - _LOST_BY_FEW, scores


def test_points_without_colours_need_photos(
    inputs: Path, command_line: CommandLine, tmp_path: Path
) -> None:
    for command, output in (("simplify", "out.ply"), ("distill", "out")):
        call = (command, inputs / "bare.ply", "-n", 200, *WAYS["tiles"], "-o", output)
        told = refused(command_line, tmp_path, *call, status=1)
        assert "add colours" in told
        assert told.count("\n") == 1
        assert not list(tmp_path.iterdir())
