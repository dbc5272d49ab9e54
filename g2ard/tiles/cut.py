"""One budget over many tiles: which of all their merges are the cheapest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["cheapest"]

_HALF = 1 << 16


def cheapest(costs: Sequence[Callable[[], NDArray[np.float32]]], count: int) -> list[int]:
    """How many of the `count` smallest of all costs lie in each array; of equals the earlier ones count.

    Non-negative floats sort as their bits do: two histograms, of the upper and of the lower 16 bits, find the
    count-th without more than one array in memory.

    Args:
        costs: functions that give arrays of float32 ≥ 0, asked three times each.
        count: at most as many as there are.

    >>> few = [np.array([3, 1, 1], np.float32), np.array([1, 0, 2], np.float32)]
    >>> cheapest([lambda a=a: a for a in few], 3)
    [2, 1]
    """
    if count <= 0:
        return [0] * len(costs)
    upper = sum((_histogram(_bits(make) >> 16) for make in costs), np.zeros(_HALF, np.int64))
    first, below = _rank(upper, count)
    lower = sum(
        (_histogram(bits[bits >> 16 == first] & np.uint32(0xFFFF)) for bits in map(_bits, costs)),
        np.zeros(_HALF, np.int64),
    )
    second, under = _rank(lower, count - below)
    limit = np.uint32(first << 16 | second)
    ties = count - below - under
    counts = []
    for bits in map(_bits, costs):
        equal = min(ties, int(np.count_nonzero(bits == limit)))
        ties -= equal
        counts.append(int(np.count_nonzero(bits < limit)) + equal)
    return counts


def _bits(make: Callable[[], NDArray[np.float32]]) -> NDArray[np.uint32]:
    return np.ascontiguousarray(make(), np.float32).view(np.uint32)


def _histogram(values: NDArray[Any]) -> NDArray[np.int64]:
    return np.bincount(values, minlength=_HALF)


def _rank(histogram: NDArray[np.int64], count: int) -> tuple[int, int]:
    """The bin that holds the count-th value, and how many lie before that bin."""
    sums = np.cumsum(histogram)
    at = min(int(np.searchsorted(sums, count)), len(sums) - 1)
    return at, int(sums[at - 1]) if at else 0
