"""Forked processes, also such as kill themselves while they write."""

import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

LIMIT = 300
"""Seconds that a process may take."""


def forked(work: Callable[[], object], out: Path, err: Path, folder: Path) -> int:
    """Run a function in a forked process with its own streams and folder; return the exit status."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status: object = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.alarm(LIMIT)
        os.chdir(folder)
        for number, path in ((1, out), (2, err)):
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(file, number)
        sys.stdout, sys.stderr = (
            os.fdopen(n, "w", encoding="utf-8", closefd=False) for n in (1, 2)
        )
        work()
        status = 0
    except SystemExit as end:
        status = end.code or 0
        if isinstance(status, str):
            print(status, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status if isinstance(status, int) else 1)


def command(words: list[str]) -> Callable[[], object]:
    """Return a function that runs `g2ard …`."""

    def run() -> None:
        program = importlib.import_module("g2ard.__main__")
        sys.modules["__main__"] = program  # workers import their parent's main module
        sys.argv = ["g2ard", *words]
        program.main()

    return run


def killed(
    work: Callable[[], object],
    after: int,
    count: Path | None = None,
    *,
    functions: Sequence[str] = ("replace", "link", "rename"),
    before: bool = False,
) -> Callable[[], object]:
    """Return a function that ends its process for good once it has put `after` files in place.

    Args:
        count: file for the number of files that were put in place, if it comes to its end.
        functions: functions of `os` that count.
        before: end before the last one of them instead of after it.
    """
    done = 0

    def counting(original: Callable[..., object]) -> Callable[..., object]:
        def counted(*args: Any, **more: Any) -> object:
            nonlocal done
            done += 1
            at_end = done == after
            if at_end and before:
                os.kill(os.getpid(), signal.SIGKILL)
            try:
                return original(*args, **more)
            finally:
                if at_end:
                    os.kill(os.getpid(), signal.SIGKILL)

        return counted

    def run() -> None:
        for name in functions:
            setattr(os, name, counting(getattr(os, name)))
        try:
            work()
        finally:
            if count is not None:
                count.write_text(str(done))

    return run
