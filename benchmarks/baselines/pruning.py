"""Scores of pruning methods other than PUP: optical mass, LightGaussian, Mini-Splatting and a coreset."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import Cameras
from g2ard.scene.shape import longer_axes
from g2ard.scene.splats import Splats

__all__ = [
    "global_significance",
    "importance",
    "keep_best",
    "largest_share",
    "optical_mass",
    "sample",
]

_VOLUME_POWER = 0.1
_VOLUME_RANK = 0.9


def keep_best(splats: Splats, scores: NDArray[np.float64], budget: int) -> Splats:
    """Keep the `budget` rows of highest score in order; lower indices win ties, NaN is lowest.

    >>> keep_best(Splats.create(np.eye(3), scales=np.ones((3, 3))), np.array([1, 3, 3]), 1).means.tolist()
    [[0.0, 1.0, 0.0]]
    """
    ranked = np.argsort(-np.where(np.isnan(scores), -np.inf, scores), kind="stable")
    return splats.take(np.sort(ranked[:budget]))


def optical_mass(splats: Splats) -> NDArray[np.float64]:
    """Return (N,) −log(1 − α)·A, A the product of the two largest scales.

    This is `eq:importance` without protection.
    −log(1 − σ(x)) is computed as softplus(x), which is accurate for α near 1.
    """
    widest = longer_axes(splats.scales.astype(np.float64))
    return np.logaddexp(0, splats.logit_opacities.astype(np.float64)) * widest.prod(1)


def global_significance(splats: Splats, cameras: Cameras) -> NDArray[np.float64]:
    """Return LightGaussian's (N,) scores I_j·(V_j / V*)^0.1 (arXiv 2311.17245).

    I_j = Σ σ_j·T over the pixels of all views that j touches (α = min(0.99, σG) ≥ 1/255, before the pixel
    stops). V is the product of the scales and V* the one at rank ⌊0.9 N⌋ from the largest. The method's
    fine-tuning (5,000 Adam steps at the rates of 3DGS) counts as recovery; SH distillation and quantisation
    are not included.
    """
    touched = visibility(splats, cameras).transmittance
    volume = splats.scales.astype(np.float64).prod(1)
    typical = np.sort(volume)[::-1][int(_VOLUME_RANK * len(volume))]
    relative = volume / max(typical, np.finfo(np.float64).tiny)
    return splats.opacities.astype(np.float64) * touched * relative**_VOLUME_POWER


def largest_share(splats: Splats, cameras: Cameras) -> NDArray[np.float64]:
    """Return (N,) the largest share of a view's light, Σ αT over all Gaussians, that comes from each of them.

    This is the sensitivity that a coreset keeps: no view loses a row that gives much of its picture.
    """
    largest = np.zeros(len(splats))
    for view in range(len(cameras)):
        weight = visibility(splats, cameras.take([view])).weight
        largest = np.maximum(largest, weight / max(weight.sum(), np.finfo(np.float64).tiny))
    return largest


def importance(splats: Splats, cameras: Cameras, *, indoor: bool = False) -> NDArray[np.float64]:
    """Return Mini-Splatting's (N,) importance summed over views (arXiv 2403.14166).

    A view adds w = Σ αT indoors. Outdoors it adds w / (pixels touched) if the Gaussian has the largest αT of
    one of its pixels. Gaussians that never have the largest αT of a pixel get 0. The method's blur split,
    depth reinitialisation and training from scratch are not included.
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
