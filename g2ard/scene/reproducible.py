"""Sums, quantiles, orders and even sequences whose bits do not depend on row order or threads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.arrays import Float, Int, Rows, Values
from g2ard.scene.splats import Splats

_GOLDEN = (np.sqrt(5) - 1) / 2
"""Turn between neighbours of a Fibonacci lattice."""

_TINY = np.finfo(np.float64).tiny


def quantile(values: Float, weights: Float, shares: Any) -> Float:
    """Return the values below which the given shares of the weight lie.

    >>> quantile(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 2.0]), [0.2, 0.5, 1.0]).tolist()
    [1.0, 2.0, 3.0]
    """
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    reached = np.asarray(shares) * total[-1]
    at = np.searchsorted(total, reached)
    at = np.minimum(at, len(order) - 1)
    return values[order][at]


def quantiles(points: Float, weights: Float, shares: Any) -> Float:
    """Return `quantile` along each axis of (M, D) points: (D,), or (D, K) for K shares."""
    return np.array([quantile(column, weights, shares) for column in points.T])


def middle(values: Float) -> Any:
    """Return the lower median along the first axis, which is always one of the values."""
    rank = (len(values) - 1) // 2
    return np.partition(values, rank, axis=0)[rank]


def joined(root: Int, a: Values, b: Values) -> Int:
    """Join groups by edges a–b, where `root` is the smallest row of each row's group.

    >>> joined(np.arange(5), np.array([3, 1]), np.array([4, 3])).tolist()
    [0, 1, 2, 1, 1]
    """
    root = root.copy()
    while True:
        a = root[a]
        b = root[b]
        apart = a != b
        if not apart.any():
            return root
        a = a[apart]
        b = b[apart]
        np.minimum.at(root, np.maximum(a, b), np.minimum(a, b))
        root = _shorten_paths(root)


def _shorten_paths(root: Int) -> Int:
    """Let each row point to the root of its group rather than to another row."""
    while True:
        further = root[root]
        if np.array_equal(further, root):
            return root
        root = further


def along(vectors: Float, axis: Float) -> Float:
    """Return (M,) dot products with one axis. A matrix product may change bits with the number of threads."""
    products = vectors[:, 0] * axis[0]
    products += vectors[:, 1] * axis[1]
    products += vectors[:, 2] * axis[2]
    return products


def norms(vectors: Float) -> Float:
    """Return (M,) lengths of rows."""
    return np.sqrt(sum(column * column for column in vectors.T))


def normalized(vectors: Float) -> Float:
    """Return (M, D) rows of length 1; zero rows stay."""
    return vectors / positive(norms(vectors))[:, None]


def positive(values: Any) -> Any:
    """Return values that can be divided by: the least positive number in place of zeros and negatives."""
    return np.maximum(values, _TINY)


def turned(vectors: Float, axes: Float) -> Float:
    """Return (M, 3) coordinates along the three rows of `axes`."""
    return np.stack([along(vectors, axis) for axis in axes], axis=1)


def moments(vectors: Float, weights: Float) -> Float:
    """Return the (D, D) weighted sum of outer products of (M, D) rows."""
    columns = vectors.T
    sums = np.empty((len(columns), len(columns)))
    for i, a in enumerate(columns):
        for j, b in enumerate(columns):
            sums[i, j] = (weights * a * b).sum()
    return sums


def between(ends: Any, share: Float) -> Float:
    """Return points between two ends.

    >>> float(between((10, 20), 0.3))
    13.0
    """
    low, high = ends
    return low + (high - low) * share


def directions(turn: Float, level: Float, height: ArrayLike) -> Float:
    """Return (M, 3) vectors at `turn` turns around z, of lengths `level` across it and `height` along it."""
    angle = 2 * np.pi * turn
    x = level * np.cos(angle)
    y = level * np.sin(angle)
    return np.stack([x, y, height], axis=1)


def directions_at(turn: Float, rise: Float) -> Float:
    """Return (M, 3) unit vectors at `turn` turns around z, `rise` radians above the horizon."""
    return directions(turn, np.cos(rise), np.sin(rise))


def around(vector: Float, angles: Float) -> Float:
    """Return (K, 3): a vector turned around z by K angles, radians.

    >>> around(np.array([1.0, 0.0, 5.0]), np.array([0.0, np.pi / 2, np.pi])).round(9).tolist()
    [[1.0, 0.0, 5.0], [0.0, 1.0, 5.0], [-1.0, 0.0, 5.0]]
    """
    x, y, z = vector
    cosine = np.cos(angles)
    sine = np.sin(angles)
    turned_x = x * cosine - y * sine
    turned_y = x * sine + y * cosine
    return np.stack([turned_x, turned_y, np.full(len(angles), z)], axis=1)


def fibonacci(count: int, low: float = -1.0, high: float = 1.0) -> Float:
    """Return (count, 3) unit vectors, each representing the same area of the sphere.

    They cover the heights z from `high` down to `low`.
    """
    steps = np.arange(count)
    z = high - (high - low) * (steps + 0.5) / count
    turn = steps * _GOLDEN % 1
    return directions(turn, np.sqrt(1 - z * z), z)


def halton(start: int, stop: int, dimensions: int, seed: int) -> Float:
    """Return (stop − start, dimensions) points of Halton's endless sequence in the unit cube.

    `dimensions` is at most 6. The points are shifted on the torus by `seed`.
    """
    shift = np.random.default_rng(seed).random(dimensions)
    columns = np.empty((stop - start, dimensions))
    for column, base in zip(columns.T, (2, 3, 5, 7, 11, 13), strict=False):
        # The digits of the index in this base, mirrored at the point.
        index = np.arange(start + 1, stop + 1)
        digit_worth = 1.0
        column[:] = 0
        while index.any():
            digit_worth /= base
            column += digit_worth * (index % base)
            index = index // base
    return (columns + shift) % 1


def strata(features: Float, size: int, seed: int) -> Values:
    """Return an order in which every `size`-th row is a fair sample of all.

    The rows are halved along the widest feature into groups of at most `size` similar rows. In each group, a
    random row comes first and the others follow.
    """
    chance = np.random.default_rng(seed)
    groups: list[Values] = []
    todo = [np.arange(len(features))]
    while todo:
        rows = todo.pop()
        if len(rows) <= size:
            first = int(chance.integers(len(rows)))
            groups.append(np.roll(rows, first))
            continue
        sides = np.ptp(features[rows], axis=0)
        widest = np.argmax(sides)
        rows = rows[np.argsort(features[rows, widest], kind="stable")]
        groups_inside = -(-len(rows) // size)  # rounded up
        cut = size * max(1, groups_inside // 2)  # so that only the last group is smaller
        todo += [rows[cut:], rows[:cut]]
    return np.concatenate(groups)


def merge_equal(points: Float, colors: Values) -> tuple[Rows, Values]:
    """Return the first row of each position, ascending, and the mean colour there.

    Positions are equal if their float32 values are, which is all that a scene can hold.

    Args:
        points: (N, 3) relative to a point amid them.
    """
    with np.errstate(over="ignore"):
        exact = points.astype(np.float32) + np.float32(0)  # -0 is 0
    order = np.lexsort(exact.T[::-1])  # by x, then y, then z
    in_order = exact[order]
    new = np.ones(len(points), bool)  # in this order, whether each differs from the one before
    new[1:] = (in_order[1:] != in_order[:-1]).any(axis=1)
    if new.all():
        return np.arange(len(points)), colors
    firsts = order[new]
    by_row = np.argsort(firsts)
    number = np.empty(len(firsts), np.intp)  # of each group, by its first row
    number[by_row] = np.arange(len(firsts))
    group = np.empty(len(points), np.intp)
    group[order] = number[np.cumsum(new) - 1]
    counts = np.bincount(group)
    totals = [np.bincount(group, channel) for channel in colors.T]
    means = np.stack(totals, axis=1) / counts[:, None]
    return firsts[by_row], means


def canonical_order(splats: Splats, rows: Values, most: int | None = None) -> Values:
    """Return an order of rows by a hash of opacity, rotation and colour; ties by place and size.

    Moving or scaling a scene keeps the order. Sums in it do not depend on the file's row order, and a prefix
    is a random sample; only the first `most` are returned.
    """
    key = _hash_looks(splats, rows)
    first = np.arange(len(rows))
    if most is not None and most < len(rows):
        limit = np.partition(key, most)[most]
        first = np.flatnonzero(key <= limit)
    order = first[np.argsort(key[first])]
    in_order = key[order]
    same = in_order[1:] == in_order[:-1]
    tied = np.append(same, False)
    tied |= np.append(False, same)
    if tied.any():
        among = order[tied]
        at = rows[among]
        # the last counts first
        columns = [
            *splats.scales[at].T,
            *splats.means[at].T[::-1],
            key[among],
        ]
        order[tied] = among[np.lexsort(columns)]
    return order[:most]


def _hash_looks(splats: Splats, rows: Values) -> NDArray[np.uint64]:
    """Return a hash of opacity, rotation and colour per row."""
    key = np.zeros(len(rows), np.uint64)
    blocks = (
        splats.logit_opacities[:, None],
        splats.quats,
        splats.sh0[:, 0],
    )
    for block in blocks:
        for column in block[rows].T:
            bits = np.ascontiguousarray(column + np.float32(0)).view(np.uint32)
            key ^= bits
            key *= np.uint64(0x9E3779B97F4A7C15)
            key ^= key >> np.uint64(29)
    return key
