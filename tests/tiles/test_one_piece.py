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
from g2ard.stages.simplify.gaps import opacity_lost
from helpers.commands import CommandLine, succeeds
from helpers.photos import photographed
from helpers.scenes import checkered_ball, under_a_sky
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


def both(command_line: CommandLine, folder: Path, *call: object, output: str) -> list[dict[str, Any]]:
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
    views, splits = ring(16), ["train"] * 12 + ["test"] * 4
    g2ard.save_views(folder / "views.json", views, splits=splits)
    g2ard.save_views(folder / "photos.json", photographed(folder, dense, views), splits=splits)
    return folder


@pytest.mark.parametrize("name", SCENES)
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


INPUTS = {
    "object": ("object.ply",),
    "landscape": ("landscape.ply",),
    "views": ("landscape.ply", "--views", "views.json"),
    "photos": ("landscape.ply", "--views", "photos.json"),
    "cloud": ("cloud.ply",),
    "cloud and photos": ("cloud.ply", "--views", "photos.json"),
}


@pytest.mark.parametrize("name", INPUTS)
def test_runs_have_the_same_parts(name: str, inputs: Path, command_line: CommandLine, tmp_path: Path) -> None:
    """Views of as many kinds, each weighing as much: as usual ones, others cost 1.5 dB."""
    folder = shutil.copytree(inputs, tmp_path / "there")
    call = ("distill", *INPUTS[name], "-r", 10, "--steps", 30, "--size", 64, "--no-page", "--keep")
    one, other = both(command_line, folder, *call, output="")
    assert keys(other) - keys(one) == {".tiles", ".peak_rss_bytes", ".rounds[].simplify.tiles"}
    assert keys(one) - keys(other) == {f".rounds[].simplify{key}" for key in UNCOUNTED}
    for key in ("against", "size", "lifted", "preset", "photos", "cleaned", "input_count", "output_count"):
        assert one[key] == other[key], key
    assert [kind["kind"] for kind in one["kinds"]] == [kind["kind"] for kind in other["kinds"]]
    views, tiled = (read_view_set(folder / way / "views.json") for way in WAYS)
    counts = [Counter(zip(v.cameras.kinds, v.splits, strict=True)) for v in (views, tiled)]
    assert counts[0].keys() == counts[1].keys()
    for key, count in counts[0].items():
        assert abs(counts[1][key] - count) <= 0.1 * count + 2, counts
    shown = g2ard.load(folder / "object.ply" if name == "object" else folder / "landscape.ply")
    shown = shown if name != "cloud" else g2ard.lift(*vars(g2ard.load_points(folder / "cloud.ply")).values())
    bare = replace(views.cameras, image_paths=())
    targets = TeacherRenders(shown, bare.take([i for i, split in enumerate(views.splits) if split == "test"]))
    for file in ("simplified/scene.ply", "scene.ply"):
        scores = [g2ard.evaluate(g2ard.load(folder / way / file), targets).psnr for way in WAYS]
        assert scores[1] > scores[0] - _LOST_BY_FEW, scores
