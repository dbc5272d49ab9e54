"""Marks that skip tests and name the missing part of the system."""

import os
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

needs_signals = pytest.mark.skipif(
    os.name == "nt", reason="Windows ends a program at once instead of sending a signal"
)
"""Mark of tests that send SIGINT or SIGTERM to another process."""

needs_processes = pytest.mark.skipif(
    not hasattr(os, "posix_spawnp"), reason="the cost of a process is measured by POSIX calls"
)
"""Mark of tests of benchmarks that run commands as processes."""

needs_modes = pytest.mark.skipif(
    os.name == "nt", reason="on Windows a folder's mode keeps nobody out"
)

needs_proc = pytest.mark.skipif(
    not Path(f"/proc/self/task/{os.getpid()}/children").exists(),
    reason="needs /proc to list child processes",
)
"""Mark of tests that look for worker processes."""


@cache
def _links() -> bool:
    with tempfile.TemporaryDirectory() as folder:
        try:
            (Path(folder) / "link").symlink_to("target")
        except OSError:
            return False
    return True


needs_links = pytest.mark.skipif(
    sys.platform == "win32" and not _links(), reason="symbolic links need a privilege on Windows"
)


def is_worker(pid: int) -> bool:
    """Return whether a running process works on tiles, according to /proc."""
    with suppress(OSError):
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False


def workers_of(parent: int) -> set[int]:
    """Return the child processes that work on tiles. Threads and processes may end while they are listed."""
    children: list[str] = []
    with suppress(OSError):
        for task in Path(f"/proc/{parent}/task").iterdir():
            with suppress(OSError):
                children += (task / "children").read_text().split()
    return {pid for pid in map(int, children) if is_worker(pid)}
