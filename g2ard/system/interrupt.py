"""Handling of Ctrl-C and SIGTERM: both end the program with one line.

A running command first saves what it can. Outside a command there is nothing to clean up, so the process ends
at once; otherwise libraries that are still loading would print long tracebacks.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import time

# this is the program's first import, and importing typing is slow enough to interrupt
TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any, NoReturn

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


def _end_process(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"g2ard: interrupted\n")
    os._exit(128 + number)


def terminate(number: int, frame: FrameType | None) -> NoReturn:
    """Handle SIGTERM during a command like Ctrl-C."""
    asked_by(number)
    raise KeyboardInterrupt


def ends_the_program() -> None:
    """Make both signals end the process with one line, unless another handler is installed."""
    for number, default in (
        (signal.SIGINT, signal.default_int_handler),
        (signal.SIGTERM, signal.SIG_DFL),
    ):
        if signal.getsignal(number) is default:
            signal.signal(number, _end_process)


class RaisesInterrupt:
    """Context in which both signals raise KeyboardInterrupt instead of ending the process.

    It changes only handlers that `ends_the_program` installed, and restores them at its end. In other
    programs, which call commands as functions, signals stay as they are.

    Python only reports an exception that arrives in a finaliser or in a weak reference's callback, and goes
    on. There the signal is sent again.
    """

    def __enter__(self) -> None:
        self._replaced = [
            n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is _end_process
        ]
        for number in self._replaced:
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else terminate
            )
        self._report = sys.unraisablehook
        self._again = False
        if self._replaced:
            sys.unraisablehook = self._lost

    def __exit__(self, *_: object) -> None:
        self._again = False
        sys.unraisablehook = self._report
        for number in self._replaced:
            signal.signal(number, _end_process)

    def _lost(self, lost: Any) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            self._report(lost)
        elif not self._again:
            self._again = True
            _thread.start_new_thread(self._send_again, (_last,))

    def _send_again(self, number: int) -> None:
        time.sleep(0.01)  # the finaliser ends first
        if self._again:
            self._again = False
            _thread.interrupt_main(signal.Signals(number))


def leave() -> NoReturn:
    """Exit immediately with `status`.

    Python records a signal that arrives during `exec` (as in creating a dataclass) as unhandled, and would
    end even a program that has handled it by the signal; `os._exit` avoids that.
    """
    if (shared := sys.modules.get("multiprocessing.util")) is not None:
        # release semaphores, or the resource tracker reports them as leaked
        shared._run_finalizers(0)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status())
