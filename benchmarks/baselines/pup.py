"""PUP 3D-GS's pruning (arXiv 2406.10219) by the views' sensitivity to each Gaussian's position and size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.rendering.renderer import arrays_of, centred, settings_for, view_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

__all__ = ["fisher", "rounds", "sensitivity"]

_FIRST, _TOTAL = 0.2, 0.1
"""Shares kept after the release's first and second round."""

_DOWNSAMPLE = 4
_PROBES = 8
"""Random images per view that estimate F."""

_SINGULAR = 1e-7
"""Smallest eigenvalue of F with unit diagonal above rounding errors, since pixels are summed in float32."""


def fisher(
    splats: Splats, cameras: Cameras, *, probes: int = _PROBES, seed: int = 0
) -> NDArray[np.float64]:
    """Estimate (N, 6, 6) F = Σ g gᵀ over views, pixels and channels, g = ∂C/∂(mean, log scale).

    The gradient of an image weighted by random signs is Σ ±g. The mean of its outer products is F, because
    products of two pixels cancel on average. Each of the `probes` per view is one backward pass.
    """
    splats, cameras = centred(splats, cameras)
    settings, arrays = settings_for(splats.means), arrays_of(splats)
    rasterizer, rng = _core.Rasterizer(), np.random.default_rng(seed)
    out = np.zeros((len(splats), 6, 6))
    for i in range(len(cameras)):
        image, *_ = rasterizer.forward(
            arrays, view_of(cameras, i, settings), settings, [0.0] * 3, 0
        )
        for _ in range(probes):
            signs = rng.choice(np.array([-1, 1], np.float32), image.shape)
            means, _, log_scales, *_ = rasterizer.backward(arrays, signs)
            g = np.concatenate([means, log_scales], 1)
            seen = np.flatnonzero(g.any(1))
            g = g[seen].astype(np.float64)
            out[seen] += g[:, :, None] * g[:, None]
    return out / probes


def sensitivity(splats: Splats, cameras: Cameras) -> NDArray[np.float64]:
    """Return (N,) log det F at a quarter of the views' size; −∞ if F is singular."""
    return _log_det(fisher(splats, _quarter(cameras)))


def rounds(count: int, budget: int) -> list[int]:
    """Return the count after each round: for 10× a fifth, then half of that, as in the release.

    Other ratios are split in the same proportion of their logarithm.

    >>> rounds(1000, 100), rounds(1000, 1000)
    ([200, 100], [1000])
    """
    share = budget / count
    first = round(count * share ** (np.log(_FIRST) / np.log(_TOTAL)))
    return [first, budget] if budget < first < count else [budget]


def _quarter(cameras: Cameras) -> Cameras:
    """Shrink views to ⌈W/4⌉ × ⌈H/4⌉."""
    widths, heights = -(-cameras.widths // _DOWNSAMPLE), -(-cameras.heights // _DOWNSAMPLE)
    Ks = cameras.Ks.copy()
    Ks[:, 0] *= (widths / cameras.widths)[:, None]
    Ks[:, 1] *= (heights / cameras.heights)[:, None]
    return replace(cameras, Ks=Ks, widths=widths, heights=heights)


def _log_det(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log det F, from F scaled to a unit diagonal, whose eigenvalues separate rank from rounding."""
    diagonal = np.einsum("nii->ni", F)
    lively = (diagonal > 0).all(1) & np.isfinite(F).all((1, 2))
    root = np.sqrt(diagonal[lively])
    values = np.linalg.eigvalsh(F[lively] / (root[:, :, None] * root[:, None, :]))
    regular = values[:, 0] > _SINGULAR
    out = np.full(len(F), -np.inf)
    logs = np.log(np.where(regular[:, None], values, 1)).sum(1) + 2 * np.log(root).sum(1)
    out[lively] = np.where(regular, logs, -np.inf)
    return out
