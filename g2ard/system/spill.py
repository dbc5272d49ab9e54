"""Arrays beyond what memory should hold, in a temporary file."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Hashable
from pathlib import Path
from shutil import disk_usage
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any

import numpy as np

from g2ard.arrays import Values

_FREE_BYTES = 1_000_000_000
"""Bytes of the disk left free for other files."""
_NOTES: list[str] = []
"""Pending messages, see `notes`."""


def notes() -> list[str]:
    """Return and clear pending messages, such as that a disk is full."""
    pending = list(_NOTES)
    _NOTES.clear()
    return pending


class Spill:
    """Arrays by key in an unnamed file, which disappears with this object.

    The environment variable `TMPDIR` chooses its folder. The default is `/var/tmp` where that exists, because
    `/tmp` may be in memory. A full disk or a missing folder is no error: from then on nothing is added. A
    copy, such as one for another process, begins empty. `notes` tells about a full disk.

    >>> spill = Spill()
    >>> spill.add("a", np.arange(3))
    >>> spill.get("a"), spill.get("b")
    (array([0, 1, 2]), None)
    """

    def __init__(self) -> None:
        self.full = False
        self._file: IO[bytes] | None = None
        self._places: dict[Hashable, tuple[Any, int, tuple[int, ...]]] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[Spill], tuple[()]]:
        return Spill, ()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._places

    def add(self, key: Hashable, array: Values) -> None:
        """Write an array that is not empty, unless the disk is full."""
        with self._lock:
            if self.full or key in self._places:
                return
            try:
                start = self._append(array)
            except OSError:
                self.full = True
                _note_lack(_choose_folder())
            else:
                self._places[key] = array.dtype, start, array.shape

    def _append(self, array: Values) -> int:
        folder = _choose_folder()
        if disk_usage(folder).free < array.nbytes + _FREE_BYTES:
            raise OSError
        if self._file is None:
            self._file = TemporaryFile(buffering=0, dir=folder)  # noqa: SIM115  (stays open with this object)
            weakref.finalize(self, self._file.close)
        start = self._file.seek(0, os.SEEK_END)
        if self._file.write(np.ascontiguousarray(array).data) < array.nbytes:
            raise OSError
        return start

    def get(self, key: Hashable) -> Values | None:
        """Return an array, or None if it is not in the file. Changes to it do not reach the file."""
        if key not in self._places:
            return None
        dtype, start, shape = self._places[key]
        # Mapped anew by each call: no thread moves another's position, and the memory is free afterwards.
        mapped: Values = np.memmap(self._file, dtype, "c", start, shape)  # type: ignore[call-overload]
        return mapped.view(np.ndarray)


def _note_lack(folder: str) -> None:
    lack = f"{folder} has no room for all images; the others are made again at each use"
    note = f"warning: {lack} (TMPDIR chooses another folder)"
    if note not in _NOTES:
        _NOTES.append(note)


def _choose_folder() -> str:
    large = Path("/var/tmp")
    return str(large) if "TMPDIR" not in os.environ and large.is_dir() else gettempdir()
