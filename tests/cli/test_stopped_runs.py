"""Stopped and finished runs: what a signal or a closed pipe leaves, and what `--resume` makes of it."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

import g2ard
from helpers.commands import CommandLine, interrupt_at_checkpoint, program, refused, succeeds
from helpers.scenes import checkered_ball
from helpers.systems import needs_signals

SHORT = ("distill", "ball.ply", "--steps", 5, "--size", 48)


def test_a_finished_run_is_not_taken_for_another(command_line: CommandLine, folder: Path) -> None:
    begin = (*SHORT, "-o", "run")
    ask = (*begin, "-r", 10)
    out = succeeds(command_line, folder, *ask, "--json", "-").out
    # what is refused is refused before the scene is read
    (folder / "ball.ply").rename(folder / "away.ply")
    again = succeeds(command_line, folder, *ask, "--resume", "--json", "-").out
    ran, told = json.loads(out), json.loads(again)
    assert told["scores"] == ran["scores"]
    others = (
        ((*ask, "--seed", 3), "seed"),
        ((*ask, "--set", "sh_degree=0"), "set"),
        ((*begin, "-r", 5), "budget"),
    )
    for other, words in others:
        assert (
            f"run: finished with other options ({words}); -w without --resume starts over"
            in refused(command_line, folder, *other, "--resume", status=1)
        )
    (folder / "away.ply").rename(folder / "ball.ply")
    assert command_line(*SHORT, "-o", "run", "-n", 40, "--resume", cwd=folder)[0] == 0
    (folder / "run" / "report.json").unlink()
    assert "run: exists; -w (--overwrite)" in refused(
        command_line, folder, *ask, "--resume", status=1
    )


@needs_signals
def test_a_stopped_run_continues_with_other_options(
    command_line: CommandLine, folder: Path
) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "-o", "run", "--size", 48)
    running = program(*ask, "--steps", 100_000, folder=folder, stderr=subprocess.PIPE)
    work = interrupt_at_checkpoint(running, folder)
    _, error = running.communicate(timeout=120)
    assert running.returncode == 130
    assert b"g2ard: interrupted; run the same command with --resume to continue in run" in error
    out = succeeds(command_line, folder, "info", "run").out
    for words in ("stopped run", "simplified-1", "400 → 100", "ball.ply", "with --resume (-o run)"):
        assert words in out
    assert json.loads(command_line("info", "run", "--json", "-", cwd=folder)[1])["kept"]
    assert (
        "run: continues after "
        in succeeds(command_line, folder, *ask, "--steps", 7, "--resume").err
    )
    assert (
        json.loads((folder / "run" / "report.json").read_text())["rounds"][0]["recover"][0]["steps"]
        == 7
    )
    assert not work.exists()


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_pipe_loses_no_result(stream: str, folder: Path) -> None:
    """The reader exits before anything is written, as with `| head -0`."""
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
    assert len(g2ard.load(folder / "s.ply")) == 80


@needs_signals
def test_a_terminated_run_says_what_was_kept(folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "-o", "run", "--size", 48, "--steps", 100_000)
    running = program(*ask, folder=folder, stderr=subprocess.PIPE)
    interrupt_at_checkpoint(running, folder, signal.SIGTERM)
    _, error = running.communicate(timeout=120)
    assert running.returncode == 143, error
    assert b"g2ard: interrupted; run the same command with --resume to continue in run" in error


@needs_signals
def test_stopped_workers_leave_one_line(folder: Path) -> None:
    """Python would also report leaked semaphores after the program has ended."""
    g2ard.save(folder / "large.ply", checkered_ball(20_000))
    ask = ("simplify", "large.ply", "-r", 4, "--tile-rows", "3k", "--workers", 2, "-o", "s.ply")
    running = program(*ask, folder=folder, stderr=subprocess.PIPE)
    while not list(folder.glob(".s.ply.tiles/steps/light-*.npz")):  # workers are about to look
        assert running.poll() is None
        time.sleep(0.05)
    time.sleep(0.3)
    running.send_signal(signal.SIGTERM)
    error = running.stderr.read()
    assert running.wait(timeout=120) == 143, error
    assert error.endswith(
        b"g2ard: interrupted; finished steps are in .s.ply.tiles; run the same command to continue\n"
    )
