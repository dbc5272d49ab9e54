"""Ctrl-C and SIGTERM: both end the program with one line, during a command after it has kept what it can.

Outside a command nothing is to be cleaned up yet, or any more, so they just end it: libraries that load, and
typer as it builds its commands, would answer with pages of traceback.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # the program's first import: typing's own takes long enough to press Ctrl-C in
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

STATUSES = (130, 143)
"""What the program ends with after Ctrl-C, and after SIGTERM."""

_last = signal.SIGINT


def asked_by(number: int) -> None:
    """Remember which signal it was that asked for the end, for `status`."""
    global _last
    _last = signal.Signals(number)


def status() -> int:
    """What the program ends with after the signal that asked for it."""
    return 128 + _last


def _end(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"g2ard: interrupted\n")
    os._exit(128 + number)


def terminate(number: int, frame: FrameType | None) -> NoReturn:
    """SIGTERM's handler during a command: as Ctrl-C."""
    asked_by(number)
    raise KeyboardInterrupt


def ends_the_program() -> None:
    """From here on both end the program with a line, unless something else handles them."""
    for number, ours in (
        (signal.SIGINT, (signal.default_int_handler,)),
        (signal.SIGTERM, (signal.SIG_DFL, terminate)),
    ):
        if signal.getsignal(number) in ours:
            signal.signal(number, _end)


def raises() -> bool:
    """From here on they raise KeyboardInterrupt; False where `ends_the_program` had not changed Ctrl-C."""
    if signal.getsignal(signal.SIGTERM) is _end:
        signal.signal(signal.SIGTERM, terminate)
    if signal.getsignal(signal.SIGINT) is not _end:
        return False
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return True


def leave() -> NoReturn:
    """End at once with `status`.

    If the signal came while source was executed from a string, as making a dataclass does, Python remembers
    that as an interrupt nobody handled, and would end a program that has handled it by the signal.
    """
    import sys

    if (shared := sys.modules.get("multiprocessing.util")) is not None:
        shared._run_finalizers(0)  # semaphores: without it a helper process tells later that they were left
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status())
