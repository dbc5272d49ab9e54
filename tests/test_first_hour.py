"""What a newcomer meets in the first hour: outputs, names, pipes, signals, what is said and what is not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from scenes import around, checkered_ball

import g2ard
from g2ard.io import write_views

CommandLine = Callable[..., tuple[int, str, str]]
BALL = checkered_ball(1200)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", BALL)
    write_views(tmp_path / "views.json", around(16, (48, 36)))
    return tmp_path


def test_folders_are_made_and_suffixes_are_of_any_case(command_line: CommandLine, folder: Path) -> None:
    g2ard.save(folder / "a" / "b" / "ball.PLY", BALL)
    assert len(g2ard.load(folder / "a" / "b" / "ball.PLY")) == 1200
    status, _, error = command_line(
        "simplify", "a/b/ball.PLY", "-r", 4, "-o", "c/d/small.Ply", "--json", "e/f.json", cwd=folder
    )
    assert status == 0, error
    assert json.loads((folder / "e" / "f.json").read_text())["output_count"] == 300
    assert len(g2ard.load(folder / "c" / "d" / "small.Ply")) == 300


def test_several_budgets_are_what_single_runs_give(command_line: CommandLine, folder: Path) -> None:
    several = ("simplify", "ball.ply", "-r", "4,6", "-r", 10, "-o", "s_{ratio}x_{count}.ply", "--json", "-")
    status, out, error = command_line(*several, cwd=folder)
    assert status == 0, error
    assert [run["output_count"] for run in json.loads(out)["runs"]] == [300, 200, 120]
    for ratio, count in ((4, 300), (6, 200), (10, 120)):
        command_line("simplify", "ball.ply", "-r", ratio, "-o", f"one_{ratio}.ply", cwd=folder)
        one = (folder / f"one_{ratio}.ply").read_bytes()
        assert (folder / f"s_{ratio}x_{count}.ply").read_bytes() == one
    ask = ("distill", "ball.ply", "--steps", 8, "--size", 48)
    status, _, error = command_line(*ask, "-n", "200,100", "-o", "runs/{count}", cwd=folder)
    assert status == 0, error
    command_line(*ask, "-n", "100", "-o", "alone", cwd=folder)
    assert (folder / "runs/100/scene.ply").read_bytes() == (folder / "alone/scene.ply").read_bytes()
    assert (folder / "runs/200/report.html").exists()


def test_resuming_a_finished_run_says_so(command_line: CommandLine, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 5, "--size", 48)
    assert command_line(*ask, cwd=folder)[0] == 0
    before = (folder / "run" / "scene.ply").stat().st_mtime_ns
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert (status, error.count("\n")) == (0, 1), error
    assert "run: finished already" in error
    assert (folder / "run" / "scene.ply").stat().st_mtime_ns == before
    ask = (
        "recover",
        "ball.ply",
        "--views",
        "views.json",
        "--teacher",
        "ball.ply",
        "--steps",
        3,
        "-o",
        "b.ply",
    )
    assert command_line(*ask, cwd=folder)[0] == 0
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert status == 0
    assert "b.ply: finished already" in error


def program(*arguments: object, folder: Path, **pipes: int) -> subprocess.Popen[bytes]:
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-m", "g2ard", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        **pipes,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_pipe_loses_no_result(stream: str, folder: Path) -> None:
    """As under `| head -0`: the reader is gone before anything is said."""
    reader, writer = os.pipe()
    os.close(reader)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, stream: writer}
    running = program(
        "simplify", "ball.ply", "-r", 5, "-o", "s.ply", "--json", "-", "-v", folder=folder, **quiet
    )
    os.close(writer)
    _, error = running.communicate(timeout=120)
    assert running.returncode == 0, error
    assert b"roken" not in (error or b"")
    assert len(g2ard.load(folder / "s.ply")) == 240


def test_an_interrupt_says_what_was_kept(folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "-o", "run", "--size", 48, "--steps", 100_000)
    running = program(*ask, folder=folder, stderr=subprocess.PIPE)
    work = folder / "run" / ".unfinished"
    until = time.monotonic() + 120
    while not (work.is_dir() and any(work.iterdir())) and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    _, error = running.communicate(timeout=120)
    assert running.returncode == 130
    assert b"g2ard: interrupted; the same command with --resume goes on in run" in error


def test_version_has_a_letter(command_line: CommandLine, folder: Path) -> None:
    assert command_line("-V", cwd=folder) == command_line("--version", cwd=folder)
    assert "--install-completion" in command_line("--help", cwd=folder)[1]
