"""Views have the size that --size requests, in every command that takes it."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import g2ard
from helpers.commands import CommandLine, succeeds
from helpers.photos import photographed
from helpers.plans import SIZE
from helpers.scenes import around, checkered_ball

GENERATED, LARGE = SIZE[0], SIZE[0] + 16
"""Longer side of generated views, and a larger one."""

OTHER = {
    "register": "photos shrink to it, to match features",
    "poses": "writes views of this size, see tests/poses/test_pools.py",
}

TRAIN = "--teacher ball.ply --steps 1"
COMMANDS = {
    "adapt": f"adapt small.ply {TRAIN} -o out.ply",
    "compare": "compare ball.ply small.ply",
    "distill": "distill ball.ply -r 8 --steps 1 --no-page -o out",
    "evaluate": "evaluate small.ply --teacher ball.ply",
    "lod": "lod ball.ply -r 1,8 --merge-only -o out",
    "recover": f"recover small.ply {TRAIN} -o out.ply",
    "render": "render ball.ply -k 4 -o out",
}
"""A short run of every command with --size."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    ball, views = checkered_ball(300), around(9, (48, 36))
    g2ard.save(folder / "ball.ply", ball)
    g2ard.save(folder / "small.ply", g2ard.simplify(ball, count=40, blind=True).splats)
    g2ard.save_views(folder / "views.json", views)
    g2ard.save_views(folder / "photos.json", photographed(folder, ball, views))
    return folder


def test_every_command_with_a_size_is_tried() -> None:
    from typer.main import get_command

    from g2ard.cli.app import register_commands
    from g2ard.cli.command import app

    register_commands()
    commands: dict[str, Any] = get_command(app).commands  # type: ignore[attr-defined]
    sized = {
        name for name, found in commands.items() if any("--size" in p.opts for p in found.params)
    }
    assert sized - set(OTHER) == set(COMMANDS)


def test_generated_views_are_as_small_as_tests_plan_them(
    inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    """The usual size would double the time of all tests that draw generated views."""
    folder = shutil.copytree(inputs, tmp_path / "there")
    ask = (*COMMANDS["evaluate"].split(), "--views", "made")
    assert f" {GENERATED}×{SIZE[1]} px" in "".join(succeeds(command_line, folder, *ask))


CASES = [
    (command, views) for command in COMMANDS for views in ("made", "views.json", "photos.json")
]


@pytest.mark.parametrize(
    ("command", "views"), [case for case in CASES if case != ("adapt", "made")]
)
def test_a_larger_size_holds_except_for_photos(
    command: str, views: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "there")
    words = COMMANDS[command].replace(" -k 4", "") if views != "made" else COMMANDS[command]
    ask = (*words.split(), "--views", views, "--size", LARGE, "--json", "told.json")
    error = succeeds(command_line, folder, *ask).err
    if command == "render":
        for path in (folder / "out").glob("*.png"):
            with Image.open(path) as image:
                assert image.width == (48 if views == "photos.json" else LARGE)
        return
    text = error + json.dumps(json.loads((folder / "told.json").read_text()), ensure_ascii=False)
    # whose levels are compared with renders of the scene
    photo = views == "photos.json" and command != "lod"
    side, height = (48, 36) if photo else (LARGE, LARGE * 3 // 4)
    assert f"{side}×{height} px" in text or re.search(rf'"size": {side}\b', text), text
    assert f"{GENERATED}×" not in text


@pytest.mark.parametrize("size", [24, 100])
@pytest.mark.parametrize("views", ["made", "views.json", "photos.json"])
@pytest.mark.parametrize("more", ["", "--held-out few.json", "--tile-rows 150 --renders"])
def test_all_views_of_a_run_have_its_size(
    more: str, views: str, size: int, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    """Views that train and views that are scored have one size, so a run's score is that of its views."""
    folder = shutil.copytree(inputs, tmp_path / "there")
    g2ard.save_views(folder / "few.json", around(3, (48, 36), 2.5))
    words = [*COMMANDS["distill"].split(), "--views", views, *more.split(), "--size", size]
    if "--held-out" in more and views == "photos.json":
        words.append("--renders")
    succeeds(command_line, folder, *words)
    for name in ("views.json", "scored.json"):
        if (folder / "out" / name).exists():
            found = g2ard.load_views(folder / "out" / name)
            photo = views == "photos.json" and "--renders" not in words
            assert set(found.widths.tolist()) <= ({min(size, 48), size} if photo else {size}), name


def test_runs_compared_are_scored_at_their_size(
    inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "there")
    for name, seed in (("a", 0), ("b", 1)):
        ask = (
            "distill",
            "ball.ply",
            "-r",
            8,
            "--steps",
            1,
            "--no-page",
            "--size",
            40,
            "--seed",
            seed,
        )
        succeeds(command_line, folder, *ask, "-o", name)
    out, error = succeeds(command_line, folder, "evaluate", "a", "b")
    assert " 40×30 px" in out + error
    assert f"{GENERATED}×" not in out + error
