"""Ctrl-C outside a command: nothing is to be cleaned up yet, or any more, so it just ends the program.

Libraries that load, and typer as it builds its commands, would answer with pages of traceback.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # the program's first import: typing's own takes long enough to press Ctrl-C in
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

__all__ = ["STATUS", "ends_the_program", "leave", "raises"]

STATUS = 130
"""What the program ends with after Ctrl-C."""


def _end(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"g2ard: interrupted\n")
    os._exit(STATUS)


def ends_the_program() -> None:
    """From here on Ctrl-C ends the program with a line and status 130, unless something else handles it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raises() -> bool:
    """From here on it raises KeyboardInterrupt again; False where `ends_the_program` had not changed that."""
    if signal.getsignal(signal.SIGINT) is not _end:
        return False
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return True


def leave() -> NoReturn:
    """End at once with `STATUS`.

    If the signal came while source was executed from a string, as making a dataclass does, Python remembers
    that as an interrupt nobody handled, and would end a program that has handled it by the signal.
    """
    import sys

    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(STATUS)
