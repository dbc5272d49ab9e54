"""Points on surfaces, for tests of the lift."""

import numpy as np


def surface(count=400, seed=0):
    """A wavy surface, sampled at random."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-5, 5, (2, count))
    return np.stack([x, y, np.sin(x) + 0.01 * rng.normal(size=count)], 1)


def lines(count, each, noise=0.004, seed=0):
    """A plane of 6 × 6 scanned in lines: points and the distance of lines."""
    x, y = np.tile(np.linspace(-3, 3, each), count), np.repeat(np.linspace(-3, 3, count), each)
    return np.column_stack([x, y, np.random.default_rng(seed).normal(0, noise, len(x))]), 6 / (
        count - 1
    )
