"""The two baselines that need no idea: a random subset, and opacity × area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.ranking import check_budget, keep_best
from g2ard.scene.splats import Splats

__all__ = ["opacity_area", "optical_mass", "random_subset"]


def random_subset(splats: Splats, budget: int, *, seed: int = 0) -> Splats:
    """`budget` Gaussians, each subset as likely as any other.

    Raises:
        InputError: the budget does not fit.
    """
    check_budget(splats, budget)
    kept = np.random.default_rng(seed).choice(len(splats), budget, replace=False)
    return splats.take(np.sort(kept))


def optical_mass(splats: Splats) -> NDArray[np.float64]:
    """(N,) −log(1 − α)·A, A the product of the two largest scales: π of `eq:importance` without protection.

    −log(1 − σ(x)) is softplus(x), which keeps its digits where α is near 1.
    """
    widest = np.sort(splats.scales.astype(np.float64), axis=1)[:, 1:]
    return np.logaddexp(0, splats.logit_opacities.astype(np.float64)) * widest.prod(1)


def opacity_area(splats: Splats, budget: int) -> Splats:
    """The `budget` Gaussians of largest `optical_mass`.

    Raises:
        InputError: the budget does not fit.
    """
    return keep_best(splats, optical_mass(splats), budget)
