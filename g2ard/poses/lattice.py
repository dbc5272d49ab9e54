"""Points that cover spheres, squares and intervals evenly, at any count."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_GOLDEN = (np.sqrt(5) - 1) / 2


def fibonacci(count: int, low: float = -1.0, high: float = 1.0) -> Floats:
    """Return (count, 3) unit vectors, each representing the same area of the sphere.

    They cover the heights z from `high` down to `low`.

    >>> bool(np.abs(fibonacci(1000).mean(axis=0)).max() < 0.01)
    True
    """
    steps = np.arange(count)
    z = high - (high - low) * (steps + 0.5) / count
    around = 2 * np.pi * (steps * _GOLDEN % 1)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(around), across * np.sin(around), z], axis=1)


def halton(start: int, stop: int, dimensions: int, seed: int) -> Floats:
    """Return (stop − start, dimensions) points of Halton's endless sequence in the unit cube.

    `dimensions` is at most 6. The points are shifted on the torus by `seed`.

    >>> bool(np.abs(halton(0, 1000, 3, seed=0).mean(axis=0) - 0.5).max() < 0.01)
    True
    """
    shift = np.random.default_rng(seed).random(dimensions)
    columns = np.empty((stop - start, dimensions))
    for column, base in zip(columns.T, (2, 3, 5, 7, 11, 13), strict=False):
        index, share = np.arange(start + 1, stop + 1), 1.0
        column[:] = 0
        while index.any():
            share /= base
            column += share * (index % base)
            index = index // base
    return (columns + shift) % 1


def strata(features: Floats, size: int, seed: int) -> NDArray[Any]:
    """Return an order in which every `size`-th row is a fair sample of all.

    The rows are halved along the widest feature into groups of at most `size` similar rows. In each group, a
    random row comes first and the others follow.

    >>> order = strata(np.arange(16.0)[:, None], 8, seed=0)
    >>> sorted(order[:8].tolist()), sorted(order[8:].tolist()) == list(range(8, 16))
    ([0, 1, 2, 3, 4, 5, 6, 7], True)
    """
    chance = np.random.default_rng(seed)
    groups: list[NDArray[Any]] = []
    todo = [np.arange(len(features))]
    while todo:
        rows = todo.pop()
        if len(rows) <= size:
            groups.append(np.roll(rows, int(chance.integers(len(rows)))))
            continue
        widest = int(np.argmax(np.ptp(features[rows], axis=0)))
        rows = rows[np.argsort(features[rows, widest], kind="stable")]
        cut = size * max(1, -(-len(rows) // size) // 2)
        todo += [rows[cut:], rows[:cut]]
    return np.concatenate(groups)
