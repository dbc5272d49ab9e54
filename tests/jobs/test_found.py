"""Cameras beside a scene: used without `--views`, reported, and skipped if they do not fit."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.io import read_splats, read_view_set, write_splats, write_views
from g2ard.scene.cameras import Cameras, look_at
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball
from helpers.trainer_files import inria

BALL = checkered_ball(1500)
EYES = list(around(16, distance=3.0).viewmats)
MODEL = Path("model/point_cloud/iteration_30000/point_cloud.ply")
SIMPLIFY = ("simplify", MODEL, "-n", 300)
DISTILL = ("distill", MODEL, "-n", 200, "--steps", 4, "--method", "paper", "--json", "-")
SAID = "views: 16 cameras of model/cameras.json (found beside the scene; --views made for a pool of its own)"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A model as INRIA's trainer leaves it."""
    (tmp_path / MODEL).parent.mkdir(parents=True)
    write_splats(tmp_path / MODEL, BALL)
    inria(tmp_path / "model" / "cameras.json", EYES)
    return tmp_path


def same(a: Path, b: Path) -> bool:
    return bool(np.array_equal(read_splats(a).means, read_splats(b).means))


def test_simplify_looks_from_the_cameras_beside_the_model(
    command_line: CommandLine, folder: Path
) -> None:
    for name, extra, words in (
        ("found", (), SAID),
        ("given", ("--views", "model/cameras.json"), ""),
        ("made", ("--views", "made"), ""),
        ("none", ("--no-views",), ""),
        (
            "turned",
            ("--up", "0,-1,0"),
            SAID.replace("scene;", "scene; --up turns generated views only;"),
        ),
        ("fast", ("--method", "fast"), ""),
        ("looking", ("--method", "fast", "--views", "made"), ""),
    ):
        error = succeeds(command_line, folder, *SIMPLIFY, "-o", f"{name}.ply", *extra).err
        assert words in error
        assert ("views:" in error) == bool(words), name
    assert same(folder / "found.ply", folder / "given.ply")  # they are small already
    assert not same(folder / "found.ply", folder / "made.ply")
    assert not same(folder / "fast.ply", folder / "looking.ply")
    (folder / "model" / "cameras.json").rename(folder / "away.json")
    succeeds(command_line, folder, *SIMPLIFY, "-o", "pool.ply")
    assert same(folder / "pool.ply", folder / "made.ply")


def test_distill_trains_and_scores_on_them(command_line: CommandLine, folder: Path) -> None:
    out, error = succeeds(command_line, folder, *DISTILL, "-o", "run", "--set", "views_count=14")
    assert SAID in error
    report = json.loads(out)
    assert report["against"] == "the dense scene"
    held_out = {view["name"] for view in report["scores"]["recovered"]["views"]}
    assert held_out == {"000", "008"}  # every 8th by name
    assert set(report["views"]["chosen"]) == {f"{i:03d}" for i in range(16)} - held_out
    assert set(g2ard.load_views(folder / "run", split="test").names) == held_out
    error = succeeds(
        command_line, folder, *DISTILL, "-o", "pool", "--size", 64, "--views", "made"
    ).err
    assert SAID not in error
    assert len(read_view_set(folder / "pool" / "views.json").cameras) >= 20


def test_large_cameras_without_photos_are_shrunk(command_line: CommandLine, folder: Path) -> None:
    inria(folder / "model" / "cameras.json", EYES[:4], width=1200, height=900, fx=1050.0, fy=1050.0)
    write_views(folder / "small.json", read_view_set(folder / "model").cameras.resized(800))
    for name, extra in (
        ("found", ()),
        ("given", ("--views", "small.json")),
        ("full", ("--views", "model")),
    ):
        succeeds(command_line, folder, *SIMPLIFY, "-o", f"{name}.ply", *extra)
        if name != "full":
            succeeds(
                command_line, folder, *DISTILL, "--focus", "far", "--no-page", "-o", name, *extra
            )
    assert same(folder / "found.ply", folder / "given.ply")
    assert not same(folder / "found.ply", folder / "full.ply")
    assert same(folder / "found" / "scene.ply", folder / "given" / "scene.ply")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(position=[50, 0, 0]), "model/cameras.json: 0 of 16 cameras see it"),
        (lambda c: c.pop("fx"), "model/cameras.json: property 'fx' of camera 0 is missing"),
    ],
)
def test_cameras_that_do_not_fit_are_left(
    command_line: CommandLine, folder: Path, change: Callable[[dict[str, Any]], Any], words: str
) -> None:
    path = folder / "model" / "cameras.json"
    turned = look_at([0, 0, 0], [1, 0, 0])
    inria(path, [turned] * 16)
    content = json.loads(path.read_text())
    for camera in content:
        change(camera)
    path.write_text(json.dumps(content))
    for ask, output in ((SIMPLIFY, "out.ply"), ((*DISTILL, "--size", 64), "run")):
        error = succeeds(command_line, folder, *ask, "-o", output).err
        assert f"views beside the scene are not used: {words}" in error
    assert g2ard.load_views(folder / "run").names[0].startswith("pose_")


def test_too_few_cameras_are_left(command_line: CommandLine, folder: Path) -> None:
    inria(folder / "model" / "cameras.json", EYES[:1])
    error = succeeds(command_line, folder, *SIMPLIFY, "-o", "out.ply").err
    assert "not used: model/cameras.json: its only view is not in split 'train'" in error


def test_facing() -> None:
    K = [[50, 0, 32], [0, 50, 24], [0, 0, 1]]
    eyes = [
        look_at([3, 0, 0], [0, 0, 0]),
        look_at([3, 0, 0], [9, 0, 0]),
        look_at([3, 0, 0], [3, 9, 0]),
    ]
    cameras = Cameras.from_lists(eyes, [K] * 3, [(64, 48)] * 3, "abc")
    assert cameras.facing([[0, 0, 0]]).tolist() == [True, False, False]
    assert cameras.facing([[0, 0, 0], [3, 5, 0]]).tolist() == [True, False, True]
    assert cameras.facing(np.zeros((0, 3))).tolist() == [False] * 3
    assert not cameras.facing([[0, 0, 3]]).any()  # above the image
