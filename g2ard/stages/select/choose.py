"""View selection: an order of the candidates, their gains and sampling weights."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

import g2ard.stages.select.poses as poses
from g2ard.arrays import Float, Int
from g2ard.config.checks import checks_arguments
from g2ard.config.choices import POLICIES
from g2ard.errors import InputError, require
from g2ard.progress import Progress, plural, silent
from g2ard.scene.cameras import Cameras, unseeing
from g2ard.scene.splats import Splats
from g2ard.stages.select.surfaces import CoverageOptions, greedy

_LEAST_CURVE_BEND = 0.02
"""Height above its chord below which a curve counts as straight, so that no K stands out."""
_LARGEST_VIEW_SIDE = 32_768
"""Largest side of a view in pixels that the rasteriser accepts."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen views, best first.

    Args:
        policy: selection policy.
        order: (K,) indices into the candidates.
        gains: (K,) gain of each in the policy's objective when it was chosen, as a share of the pool's total.
        weights: (K,) sampling weights, mean 1: the share of the pool that each represents, with crowded poses
            counted less.
        left_out: share of the total that the remaining candidates would add.
        curve: (n,) share of the total reached by the first 1, 2, … n views, for all usable candidates.
        refused: indices of candidates that see nothing of the scene or lie inside geometry.
        evaluations: number of gains computed; 0 for policies that compute none.
        seconds: time by stage.
    """

    policy: str
    order: Int
    gains: Float
    weights: Float
    left_out: float
    curve: Float
    refused: Int
    evaluations: int = 0
    seconds: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Selection({plural(len(self.order), 'view')}, policy={self.policy!r})"


@checks_arguments
def select(
    splats: Splats,
    cameras: Cameras,
    k: int | Literal["auto"],
    *,
    policy: str = "auto",
    options: CoverageOptions | None = None,
    progress: Progress = silent,
) -> Selection:
    """Choose `k` of the candidate views.

    Args:
        splats: the dense scene; only its geometry matters, not the views' images.
        cameras: C candidates, in world coordinates.
        k: number of views; C or more takes all, best first. "auto" stops where the curve of gains flattens,
            at the K farthest above its chord; all, if the curve is straight.
        policy: one of `POLICIES`. "auto" uses poses only: farthest pose first until all are within reach,
            then facility location Σ_u w_u max_{v∈S} exp(−(d_uv/0.35)²) with crowded poses weighted less.
            "directional" is the paper's.
        options: options of "directional".
        progress: called with the number of views rasterised.

    Returns:
        The chosen views with gains and weights.

    Raises:
        InputError: an invalid `k`, an unknown policy, no candidates, or none that sees the scene.

    >>> from g2ard.scene.cameras import look_at
    >>> ball = Splats.create(np.random.default_rng(0).normal(size=(500, 3)), scales=np.full((500, 3), 0.1))
    >>> around = [look_at([4 * np.cos(a), 4 * np.sin(a), 0], [0, 0, 0]) for a in (0.0, 0.1, 0.2, 3.1)]
    >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
    >>> views = Cameras.from_lists(around, [K] * 4, [(64, 64)] * 4, list("abcd"))
    >>> select(ball, views, 2).order.tolist()
    [1, 3]
    """
    _check(cameras, k, policy)
    began = time.perf_counter()
    seconds: dict[str, float] = {}
    progress("select", 0, 0)
    candidates = poses.measure_candidates(splats, cameras, progress)
    alike = candidates.alike
    usable = candidates.usable
    seconds["poses"] = time.perf_counter() - began
    evaluations = 0
    refused = ~usable
    if policy == "directional":
        rows = np.flatnonzero(usable)
        order, gains, evaluations = greedy(splats, cameras.take(rows), options, progress, seconds)
        order = rows[order]
        # also views that see no cell, which greedy drops
        refused = ~np.isin(np.arange(len(cameras)), order)
    else:
        of_usable = np.where(usable, candidates.weights, 0.0)
        order = poses.facility_location(alike, of_usable, usable, candidates.shares)
        gains = poses.gains_of(order, alike, of_usable)
    if not len(order):
        raise InputError(unseeing(cameras, "a cell of the surface"))
    if k == "auto":
        count = _find_knee(gains)
    else:
        count = min(k, len(order))
    total = gains.sum()
    if total > 0:
        share = gains / total
    else:
        share = np.full(len(gains), 1 / len(gains))
    seconds["total"] = time.perf_counter() - began
    return Selection(
        policy=policy,
        order=order[:count],
        gains=share[:count],
        weights=poses.draw_weights(order[:count], alike, candidates.weights),
        left_out=float(share[count:].sum()),
        curve=np.cumsum(share),
        refused=np.flatnonzero(refused),
        evaluations=evaluations,
        seconds=seconds,
    )


def _check(cameras: Cameras, k: int | Literal["auto"], policy: str) -> None:
    """Reject an invalid number, an unknown policy, and candidates that are missing or too large."""
    require("policy", repr(policy), policy in POLICIES, ", ".join(POLICIES))
    require("k", k, k == "auto" or k >= 1, "at least 1 view")
    if not len(cameras):
        raise InputError("no candidate views to select from")
    large = cameras.sides > _LARGEST_VIEW_SIDE
    if large.any():
        i = int(np.argmax(large))
        size = f"{cameras.widths[i]}×{cameras.heights[i]}"
        raise InputError(
            f"view {cameras.names[i]}: expected at most {_LARGEST_VIEW_SIDE} pixels per side, got {size}"
        )


def _find_knee(gains: Float) -> int:
    """Return the count where cumulative gains lie farthest above their chord; all if straight.

    >>> _find_knee(np.array([5.0, 4.0, 3.0, 0.1, 0.1, 0.1, 0.1])), _find_knee(np.array([1.0, 1.0, 1.0]))
    (3, 3)
    """
    total = gains.sum()
    if not total > 0:
        return len(gains)
    above = np.cumsum(gains) / total - np.arange(1, len(gains) + 1) / len(gains)
    if above.max() > _LEAST_CURVE_BEND:
        return int(np.argmax(above)) + 1
    return len(gains)
