"""Processes with their cost, and the machine they run on."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from g2ard.errors import G2ardError, InputError

__all__ = [
    "Usage",
    "check_measurable",
    "cpu_name",
    "machine",
    "measured",
    "splat_transform",
    "version_of",
]

_LAUNCHER = """
import os, signal, sys, time
if sys.platform == "linux":  # end with the parent process
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
"""A small process between ours and the child, since Linux counts the parent's memory in the child's peak."""


@dataclass(frozen=True)
class Usage:
    """Cost of a process.

    Args:
        cpu_s: user + system seconds.
        wall_s: seconds by the clock.
        peak_mb: largest resident size, 10⁶ bytes.
    """

    cpu_s: float
    wall_s: float
    peak_mb: float


def check_measurable() -> None:
    """Raise a `G2ardError` if the system does not report the cost of a process (Windows)."""
    if not hasattr(os, "posix_spawnp"):
        raise G2ardError("this benchmark needs POSIX; it does not run on Windows")


def measured(command: Sequence[str], log: Path) -> Usage:
    """Run a command to its end and return its cost; it is stopped if this process ends.

    Args:
        command: program and arguments.
        log: file for its output.

    Raises:
        InputError: the command failed; the message is its last line.
        G2ardError: the system does not report the cost of a process.
    """
    check_measurable()
    with log.open("wb") as out:
        launched = [sys.executable, "-I", "-S", "-c", _LAUNCHER, *command]
        with subprocess.Popen(
            launched, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=out
        ) as launcher:
            try:
                told = launcher.communicate()[0].split()
            except BaseException:  # Ctrl-C may only reach this process
                launcher.terminate()
                raise
    said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = said[-1] if said else "no output"
    if len(told) != 4:
        raise InputError(f"{command[0]}: did not start: {last}")
    status, cpu, wall, peak = (float(value) for value in told)
    if status:
        raise InputError(f"exit status {status:.0f}: {last}")
    unit = 1 if sys.platform == "darwin" else 1024
    return Usage(cpu, wall, peak * unit / 1e6)


def splat_transform(*arguments: str) -> list[str]:
    """Return a call of splat-transform."""
    found = shutil.which("splat-transform")
    if found is None:
        raise InputError("splat-transform: not on PATH (npm i -g @playcanvas/splat-transform)")
    return [found, "-q", "-w", "-g", "cpu", *arguments]


def version_of(*program: str) -> str:
    """Return the first line that a program prints for --version."""
    told = subprocess.run(
        [*program, "--version"],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    lines = (told.stdout or told.stderr).splitlines()
    return lines[0].strip() if lines else ""


def machine() -> str:
    """Return processor and cores, as recorded in every row."""
    return f"{cpu_name()}, {os.cpu_count()} cores"


def cpu_name() -> str:
    """Return the processor's model name if known, otherwise its architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    names = (
        line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")
    )
    return next(names, platform.machine())
