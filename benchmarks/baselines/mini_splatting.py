"""Mini-Splatting's simplification (arXiv 2403.14166): sampling by importance over the training views.

Its blur split, depth reinitialisation and training from scratch are not included.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.ranking import check_budget
from g2ard.progress import Progress, silent
from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

__all__ = ["importance", "mini_splatting", "sample"]


def importance(
    splats: Splats, cameras: Cameras, *, indoor: bool = False, progress: Progress = silent
) -> NDArray[np.float64]:
    """Return (N,) importance summed over views, 0 for Gaussians that never have the largest αT of a pixel.

    A view adds w = Σ αT indoors. Outdoors it adds w / (pixels touched) if the Gaussian has the largest αT of
    one of its pixels.
    """
    total, leads = np.zeros(len(splats)), np.zeros(len(splats), np.uint64)
    for view in range(len(cameras)):
        seen = visibility(splats, cameras.take([view]))
        leads += seen.dominant
        if indoor:
            total += seen.weight
        else:
            share = seen.weight / np.maximum(seen.hits, 1)
            total += np.where(seen.dominant > 0, share, 0.0)
        progress("importance", view + 1, len(cameras))
    return np.where(leads > 0, total, 0.0)


def sample(weights: NDArray[np.float64], count: int, *, seed: int = 0) -> NDArray[np.intp]:
    """Sample `count` ascending indices without replacement, each draw with p ∝ the remaining weights.

    The first `count` arrivals of exponential clocks of rate `weights` are such a sample. Zero weights come
    last, in random order.

    >>> sample(np.array([0.0, 1, 0, 5]), 2).tolist()
    [1, 3]
    """
    rng = np.random.default_rng(seed)
    clocks, chance = rng.exponential(size=len(weights)), rng.random(len(weights))
    with np.errstate(divide="ignore"):
        arrival = np.where(weights > 0, clocks / np.where(weights > 0, weights, 1), np.inf)
    return np.sort(np.lexsort((chance, arrival))[:count])


def mini_splatting(
    splats: Splats,
    budget: int,
    cameras: Cameras,
    *,
    seed: int = 0,
    indoor: bool = False,
    progress: Progress = silent,
) -> Splats:
    """Sample exactly `budget` Gaussians by `importance`."""
    check_budget(splats, budget)
    weights = importance(splats, cameras, indoor=indoor, progress=progress)
    return splats.take(sample(weights, budget, seed=seed))
