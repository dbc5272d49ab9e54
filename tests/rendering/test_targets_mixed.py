"""Mixed targets: a view's photo if it has one, otherwise the dense scene's render."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import g2ard
from g2ard.io import write_splats, write_views
from g2ard.io.images import write_png
from g2ard.rendering.renderer import render
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball

PRIOR = checkered_ball()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A ball and twelve views, the last four held out, every second one with a photo: a red one."""
    write_splats(tmp_path / "ball.ply", PRIOR)
    views = around(12, (48, 36))
    paths = [tmp_path / f"{name}.png" if i % 2 == 0 else None for i, name in enumerate(views.names)]
    for i, path in enumerate(paths):
        if path is not None:
            write_png(path, render(PRIOR, views[i]).image * [1, 0, 0])
    mixed = replace(views, image_paths=tuple(paths))
    write_views(tmp_path / "v.json", mixed, splits=["train"] * 8 + ["test"] * 4)
    return tmp_path


def run(command_line: CommandLine, folder: Path, *arguments: object) -> tuple[dict[str, Any], str]:
    out, error = succeeds(command_line, folder, *arguments, "-w", "--json", "-")
    return json.loads(out), error


def test_distill_learns_from_photos_and_renders(folder: Path, command_line: CommandLine) -> None:
    ask = (
        "distill",
        "ball.ply",
        "-r",
        3,
        "--views",
        "v.json",
        "-o",
        "run",
        "--steps",
        4,
        "--size",
        48,
    )
    report, told = run(command_line, folder, *ask)
    assert "8 training views against 4 photos and 4 renders of the dense scene" in told
    assert "skipped" not in told
    assert report["against"] == "2 photos and 2 renders of the dense scene"
    assert report["apart"] is None
    assert report["scores"]["recovered"]["views"][0]["against"] == "photo"
    report, told = run(command_line, folder, *ask, "--renders")
    assert "8 training views against the dense scene" in told
    report, told = run(command_line, folder, *ask, "--photos")
    assert "4 training views against photos" in told
    assert report["against"] == "photos"


def test_a_distillation_in_python_has_both_targets(folder: Path) -> None:
    done = g2ard.distill(folder / "ball.ply", ratio=3, views=folder / "v.json", steps=4, size=48)
    kinds = [done.held_out.against(view) for view in range(4)]  # type: ignore[attr-defined]
    assert kinds == ["photo", "teacher"] * 2
    assert done.held_out[0][..., 1:].max() == 0
    assert done.held_out[1][..., 1:].max() > 0.1


def test_recover_takes_photos_beside_its_teacher(folder: Path, command_line: CommandLine) -> None:
    ask = ("recover", "ball.ply", "--views", "v.json", "-o", "o.ply", "--steps", 20)
    _, told = run(command_line, folder, *ask, "--teacher", "ball.ply")
    assert "8 training views against the dense scene" in told
    _, told = run(command_line, folder, *ask, "--teacher", "ball.ply", "--photos")
    assert "8 training views against 4 photos and 4 renders of the dense scene" in told
    _, told = run(command_line, folder, *ask)
    assert "4 training views against photos" in told


def test_a_teacher_needs_no_photos(folder: Path, command_line: CommandLine) -> None:
    report, told = run(
        command_line, folder, "evaluate", "ball.ply", "--views", "v.json", "--teacher", "ball.ply"
    )
    assert len(report["scenes"][0]["views"]) == 4
    assert "skipped" not in told
