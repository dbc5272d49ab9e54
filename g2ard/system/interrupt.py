"""Handling of Ctrl-C and SIGTERM: both end the program with one line.

A running command first saves what it can. Outside a command there is nothing to clean up, so the process ends
at once; otherwise libraries that are still loading would print long tracebacks.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # this is the program's first import, and importing typing is slow enough to interrupt
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

STATUSES = (130, 143)
"""Exit statuses after Ctrl-C and after SIGTERM."""

_last = signal.SIGINT


def asked_by(number: int) -> None:
    """Remember the signal that requested the exit, for `status`."""
    global _last
    _last = signal.Signals(number)


def status() -> int:
    """Return the exit status for the last signal."""
    return 128 + _last


def _end(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"g2ard: interrupted\n")
    os._exit(128 + number)


def terminate(number: int, frame: FrameType | None) -> NoReturn:
    """Handle SIGTERM during a command like Ctrl-C."""
    asked_by(number)
    raise KeyboardInterrupt


def ends_the_program() -> None:
    """Make both signals end the process with one line, unless another handler is installed."""
    for number, default in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(number) is default:
            signal.signal(number, _end)


class RaisesInterrupt:
    """Context in which both signals raise KeyboardInterrupt instead of ending the process.

    It changes only handlers that `ends_the_program` installed, and restores them at its end. In other
    programs, which call commands as functions, signals stay as they are.
    """

    def __enter__(self) -> None:
        self._replaced = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is _end]
        for number in self._replaced:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else terminate)

    def __exit__(self, *_: object) -> None:
        for number in self._replaced:
            signal.signal(number, _end)


def leave() -> NoReturn:
    """Exit immediately with `status`.

    Python records a signal that arrives during `exec` (as in creating a dataclass) as unhandled, and would
    end even a program that has handled it by the signal; `os._exit` avoids that.
    """
    import sys

    if (shared := sys.modules.get("multiprocessing.util")) is not None:
        shared._run_finalizers(0)  # release semaphores, or the resource tracker reports them as leaked
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status())
