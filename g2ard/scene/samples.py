"""Evenly spaced indices and samples, and weighted quantiles."""

from typing import Protocol, TypeVar

import numpy as np

from g2ard.arrays import Int, Values

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


def evenly_spaced(count: int, most: int, *, floor: bool = False) -> list[int]:
    """Return at most `most` evenly spaced indices below `count`, the first and last included.

    `floor` rounds down instead of to the nearest index.

    >>> evenly_spaced(9, 3), evenly_spaced(2, 3), evenly_spaced(4, 3), evenly_spaced(4, 3, floor=True)
    ([0, 4, 8], [0, 1], [0, 2, 3], [0, 1, 3])
    """
    spaced = np.linspace(0, count - 1, min(count, most))
    if floor:
        spaced = np.floor(spaced)
    else:
        spaced = np.round(spaced)
    indices: list[int] = np.unique(spaced.astype(int)).tolist()
    return indices


class Takeable(Protocol[T_co]):
    """Rows that can be taken, such as Gaussians or views."""

    def __len__(self) -> int: ...
    def take(self, index: Int, /) -> T_co: ...


def take_evenly(rows: Takeable[T], most: int, *, floor: bool = False) -> T:
    """Return at most `most` Gaussians or views, see `evenly_spaced`."""
    indices = evenly_spaced(len(rows), most, floor=floor)
    return rows.take(np.array(indices, np.int64))


def spread(count: int) -> Int:
    """Return the indices below `count` in an order of which every prefix is spread evenly (van der Corput's).

    >>> spread(6).tolist(), spread(0).tolist()
    ([0, 4, 2, 1, 5, 3], [])
    """
    bits = max(count - 1, 0).bit_length()
    order = np.zeros(1, np.int64)
    for bit in reversed(range(bits)):
        order = np.concatenate([order, order + (1 << bit)])
    return order[order < count]


def weighted_quantile(values: Values, weights: Values, share: float) -> float:
    """Return the value below which the share of the weight lies.

    >>> weighted_quantile(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 2.0]), 0.5)
    2.0
    """
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    rank = np.searchsorted(total, share * total[-1])
    return float(values[order[rank]])
