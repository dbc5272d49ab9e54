"""Rows of binary tables, with errors that name the truncated or invalid column."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from g2ard.errors import DAMAGED, InputError


class Record:
    """Layout of little-endian columns without padding.

    Args:
        names: names of the columns in file order.
        letters: struct format of each.

    >>> Record(("ID", "X", "Y"), "Qdd").size
    24
    """

    def __init__(self, names: Sequence[str], letters: str) -> None:
        self._names = tuple(names)
        self._layout = struct.Struct(f"<{letters}")
        self._ends = [struct.calcsize(f"<{letters[: i + 1]}") for i in range(len(letters))]
        self.size = self._layout.size

    def read(self, path: Path, entry: str, i: int, data: bytes, at: int) -> tuple[Any, ...]:
        """Return the values at byte `at`; `entry` and `i`, such as "camera" and 3, are for errors."""
        try:
            return self._layout.unpack_from(data, at)
        except struct.error:
            ends = zip(self._names, self._ends, strict=True)
            name = next(name for name, end in ends if at + end > len(data))
            raise InputError(
                "is cut off", path=path, property=name, index=i, item=entry, hint=DAMAGED
            ) from None

    def read_finite(self, path: Path, entry: str, i: int, data: bytes, at: int) -> tuple[Any, ...]:
        """Return the values as `read` does, or raise an `InputError` if one is not finite."""
        values = self.read(path, entry, i, data, at)
        for name, value in zip(self._names, values, strict=True):
            if not math.isfinite(value):
                raise InputError(f"is {value}", path=path, property=name, index=i, item=entry)
        return values
