"""Simple baselines: a random subset, and opacity × area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.ranking import check_budget, keep_best
from g2ard.scene.splats import Splats

__all__ = ["opacity_area", "optical_mass", "random_subset"]


def random_subset(splats: Splats, budget: int, *, seed: int = 0) -> Splats:
    """Keep a uniformly random subset of `budget` Gaussians."""
    check_budget(splats, budget)
    kept = np.random.default_rng(seed).choice(len(splats), budget, replace=False)
    return splats.take(np.sort(kept))


def optical_mass(splats: Splats) -> NDArray[np.float64]:
    """Return (N,) −log(1 − α)·A, A the product of the two largest scales.

    This is `eq:importance` without protection.
    −log(1 − σ(x)) is computed as softplus(x), which is accurate for α near 1.
    """
    widest = np.sort(splats.scales.astype(np.float64), axis=1)[:, 1:]
    return np.logaddexp(0, splats.logit_opacities.astype(np.float64)) * widest.prod(1)


def opacity_area(splats: Splats, budget: int) -> Splats:
    """Keep the `budget` Gaussians of largest `optical_mass`."""
    return keep_best(splats, optical_mass(splats), budget)
