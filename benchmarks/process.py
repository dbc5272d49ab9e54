"""A command as a process of its own, with what it took."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from g2ard.errors import G2ardError, InputError

__all__ = ["Usage", "check_measurable", "measured"]

_LAUNCHER = """
import os, signal, sys, time
if sys.platform == "linux":  # a signal when whoever started us is gone
    import ctypes
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
began = time.perf_counter()
to_log = [(os.POSIX_SPAWN_DUP2, 2, 1)]
pid = os.posix_spawnp(sys.argv[1], sys.argv[1:], os.environ, file_actions=to_log)
signal.signal(signal.SIGTERM, lambda *_: os.kill(pid, signal.SIGTERM))
_, status, usage = os.wait4(pid, 0)
cpu, wall = usage.ru_utime + usage.ru_stime, time.perf_counter() - began
print(os.waitstatus_to_exitcode(status), cpu, wall, usage.ru_maxrss)
"""
"""Between us and the child: Linux counts the memory of whoever starts a process as the process's own peak."""


@dataclass(frozen=True)
class Usage:
    """What a process took.

    Args:
        cpu_s: user + system seconds.
        wall_s: seconds by the clock.
        peak_mb: largest resident size, 10⁶ bytes.
    """

    cpu_s: float
    wall_s: float
    peak_mb: float


def check_measurable() -> None:
    """Refuse where the system does not tell what a process took, as Windows does not in POSIX's way.

    Raises:
        G2ardError: it does not.
    """
    if not hasattr(os, "posix_spawnp"):
        raise G2ardError("this benchmark measures processes by POSIX's calls, which Windows lacks")


def measured(command: Sequence[str], log: Path) -> Usage:
    """Run a command to its end; it ends with us.

    Args:
        command: program and arguments.
        log: what it prints goes here.

    Raises:
        InputError: it failed; the message is its last line.
        G2ardError: the system does not tell what a process took.
    """
    check_measurable()
    with log.open("wb") as out:
        launched = [sys.executable, "-I", "-S", "-c", _LAUNCHER, *command]
        with subprocess.Popen(
            launched, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=out
        ) as launcher:
            try:
                told = launcher.communicate()[0].split()
            except BaseException:  # Ctrl-C to us alone: nothing is left running
                launcher.terminate()
                raise
    said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = said[-1] if said else "it said nothing"
    if len(told) != 4:
        raise InputError(f"{command[0]}: did not start: {last}")
    status, cpu, wall, peak = (float(value) for value in told)
    if status:
        raise InputError(f"exit status {status:.0f}: {last}")
    unit = 1 if sys.platform == "darwin" else 1024
    return Usage(cpu, wall, peak * unit / 1e6)
