"""Commands run for their error line, and as programs that can be interrupted."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from helpers.project import environment

CommandLine = Callable[..., tuple[int, str, str]]


class Printed(NamedTuple):
    out: str
    err: str


def succeeds(command_line: CommandLine, folder: Path, *arguments: object) -> Printed:
    """Return what a command that must succeed writes to stdout and stderr."""
    status, out, error = command_line(*arguments, cwd=folder)
    assert status == 0, error
    return Printed(out, error)


def refused(command_line: CommandLine, folder: Path, *arguments: object, status: int = 2) -> str:
    """Return the one line with which a command fails."""
    found, _, error = command_line(*arguments, cwd=folder)
    assert (found, error.count("\n")) == (status, 1), error
    return error


def _heed_interrupts() -> None:
    """Reset SIGINT: shells and tests start background processes with it ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def program(*arguments: object, folder: Path, **pipes: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "g2ard", *map(str, arguments)],
        cwd=folder,
        env=environment(),
        preexec_fn=_heed_interrupts if os.name == "posix" else None,
        **pipes,  # type: ignore[arg-type]
    )


def interrupt_at_checkpoint(
    running: subprocess.Popen[bytes], folder: Path, by: signal.Signals = signal.SIGINT
) -> Path:
    """Signal a run in `folder`/run once it has written a checkpoint; return its work folder."""
    work = folder / "run" / ".unfinished"
    until = time.monotonic() + 120
    while not list(work.glob("[!.]*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(by)
    return work
