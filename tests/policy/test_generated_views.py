"""Views generated where none are given."""

from __future__ import annotations

import json
from pathlib import Path

from PIL import Image

from helpers.commands import CommandLine


def test_views_are_made_where_none_are_given(command_line: CommandLine, folder: Path) -> None:
    ask = ("render", "ball.ply", "--size", 64)
    status, _, error = command_line(*ask, "-n", 4, "--sheet", "a/look.png", cwd=folder)
    assert status == 0, error
    assert "4 images in a/look.png" in error
    with Image.open(folder / "a" / "look.png") as picture:
        assert picture.width > 128
    assert not (folder / "renders").exists()
    status, _, error = command_line("render", "ball.ply", "-n", 1, "-o", "renders", "--size", 32, cwd=folder)
    assert (status, "1 image in renders" in error) == (0, True), error
    assert len(list((folder / "renders").iterdir())) == 1
    command_line("simplify", "ball.ply", "-r", 5, "-o", "small.ply", cwd=folder)
    given = ("--teacher", "ball.ply", "--size", 48)
    status, out, error = command_line("evaluate", "small.ply", *given, "--json", "-", cwd=folder)
    assert status == 0, error
    before = json.loads(out)["scenes"][0]
    ask = ("recover", "small.ply", *given, "--steps", 60, "-o", "better.ply")
    status, _, error = command_line(*ask, cwd=folder)
    assert status == 0, error
    out = command_line("evaluate", "better.ply", *given, "--json", "-", cwd=folder)[1]
    after = json.loads(out)["scenes"][0]
    assert len(before["views"]) >= 20
    assert after["psnr"] > before["psnr"] + 1
    for command in (("evaluate", "small.ply"), ("recover", "small.ply", "-o", "x.ply")):
        status, _, error = command_line(*command, cwd=folder)
        assert (status, "--views, or a --teacher" in error) == (2, True)
