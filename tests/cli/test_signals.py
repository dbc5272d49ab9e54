"""Signals and closed pipes."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

import g2ard
from helpers.commands import interrupt_at_checkpoint, program
from helpers.scenes import checkered_ball
from helpers.systems import needs_signals


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
@pytest.mark.parametrize(("by", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_says_what_was_kept(by: signal.Signals, status: int, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "-o", "run", "--size", 48, "--steps", 100_000)
    running = program(*ask, folder=folder, stderr=subprocess.PIPE)
    interrupt_at_checkpoint(running, folder, by)
    _, error = running.communicate(timeout=120)
    assert running.returncode == status, error
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
