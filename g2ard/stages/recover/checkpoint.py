"""Checkpoints of recovery, and interruption between steps instead of within one."""

import json
import signal
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from g2ard.arrays import Values
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.reports import plain
from g2ard.system import interrupt

_START_OVER_HINT = "{overwrite=True} starts over"

PERIOD = 60.0
"""Seconds between two checkpoints."""


def save(
    path: Path, key: str, meta: dict[str, Any], arrays: Mapping[str, Values | Callable[[], Values]]
) -> None:
    """Write a checkpoint as an .npz file.

    Args:
        key: identifies the run.
        arrays: or functions that return them, called one after the other.
    """
    text = json.dumps({"key": key, **meta}, default=plain)
    everything = {"meta": np.array(text), **arrays}
    with (
        atomic_output(path, overwrite=True) as temporary,
        zipfile.ZipFile(temporary, "w") as archive,
    ):
        for name, array in everything.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(
                    file, array() if callable(array) else array, allow_pickle=False
                )


def load(path: Path, key: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint back.

    Raises:
        InputError: it cannot be read, or belongs to another run than `key`.
    """
    try:
        with np.load(path) as data:
            arrays = dict(data)
        meta: dict[str, Any] = json.loads(str(arrays.pop("meta")))
        known = meta.pop("key")
    except Exception:  # numpy and zipfile raise many kinds of exceptions
        raise InputError(
            "not a checkpoint of g2ard, or a damaged one", path=path, hint=_START_OVER_HINT
        ) from None
    if known != key:
        raise InputError(
            "belongs to a run with another scene or other options", path=path, hint=_START_OVER_HINT
        )
    return meta, arrays


def drop_damaged(path: Path) -> None:
    """Remove a checkpoint that cannot be read, such as one that a power cut left half-written."""
    try:
        with np.load(path) as data:
            whole = "key" in json.loads(str(data["meta"])) and all(
                data[name] is not None for name in data
            )
    except FileNotFoundError:
        return
    except Exception:  # as `load`
        whole = False
    if not whole:
        path.unlink()


def count_steps(path: Path) -> int | None:
    """Return the steps of a recovery's checkpoint, None if it is of a finished round or cannot be read."""
    try:
        with np.load(path) as file:
            done = json.loads(str(file["meta"])).get("done")
    except Exception:  # as `load`, which the resumed run calls
        return None
    return done if isinstance(done, int) else None


@contextmanager
def defer_interrupt() -> Iterator[threading.Event]:
    """Turn Ctrl-C (and SIGTERM in the program) into an event that the loop checks between steps.

    If no check has seen it, the end of the context raises KeyboardInterrupt.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupt.asked_by(number)
        asked.set()

    numbers = [signal.SIGINT]
    # otherwise it is the caller's own handler
    if signal.getsignal(signal.SIGTERM) is interrupt.terminate:
        numbers.append(signal.SIGTERM)
    before = [(number, signal.signal(number, note)) for number in numbers]
    try:
        yield asked
    finally:
        for number, handler in before:
            signal.signal(number, handler)
    if asked.is_set():
        raise KeyboardInterrupt
