"""Commands in a pseudo-terminal, where status is drawn instead of printed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.project import environment

pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX")


def in_terminal(folder: Path, *arguments: object) -> tuple[int, str]:
    """Run a command with stderr on a terminal: its exit status and what the terminal receives."""
    ours, theirs = pty.openpty()
    running = subprocess.Popen(
        [sys.executable, "-m", "g2ard", *map(str, arguments)],
        cwd=folder,
        env=environment(TERM="xterm-256color", COLUMNS="80", LINES="24"),
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    received = b""
    while True:
        try:
            piece = os.read(ours, 1 << 16)
        except OSError:  # Linux reports the closed side as an error
            break
        if not piece:
            break
        received += piece
    os.close(ours)
    return running.wait(), received.decode()


@pytest.mark.parametrize(
    "ask",
    [
        "simplify ball.ply -r 10 -o small.ply",
        "recover ball.ply --teacher ball.ply --views views.json --steps 2 -o recovered.ply",
        "evaluate ball.ply --teacher ball.ply --views views.json",
    ],
)
def test_commands_run_in_a_terminal(ask: str, folder: Path) -> None:
    status, received = in_terminal(folder, *ask.split())
    assert status == 0, received
