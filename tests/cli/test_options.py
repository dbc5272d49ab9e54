"""Rejected options, config files and outputs, with their messages; Ctrl-C before any command."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.io import read_splats, write_splats, write_views
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "a.ply", checkered_ball(200))
    write_views(tmp_path / "views.json", around(8, (32, 24)))
    return tmp_path


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--method", "best", "'--method': expected one of default, fast, paper, got 'best'"),
        ("--min-psnr", "x", "'--min-psnr': expected a number of at least 1, got 'x'"),
        ("--seed", "-1", "'--seed': expected a whole number of at least 0, got '-1'"),
        ("--seed", "1.5", "'--seed': expected a whole number of at least 0, got '1.5'"),
        ("--threads", "1000", "'--threads': expected a whole number from 0 to 256, got '1000'"),
    ],
)
def test_invalid_values(
    folder: Path, command_line: CommandLine, option: str, value: str, words: str
) -> None:
    simplify = ("simplify", "a.ply", "-n", 5, "-o", "o.ply")
    assert words in refused(command_line, folder, *simplify, option, value)
    table = f'[simplify]\n{option[2:]} = "{value}"\n'
    (folder / "c.toml").write_text(table)
    assert f"{words} (from c.toml)" in refused(
        command_line, folder, *simplify, "--config", "c.toml"
    )


def test_up_changes_the_generated_views(folder: Path, command_line: CommandLine) -> None:
    for up in ("0,0,1", "1,0,0"):
        ask = ("distill", "a.ply", "-n", 20, "--views", "made", "--steps", 1, "--size", 48)
        ask = (*ask, "--focus", "far", "--no-page")
        succeeds(command_line, folder, *ask, "--up", up, "-o", up[:1])
    upright, lying = (json.loads((folder / name / "views.json").read_text()) for name in "01")
    assert upright != lying


def test_a_flag_wins_over_what_it_excludes_in_the_config(
    folder: Path, command_line: CommandLine
) -> None:
    (folder / "c.toml").write_text(
        "[simplify]\ncount = 50\nno-views = true\n[recover]\nsteps = 100000\n"
    )
    for arguments, count in ((("-r", 10), 20), ((), 50), (("--views", "views.json"), 50)):
        ask = ("simplify", "a.ply", *arguments, "-o", "small.ply", "-w", "--config", "c.toml")
        succeeds(command_line, folder, *ask)
        assert len(read_splats(folder / "small.ply")) == count
    ask = ("simplify", "a.ply", "-r", 10, "-n", 5, "-o", "o.ply", "--config", "c.toml")
    assert "keep one of -n COUNT, -r RATIO" in refused(command_line, folder, *ask)
    ask = ("recover", "small.ply", "--views", "views.json", "--teacher", "a.ply", "-o", "o.ply")
    succeeds(command_line, folder, *ask, "--config", "c.toml", "--recovery-time", "1s")


def test_the_folder_one_is_in_can_be_an_output(folder: Path, command_line: CommandLine) -> None:
    (folder / "out").mkdir()
    ask = ("render", "../a.ply", "--views", "../views.json", "--split", "test", "-o", ".")
    succeeds(command_line, folder / "out", *ask)
    assert (folder / "out" / "view_000.png").is_file()
    for command in ("recover", "adapt"):
        ask = (command, "../a.ply", "--views", "../views.json", "-o", ".")
        status, _, error = command_line(*ask, cwd=folder / "out")
        assert (status, error.count("\n")) == (1, 1)
        assert error.startswith("g2ard: .: scenes are written as .compressed.ply, .ply, .sog, .spz")


@pytest.mark.parametrize(
    "moment",
    [
        "class Finder:\n"  # as typer is imported
        "    def find_spec(name, *rest):\n"
        "        if name == 'typer': signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder)\n",
        "import typer.main\n"  # as it builds the commands
        "typer.main.get_group = lambda *a: signal.raise_signal(signal.SIGINT)\n",
    ],
)
@pytest.mark.parametrize(("by", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_before_a_command_is_one_line(moment: str, by: str, status: int) -> None:
    # ignored in background jobs
    unignored = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    moment = moment.replace("SIGINT", by)
    code = f"import signal, sys\n{unignored}\n{moment}from g2ard.__main__ import main\nmain()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (status, "g2ard: interrupted\n")


def test_recover_reports_losing_steps(tmp_path: Path, command_line: CommandLine) -> None:
    ball = checkered_ball(800)
    grain = np.random.default_rng(0).normal(0, 9e-3, ball.sh0.shape).astype(np.float32)
    write_splats(tmp_path / "ball.ply", ball)
    write_splats(tmp_path / "start.ply", replace(ball, sh0=ball.sh0 + grain))
    write_views(tmp_path / "v.json", around(6))
    asked = (
        "recover",
        "start.ply",
        "--views",
        "v.json",
        "--teacher",
        "ball.ply",
        "-o",
        "o.ply",
        "-w",
    )
    for steps, words in ((4, "kept the start: every step made"), (24, "recovery fell to ")):
        told = succeeds(command_line, tmp_path, *asked, "--steps", steps).err
        assert sum(words in line for line in told.splitlines()) == 1
