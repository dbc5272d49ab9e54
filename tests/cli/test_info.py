"""`g2ard info`: its figures, and one line for every file that it cannot read."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.io import write_points, write_splats, write_views
from g2ard.io.describe import describe
from g2ard.io.types import Points
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import BALL, photos_of
from helpers.realdata import real
from helpers.scenes import checkered_ball


def scene(path: Path, count: int = 400) -> Splats:
    rng = np.random.default_rng(0)
    splats = Splats.create(
        rng.normal(size=(count, 3)),
        scales=np.exp(rng.normal(-3, 1, (count, 3))),
        logit_opacities=rng.normal(0, 3, count),
        shN=rng.normal(size=(count, 8, 3)),
        offset=(1e6, 0, 0),
    )
    write_splats(path, splats)
    return splats


def test_scene(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    splats = scene(path)
    found = describe(path)
    assert (found["kind"], found["format"], found["count"], found["sh_degree"]) == (
        "splats",
        "ply",
        400,
        2,
    )
    assert found["bytes"] == path.stat().st_size
    assert found["bytes_as_ply"] == 400 * 4 * (14 + 24)
    world = splats.means.astype(np.float32) + splats.offset
    np.testing.assert_allclose(found["extent"]["min"], world.min(0))
    np.testing.assert_allclose(found["extent"]["robust_max"], np.percentile(world, 99, axis=0))
    assert found["opacity"]["50"] == pytest.approx(np.median(splats.opacities))
    assert found["largest_scale"]["100"] == pytest.approx(splats.scales.max(), rel=1e-6)
    assert found["odd"]["opacity_below_0.005"] == (splats.opacities < 0.005).sum() > 0
    assert found["odd"]["same_position_as_another"] == 0


def test_close_views_blend_more_gaussians(tmp_path: Path, command_line: CommandLine) -> None:
    ball = checkered_ball(1000)
    write_splats(tmp_path / "a.ply", ball)
    write_splats(tmp_path / "huge.ply", replace(ball, scales=ball.scales * 4))
    found = {}
    for name in ("a.ply", "huge.ply"):
        printed = succeeds(command_line, tmp_path, "info", name, "--json", "-")
        found[name] = json.loads(printed.out)["close_overdraw"]
        assert 1 < found[name]["mean"] <= found[name]["worst"]
    assert found["huge.ply"]["mean"] > 2 * found["a.ply"]["mean"]
    assert "Gaussians per pixel, near" in succeeds(command_line, tmp_path, "info", "a.ply").out
    write_splats(
        tmp_path / "clear.ply", replace(ball, logit_opacities=np.full(1000, -15, np.float32))
    )
    printed = succeeds(command_line, tmp_path, "info", "clear.ply", "--json", "-")
    assert "close_overdraw" not in json.loads(printed.out)


def test_cloud(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(50, 3)) + 1e6
    write_points(tmp_path / "a.ply", Points(positions, np.full((50, 3), 0.2, np.float32)))
    found = describe(tmp_path / "a.ply")
    assert (found["kind"], found["count"]) == ("points", 50)
    np.testing.assert_array_equal(found["extent"]["max"], positions.max(0))
    np.testing.assert_allclose(found["color"]["mean"], [0.2] * 3, atol=1e-6)


def test_a_scene_in_a_file_of_another_format_is_named(
    tmp_path: Path, command_line: CommandLine
) -> None:
    scene(tmp_path / "a.ply")
    (tmp_path / "a.ply").rename(tmp_path / "a.sog")
    error = refused(command_line, tmp_path, "info", "a.sog", status=1)
    assert error == "g2ard: a.sog: is a .ply file in spite of its name; rename it to a.ply\n"


def test_photos_show_their_split_and_points(tmp_path: Path, command_line: CommandLine) -> None:
    photos_of(tmp_path / "photos", points=True, count=9)
    found = json.loads(succeeds(command_line, tmp_path, "info", "photos", "--json", "-").out)
    assert (found["splits"], found["sparse_points"]) == ({"test": 2, "train": 7}, len(BALL))
    shown = succeeds(command_line, tmp_path, "info", "photos").out
    for row in (f"sparse points +│ {len(BALL):,}", "test +│ 2", "train +│ 7"):
        assert re.search(row, shown)


def test_views(tmp_path: Path) -> None:
    matrices = [look_at([3, i, 1], [0, 0, 0]) for i in range(3)]
    K = [[4, 0, 4], [0, 4, 3], [0, 0, 1]]
    cameras = Cameras.from_lists(matrices, [K] * 3, [(8, 6)] * 3, ["a", "b", "c"])
    write_views(tmp_path / "a.json", cameras, splits=["train", "test", "train"])
    found = describe(tmp_path / "a.json")
    assert (found["kind"], found["count"], found["photos"]) == ("views", 3, 0)
    assert found["sizes"] == {"8×6": 3}
    assert found["splits"] == {"train": 2, "test": 1}
    assert found["fov_degrees"]["50"] == pytest.approx(90)


def test_photos_of_views_that_are_elsewhere(tmp_path: Path, command_line: CommandLine) -> None:
    K = [[4, 0, 4], [0, 4, 3], [0, 0, 1]]
    cameras = Cameras.from_lists([look_at([3, 0, 1], [0, 0, 0])], [K], [(8, 6)], ["a.png"])
    write_views(tmp_path / "a.json", replace(cameras, image_paths=(tmp_path / "gone" / "a.png",)))
    (tmp_path / "photos").mkdir()
    Image.new("RGBA", (8, 6)).save(tmp_path / "photos" / "a.png")
    found = json.loads(succeeds(command_line, tmp_path, "info", "a.json", "--json", "-").out)
    assert found["photos"] == 0
    words = ("info", "a.json", "--images", "photos", "--json", "-")
    found = json.loads(succeeds(command_line, tmp_path, *words).out)
    assert (found["photos"], found["notes"][0]["code"]) == (1, "alpha")


def test_playbot_matches_its_readme() -> None:
    found = describe(real("playbot"))
    assert (found["count"], found["sh_degree"], found["notes"]) == (500_000, 2, [])
    np.testing.assert_allclose(found["extent"]["min"], [-1.03, -1.08, -1.04], atol=0.005)
    opacities = [found["opacity"][q] for q in ("0", "1", "25", "50", "75", "99", "100")]
    np.testing.assert_allclose(
        opacities, [0.020, 0.090, 0.42, 0.68, 0.90, 0.996, 0.996], atol=0.005
    )


def test_info_of_several_files_and_of_a_run(command_line: CommandLine, folder: Path) -> None:
    command_line(
        "distill",
        "ball.ply",
        "-r",
        10,
        "-o",
        "run",
        "--steps",
        4,
        "--size",
        48,
        "--no-page",
        cwd=folder,
    )
    out = succeeds(command_line, folder, "info", "ball.ply", "views.json", "run", "--json", "-").out
    scene, views, made = json.loads(out)["files"]
    assert (scene["kind"], views["kind"], made["count"]) == ("splats", "views", 40)
    assert made["run"]["input_count"] == 400
    assert made["run"]["scores"]["recovered"]["psnr"] > 10
    assert made["run"]["overdraw"] > 1
    out, error = succeeds(command_line, folder, "info", "run")
    assert ("made from" in out, error) == (True, "")
    assert succeeds(command_line, folder, "info", "run", "-q").out == ""


def test_info_continues_after_unreadable_files(command_line: CommandLine, folder: Path) -> None:
    (folder / "text.ply").write_text("hello")
    ask = ("info", "ball.ply", "gone.ply", "text.ply", "views.json")
    status, out, error = command_line(*ask, cwd=folder)
    assert (status, error.count("\n")) == (1, 2), error
    assert "gone.ply: no such file" in error
    assert "rename it to the suffix of its format" in error
    assert "ball.ply" in out
    assert "views.json" in out
    status, out, _ = command_line(*ask, "--json", "-", cwd=folder)
    result = json.loads(out)
    assert (status, result["failed"]) == (1, ["gone.ply", "text.ply"])
    assert [figures["kind"] for figures in result["files"]] == ["splats", "views"]


def test_a_point_cloud_states_its_unit_and_rounded_figures(
    tmp_path: Path, command_line: CommandLine
) -> None:
    colors = np.tile([[156, 153, 136]], (3, 1)).astype(np.uint8)
    write_points(
        tmp_path / "a.ply",
        Points(np.array([[0, 0, 0], [2000.123, 10, 5], [9, 9, 9]]), colors / 255),
    )
    told = succeeds(command_line, tmp_path, "info", "a.ply").out
    assert re.search(r"unit\W+not stated in the file", told)
    assert re.search(r"extent\W+\(0, 0, 0\) to \(2,000, 10, 9\)", told)
    assert re.search(r"mean colour\W+\(0\.61, 0\.60, 0\.53\)", told)
