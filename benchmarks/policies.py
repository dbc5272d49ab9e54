"""Policies of view selection for studies: those of g2ard, and others that do not pay (decision 0014)."""

import numpy as np
from numpy.typing import NDArray

from g2ard.arrays import Int
from g2ard.config import choices
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.select import CoverageOptions, select, surface, visible_cells
from g2ard.stages.select.poses import Candidates, bandwidths_apart, measure_candidates

__all__ = ["POLICIES", "order_views"]

POLICIES = ("random", "pose-diverse", "coverage", *choices.POLICIES)
"""random: any order. pose-diverse: the farthest pose next. coverage: directional without directions."""


def order_views(
    splats: Splats,
    cameras: Cameras,
    policy: str,
    *,
    seed: int = 0,
    options: CoverageOptions | None = None,
) -> Int:
    """Return the views that a policy may choose, best first.

    Args:
        policy: one of `POLICIES`.
        seed: seed of random.
        options: options of directional and coverage.
    """
    if policy in choices.POLICIES:
        return select(splats, cameras, len(cameras), policy=policy, options=options).order
    candidates = measure_candidates(splats, cameras)
    usable = np.flatnonzero(candidates.usable)
    if policy == "random":
        return np.random.default_rng([seed, 7]).permutation(usable)
    if policy == "pose-diverse":
        return _farthest(candidates)
    return usable[_covering(splats, cameras.take(usable), options or CoverageOptions())]


def _farthest(candidates: Candidates) -> Int:
    """Order by farthest pose, starting at the most central."""
    usable = candidates.usable
    away = bandwidths_apart(candidates.alike)
    view = int(np.argmax(np.where(usable, candidates.alike[:, usable].sum(1), -1.0)))
    nearest = np.where(usable, np.inf, -1.0)  # -1 marks what cannot be chosen
    order = []
    for _ in range(int(usable.sum())):
        order.append(view)
        nearest = np.where(nearest >= 0, np.minimum(nearest, away[view]), -1.0)
        nearest[view] = -1.0
        view = int(np.argmax(nearest))
    return np.array(order, np.int64)


def _covering(splats: Splats, cameras: Cameras, options: CoverageOptions) -> Int:
    """Return the views that see a cell, in greedy order of the fair utilities of the cells that they see."""
    cells = surface(splats, options.cells)
    starts, seen = visible_cells(splats, cells, cameras, depth_tolerance=options.depth_tolerance)
    views = np.split(seen, starts[1:-1].astype(np.int64))
    left = [view for view, own in enumerate(views) if len(own)]
    times_seen = np.zeros(len(cells.centers))
    order = []
    while left:
        gains = cells.weights * (_utility(times_seen + 1, options) - _utility(times_seen, options))
        best = max(left, key=lambda view: gains[views[view]].sum())
        left.remove(best)
        order.append(best)
        times_seen[views[best]] += 1
    return np.array(order, np.int64)


def _utility(times: NDArray[np.float64], options: CoverageOptions) -> NDArray[np.float64]:
    """Return u(offset + times), see `CoverageOptions`."""
    x = options.offset + times / (1 + options.epsilon)
    return np.log(x) if options.alpha == 1 else x ** (1 - options.alpha) / (1 - options.alpha)
