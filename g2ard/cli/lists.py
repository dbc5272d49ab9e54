"""Numbers typed as one word: 1,2,3."""

from __future__ import annotations

import math

import typer

__all__ = ["numbers"]


def numbers(option: str, text: str, count: int) -> list[float]:
    """`count` finite numbers, parted by commas or blanks.

    >>> numbers("--box", "0, 0,0 1,1,1e1", 6)
    [0.0, 0.0, 0.0, 1.0, 1.0, 10.0]
    """
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise typer.BadParameter(f"{option}: expected {count} numbers with commas between, got {text!r}")
    return found
