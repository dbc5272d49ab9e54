"""Stages of studies in forked processes: as programs, most of their time is Python's start."""

import runpy
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import pytest

import benchmarks.kinds.worker  # noqa: F401 - imported once for all forks
from benchmarks.process import Usage, measured
from helpers.killed import forked


@pytest.fixture
def programs() -> None:
    """Start the stages of a test as a user's study does."""


@pytest.fixture(autouse=True)
def forks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fork for the stages of studies, except in tests with `programs`."""
    if "programs" not in request.fixturenames:
        for kind in ("matched", "simplify"):
            monkeypatch.setattr(f"benchmarks.kinds.{kind}.measured", _forked)


def _forked(command: Sequence[str], log: Path) -> Usage:
    """Do as `measured`, in a forked process if the command is a module of Python."""
    if list(command[:2]) != [sys.executable, "-m"]:
        return measured(command, log)
    import resource

    module, words = command[2], list(command[3:])

    def work() -> None:
        for name in (module, f"{module}.__main__"):
            sys.modules.pop(name, None)
        sys.argv = [module, *words]
        runpy.run_module(module, run_name="__main__", alter_sys=True)

    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads
        status = forked(work, log, log, Path.cwd())
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    if status:  # a program says why it fails
        return measured(command, log)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Usage(cpu, wall, after.ru_maxrss * 1024 / 1e6)
