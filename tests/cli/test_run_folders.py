"""A run folder of `distill`, passed as a scene or as views."""

import json
from pathlib import Path

import pytest

import g2ard
from g2ard.errors import InputError
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene and two runs of it, one of which wrote a .sog."""
    folder = tmp_path_factory.mktemp("runs")
    g2ard.save(folder / "ball.ply", checkered_ball(400))
    for name, ratio in (("a", 4), ("b", 8)):
        small = g2ard.simplify(folder / "ball.ply", ratio=ratio, blind=True).splats
        run = folder / "runs" / name
        g2ard.save(run / ("scene.ply" if name == "a" else "scene.sog"), small)
        g2ard.save_views(run / "views.json", around(16, (48, 36)))
        (run / "report.json").write_text("{}")
        (run / "preview.png").touch()
    return folder


@pytest.mark.parametrize(
    "ask",
    [
        "render runs/a -k 2 --sheet {}/look.png",
        "render runs/a --views runs/a -o {}/looks",
        "evaluate runs/a runs/b --teacher ball.ply --size 48",
        "evaluate runs/b --teacher runs/a --views runs/a --split all",
        "simplify runs/a -r 2 -o {}/small.ply",
        "convert runs/a runs/b {}/both.spz",
        "view runs/a runs/b -o {}/page.html",
        "recover runs/a --teacher ball.ply --views runs/a --steps 2 -o {}/better.ply",
        "distill runs/a -r 2 --size 48 --steps 2 --focus far --no-page -o {}/again",
    ],
)
def test_commands_read_runs(
    ask: str, home: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    succeeds(command_line, home, *ask.format(tmp_path).split())


def test_python_reads_them_too(home: Path) -> None:
    assert len(g2ard.load(home / "runs" / "a")) == 100
    assert len(g2ard.load(home / "runs" / "b")) == 50
    assert len(g2ard.load_views(home / "runs" / "a")) == 16


def test_the_views_of_the_table_can_be_scored_again(
    home: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    ask = (
        "distill",
        "ball.ply",
        "-r",
        4,
        "--steps",
        2,
        "--size",
        48,
        "--no-page",
        "-o",
        tmp_path / "run",
    )
    succeeds(command_line, home, *ask)
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    again = (
        "evaluate",
        tmp_path / "run",
        "--teacher",
        "ball.ply",
        "--views",
        tmp_path / "run/scored.json",
    )
    out = succeeds(command_line, home, *again, "--json", "-").out
    scored = {view["name"]: view["psnr"] for view in json.loads(out)["scenes"][0]["views"]}
    views = [*report["scores"]["recovered"]["views"], *report["apart"]["recovered"]["views"]]
    assert scored == pytest.approx({view["name"]: view["psnr"] for view in views})


def test_the_size_is_the_scene_files(home: Path, command_line: CommandLine) -> None:
    ask = ("evaluate", "runs/a", "--teacher", "ball.ply", "--size", 48, "--json", "-")
    (row,) = json.loads(command_line(*ask, cwd=home)[1])["scenes"]
    assert row["file_bytes"] == (home / "runs" / "a" / "scene.ply").stat().st_size


def test_a_folder_of_runs_names_them(home: Path) -> None:
    with pytest.raises(
        InputError, match=r"runs: is not a supported folder; give one of its runs: a, b$"
    ):
        g2ard.load(home / "runs")


def test_scenes_are_checked_before_poses_are_made_for_them(
    home: Path, command_line: CommandLine
) -> None:
    ask = ("evaluate", "runs/a", "gone.ply", "--teacher", "ball.ply", "--size", 48)
    status, _, error = command_line(*ask, cwd=home)
    assert (status, error) == (1, "g2ard: gone.ply: no such file or folder\n")
