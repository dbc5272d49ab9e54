"""Commands run for their error line, and as programs that can be interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from helpers.project import ROOT

CommandLine = Callable[..., tuple[int, str, str]]


def refused(command_line: CommandLine, folder: Path, *arguments: object, status: int = 2) -> str:
    """The one line that answers a call."""
    found, _, error = command_line(*arguments, cwd=folder)
    assert (found, error.count("\n")) == (status, 1), error
    return error


def _heed_interrupts() -> None:
    """Shells have what they start in the background ignore them, tests too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def program(*arguments: object, folder: Path, **pipes: int) -> subprocess.Popen[bytes]:
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-m", "g2ard", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        preexec_fn=_heed_interrupts if os.name == "posix" else None,
        **pipes,  # type: ignore[arg-type]
    )


def interrupt_at_checkpoint(
    running: subprocess.Popen[bytes], folder: Path, by: signal.Signals = signal.SIGINT
) -> Path:
    """A signal as soon as a run in `folder`/run has kept something; where that lies."""
    work = folder / "run" / ".unfinished"
    until = time.monotonic() + 120
    while not list(work.glob("[!.]*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(by)
    return work
