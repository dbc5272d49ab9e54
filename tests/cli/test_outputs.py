"""Output paths: folders, suffixes, names and what is overwritten."""

import json
from pathlib import Path

from PIL import Image

import g2ard
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import BALL


def test_folders_are_made_and_suffixes_are_of_any_case(command_line: CommandLine, folder: Path) -> None:
    g2ard.save(folder / "a" / "b" / "ball.PLY", BALL)
    assert len(g2ard.load(folder / "a" / "b" / "ball.PLY")) == 1200
    succeeds(
        command_line, folder, "simplify", "a/b/ball.PLY", "-r", 4, "-o", "c/d/small.Ply", "--json", "e/f.json"
    )
    assert json.loads((folder / "e" / "f.json").read_text())["output_count"] == 300
    assert len(g2ard.load(folder / "c" / "d" / "small.Ply")) == 300


SHORT = ("distill", "ball.ply", "--steps", 5, "--size", 48)


def test_a_folder_has_one_scene(command_line: CommandLine, folder: Path) -> None:
    assert command_line(*SHORT, "-r", 10, "-o", "run", cwd=folder)[0] == 0
    succeeds(command_line, folder, *SHORT, "-r", 10, "-o", "run", "-w", "--format", "sog")
    assert [path.name for path in (folder / "run").glob("scene*")] == ["scene.sog"]
    again = ("distill", "run/scene.sog", "-r", 2, "-o", "run", "-w", "--steps", 3)
    assert "run/scene.sog is both an input and the output" in refused(command_line, folder, *again)


def test_a_pictures_suffix_is_of_any_case(command_line: CommandLine, folder: Path) -> None:
    succeeds(command_line, folder, "render", "ball.ply", "-k", 1, "--size", 32, "--sheet", "a.PNG")
    with Image.open(folder / "a.PNG") as picture:
        assert picture.format == "PNG"


def test_a_folder_may_be_called_like_the_stand_in_of_dry_runs(
    command_line: CommandLine, folder: Path
) -> None:
    succeeds(command_line, folder, *SHORT, "-n", 90, "-o", "dry-run")
    assert (folder / "dry-run" / "scene.ply").is_file()
