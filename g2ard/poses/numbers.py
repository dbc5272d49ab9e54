"""Sums, quantiles and an order whose bits do not depend on the file's row order or on threads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.scene.splats import Splats

Floats = NDArray[np.float64]


def quantile(values: Floats, weights: Floats, shares: Any) -> Floats:
    """Return the values below which the given shares of the weight lie.

    >>> quantile(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 2.0]), [0.2, 0.5, 1.0]).tolist()
    [1.0, 2.0, 3.0]
    """
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    at = np.searchsorted(total, np.asarray(shares) * total[-1])
    return values[order][np.minimum(at, len(order) - 1)]


def middle(values: Floats) -> float:
    """Return the lower median, which is always one of the values."""
    rank = (len(values) - 1) // 2
    return float(np.partition(values, rank)[rank])


def along(vectors: Floats, axis: Floats) -> Floats:
    """Return (M,) dot products with one axis. A matrix product may change bits with the number of threads."""
    return vectors[:, 0] * axis[0] + vectors[:, 1] * axis[1] + vectors[:, 2] * axis[2]


def norms(vectors: Floats) -> Floats:
    """Return (M,) lengths of rows."""
    return np.sqrt(sum(column * column for column in vectors.T))


def turned(vectors: Floats, axes: Floats) -> Floats:
    """Return (M, 3) coordinates along the three rows of `axes`."""
    return np.stack([along(vectors, axis) for axis in axes], axis=1)


def moments(vectors: Floats, weights: Floats) -> Floats:
    """Return the (D, D) weighted sum of outer products of (M, D) rows."""
    return np.array([[(weights * a * b).sum() for b in vectors.T] for a in vectors.T])


def canonical_order(splats: Splats, rows: NDArray[Any]) -> NDArray[Any]:
    """Return an order of rows by a hash of opacity, rotation and colour; ties by place and size.

    Moving or scaling a scene keeps the order. Sums in it do not depend on the file's row order, and a prefix
    is a random sample.
    """
    key = np.zeros(len(rows), np.uint64)
    for block in (splats.logit_opacities[:, None], splats.quats, splats.sh0[:, 0]):
        for column in block[rows].T:
            bits = np.ascontiguousarray(column + np.float32(0)).view(np.uint32)
            key ^= bits
            key *= np.uint64(0x9E3779B97F4A7C15)
            key ^= key >> np.uint64(29)
    order = np.argsort(key)
    same = key[order[1:]] == key[order[:-1]]
    tied = np.append(same, False) | np.append(False, same)
    if tied.any():
        among = order[tied]
        at = rows[among]
        columns = [*splats.scales[at].T, *splats.means[at].T[::-1], key[among]]
        order[tied] = among[np.lexsort(columns)]
    return order
