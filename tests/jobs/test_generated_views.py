"""Views generated where none are given."""

import json
from pathlib import Path

from PIL import Image

from helpers.commands import CommandLine, refused, succeeds


def test_views_are_made_where_none_are_given(command_line: CommandLine, folder: Path) -> None:
    ask = ("render", "ball.ply", "--size", 64)
    error = succeeds(command_line, folder, *ask, "-n", 4, "--sheet", "a/look.png").err
    assert "4 images in a/look.png" in error
    with Image.open(folder / "a" / "look.png") as picture:
        assert picture.width > 128
    assert not (folder / "renders").exists()
    assert (
        "1 image in renders"
        in succeeds(command_line, folder, "render", "ball.ply", "-n", 1, "-o", "renders", "--size", 32).err
    )
    assert len(list((folder / "renders").iterdir())) == 1
    command_line("simplify", "ball.ply", "-r", 5, "-o", "small.ply", cwd=folder)
    given = ("--teacher", "ball.ply", "--size", 48)
    out = succeeds(command_line, folder, "evaluate", "small.ply", *given, "--json", "-").out
    before = json.loads(out)["scenes"][0]
    ask = ("recover", "small.ply", *given, "--steps", 60, "-o", "better.ply")
    succeeds(command_line, folder, *ask)
    out = command_line("evaluate", "better.ply", *given, "--json", "-", cwd=folder)[1]
    after = json.loads(out)["scenes"][0]
    assert len(before["views"]) >= 20
    assert after["psnr"] > before["psnr"] + 1
    for command in (("evaluate", "small.ply"), ("recover", "small.ply", "-o", "x.ply")):
        assert "--views, or a --teacher" in refused(command_line, folder, *command)
