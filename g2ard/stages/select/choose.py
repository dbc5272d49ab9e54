"""Which views are worth having: an order of the candidates, what each adds, and how often to draw it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import POLICIES, UNMEASURED
from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Cameras, unseeing
from g2ard.scene.splats import Splats
from g2ard.stages.select import poses
from g2ard.stages.select.surfaces import CoverageOptions, greedy, surface

__all__ = ["POLICIES", "Selection", "select"]

Float = NDArray[np.float64]
Order = NDArray[np.int64]

_BEND = 0.02
"""A curve that nowhere rises this far above its chord is straight: no K is better than another."""
_LARGEST = 32_768
"""Pixels a side; what a raster takes."""
_COARSE = 20_000
"""Cells that stand for the scene where only distances to it matter."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen views, best first.

    Args:
        policy: how they were chosen.
        order: (K,) indices into the candidates.
        gains: (K,) what each added to the policy's objective when it was chosen, as a share of what the whole
            pool reaches.
        weights: (K,) how often to draw each, mean 1: the share of the pool that it stands for, with crowded
            poses counted less.
        left_out: what the candidates not chosen would have added, as a share of the whole.
        curve: (n,) what the first 1, 2, … n views of the order reach together, over all usable candidates, as
            a share of the whole: K can be read off it.
        refused: indices of candidates that see nothing of the scene, or that stand within it.
        evaluations: how often a view's gain was computed; 0 where a policy computes none.
        seconds: by stage.
    """

    policy: str
    order: Order
    gains: Float
    weights: Float
    left_out: float
    curve: Float
    refused: Order
    evaluations: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


def select(
    splats: Splats,
    cameras: Cameras,
    k: int | Literal["auto"],
    *,
    policy: str = "auto",
    seed: int = 0,
    options: CoverageOptions | None = None,
    progress: Progress = silent,
) -> Selection:
    """Choose `k` of the candidate views.

    Args:
        splats: the raw prior; what the views see of it counts, not what they show.
        cameras: C candidates, in world coordinates.
        k: how many; C or more takes them all, in order of worth. "auto" stops where the curve of gains
            flattens, at the K farthest above the straight line from none to all; all, if it never bends.
        policy: one of `POLICIES`. auto works on poses: first the farthest next, until all are within reach,
            then those that best represent all candidates, crowded ones counted less, by facility location
            Σ_u w_u max_{v∈S} exp(−(d_uv/0.35)²). directional is the paper's; coverage counts cells seen at
            all; pose-diverse takes the farthest pose next; random and uniform (evenly along the candidates'
            order) look at nothing.
        seed: of random.
        options: of directional and coverage.
        progress: told of the views rasterised.

    Returns:
        A `Selection`.

    Raises:
        InputError: `k` is not positive, an unknown policy, no candidates, or none that sees the scene.

    >>> from g2ard.scene.cameras import look_at
    >>> ball = Splats.create(np.random.default_rng(0).normal(size=(500, 3)), scales=np.full((500, 3), 0.1))
    >>> around = [look_at([4 * np.cos(a), 4 * np.sin(a), 0], [0, 0, 0]) for a in (0.0, 0.1, 0.2, 3.1)]
    >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
    >>> views = Cameras.from_lists(around, [K] * 4, [(64, 64)] * 4, list("abcd"))
    >>> select(ball, views, 2).order.tolist()
    [1, 3]
    """
    if policy not in POLICIES:
        raise InputError(f"expected {', '.join(POLICIES)}, got {policy!r}", parameter="policy")
    if k == "auto" and policy in UNMEASURED:
        raise InputError(f"'auto' needs a policy that measures what views add, not {policy!r}", parameter="k")
    if k != "auto" and not isinstance(k, int | np.integer):
        raise InputError(f"expected 'auto' or a whole number of views, got {k!r}", parameter="k")
    large = np.maximum(cameras.widths, cameras.heights) > _LARGEST
    if large.any():
        i = int(np.argmax(large))
        size = f"{cameras.widths[i]}×{cameras.heights[i]}"
        raise InputError(f"view {cameras.names[i]}: {size} pixels; at most {_LARGEST} a side")
    if k != "auto" and k < 1:
        raise InputError(f"expected at least 1 view, got {k}", parameter="k")
    if not len(cameras):
        raise InputError("no candidate views to select from")
    began = time.perf_counter()
    seconds: dict[str, float] = {}
    coarse = surface(splats, min(_COARSE, max(1, len(splats))))
    depths, shares = poses.outlooks(coarse, cameras)
    alike = poses.pose_kernel(cameras, depths)
    pose_weights = poses.inverse_density(alike)
    usable = (depths > 0) & ~poses.inside_geometry(splats, cameras, depths, progress)
    if not usable.any():
        raise InputError(unseeing(cameras, "the scene"))
    seconds["poses"] = time.perf_counter() - began
    evaluations, refused = 0, ~usable
    if policy in ("directional", "coverage"):
        rows = np.flatnonzero(usable)
        order, gains, evaluations = greedy(splats, cameras.take(rows), policy, options, progress, seconds)
        order = rows[order]
        refused = ~np.isin(np.arange(len(cameras)), order)  # also what sees no cell: greedy leaves it out
    elif policy == "pose-diverse":
        order, gains = poses.farthest(alike, usable)
    elif policy == "auto":
        order, gains = poses.facility_location(alike, pose_weights, usable, shares)
    else:
        order = _blind(policy, np.flatnonzero(usable), k, seed)
        gains = poses.gains_of(order, alike, pose_weights)
    if not len(order):
        raise InputError(unseeing(cameras, "a cell of the surface"))
    count = _knee(gains) if k == "auto" else min(k, len(order))
    share = gains / total if (total := gains.sum()) > 0 else np.full(len(gains), 1 / len(gains))
    seconds["total"] = time.perf_counter() - began
    return Selection(
        policy=policy,
        order=order[:count],
        gains=share[:count],
        weights=poses.draw_weights(order[:count], alike, pose_weights),
        left_out=float(share[count:].sum()),
        curve=np.cumsum(share),
        refused=np.flatnonzero(refused),
        evaluations=evaluations,
        seconds=seconds,
    )


def _blind(policy: str, rows: Order, k: int | Literal["auto"], seed: int) -> Order:
    if policy == "random":
        return np.random.default_rng([seed, 7]).permutation(rows)
    count = len(rows) if k == "auto" else min(k, len(rows))
    chosen = np.floor((np.arange(count) + 0.5) * len(rows) / max(count, 1)).astype(np.int64)
    return np.concatenate([rows[chosen], np.delete(rows, chosen)])


def _knee(gains: Float) -> int:
    """The count at which the curve of summed gains lies farthest above its chord; all if it never bends.

    >>> _knee(np.array([5.0, 4.0, 3.0, 0.1, 0.1, 0.1, 0.1])), _knee(np.array([1.0, 1.0, 1.0]))
    (3, 3)
    """
    total = gains.sum()
    if not total > 0:
        return len(gains)
    above = np.cumsum(gains) / total - np.arange(1, len(gains) + 1) / len(gains)
    return int(np.argmax(above)) + 1 if above.max() > _BEND else len(gains)
