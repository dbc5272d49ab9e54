"""Order in which recovery draws its views: evenly, or in proportion to their weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.errors import InputError, require


def checked_weights(weights: ArrayLike | None, count: int) -> NDArray[np.float64] | None:
    """Check the weights of `count` views and return them with mean 1; None stays None.

    Raises:
        InputError: another length, or values that are negative, not finite, or all zero.
    """
    if weights is None:
        return None
    values = np.asarray(weights, np.float64)
    require("weights", f"shape {values.shape}", values.shape == (count,), f"{count} weights, one per view")
    bad = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
    if len(bad):
        raise InputError(f"view {bad[0]}: {values[bad[0]]} is not a number ≥ 0", parameter="weights")
    if not values.any():
        raise InputError("all are zero, so no view can be drawn", parameter="weights")
    values = values / values.max()  # their sum must not overflow
    return values / values.mean()


def drawn(seed: int, epoch: int, count: int, weights: NDArray[np.float64] | None = None) -> NDArray[np.int64]:
    """Return the `count` views of an epoch, in a random order that depends only on the arguments.

    Without weights, every view appears once. With (count,) weights w from `checked_weights`, view v appears
    ⌊w_v⌋ or ⌈w_v⌉ times, w_v on average (systematic sampling). This is far less noisy than independent draws,
    and equal weights change no bit.

    >>> import numpy as np
    >>> np.bincount(drawn(0, 0, 4, np.array([2.0, 1.0, 1.0, 0.0]))).tolist()
    [2, 1, 1]
    """
    views = np.arange(count)
    if weights is not None:
        ends = np.cumsum(weights)
        ticks = (views + np.random.default_rng((seed, epoch, 1)).random()) * (ends[-1] / count)
        views = np.minimum(np.searchsorted(ends, ticks, side="right"), np.flatnonzero(weights)[-1])
    return np.random.default_rng((seed, epoch)).permutation(views)
