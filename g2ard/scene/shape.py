"""Shapes of Gaussians: needles, the effective rank, and the two longer axes."""

import numpy as np

from g2ard.arrays import Float, Float32, Values

NEEDLE_RANK = 1.1
"""Effective rank below which reports count a Gaussian as a needle."""

NEEDLE_LENGTH = 10.0
"""Ratio of length to width above which cleaning looks at a Gaussian as a needle or a streak."""

NEEDLE_UNIT = 1e-2
"""Least ratio of the middle to the largest scale in recovery: a needle's unit is at least a tenth of its
length."""


def longer_axes(scales: Values) -> Values:
    """Return the (N, 2) scales of the two longer axes, ascending.

    >>> longer_axes(np.array([[3, 1, 2]])).tolist()
    [[2, 3]]
    """
    return np.sort(scales, axis=1)[:, 1:]


def elongation(scales: Values) -> Float:
    """Return (N,) the largest over the middle of (N, 3) scales, infinite if only the middle one is 0.

    >>> elongation(np.array([[3, 1, 2]])).tolist()
    [1.5]
    """
    middle, largest = longer_axes(scales.astype(np.float64)).T
    with np.errstate(all="ignore"):
        return np.asarray(largest / middle)


def effective_rank(scales: Float32) -> Float:
    """Return (N,) exp(−Σ q log q), q = s/Σs, in [1, 3].

    >>> effective_rank(np.array([[1, 1, 1], [1, 1, 1e-9], [1, 1e-9, 1e-9]])).round(3).tolist()
    [3.0, 2.0, 1.0]
    """
    q = scales.astype(np.float64)
    tiny = np.finfo(np.float64).tiny
    q /= np.maximum(q.sum(1, keepdims=True), tiny)
    information = q * np.log(np.maximum(q, tiny))
    return np.exp(-information.sum(1))


def needle_share(scales: Float32) -> float:
    """Return the share of needles: Gaussians whose effective rank is below `NEEDLE_RANK`."""
    if not len(scales):
        return 0.0
    return float((effective_rank(scales) < NEEDLE_RANK).mean())
