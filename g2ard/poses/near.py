"""Poses nearer to what other poses see, and a measure of how much of a scene a pool shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.lattice import halton
from g2ard.poses.numbers import norms
from g2ard.poses.sight import Lens, Poses, clearance
from g2ard.poses.site import Site

Floats = NDArray[np.float64]

_POINTS = 512
"""Sample points that represent the scene's matter."""

_PIXELS = 1.5
"""Standard deviation, in pixels, at which a near pose shows its target."""

_JITTER = 0.2
"""Scale of the random offset between a gaze and its target, as a tangent, so that not every image has the
target in the middle."""

_ABOVE = 0.01
"""Least height of a pose above the ground, in scene sizes."""

_STEP = (0.25, 0.6)
"""Least and most of the original distance to the target that remains."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Visibility of a sample of a scene's points.

    Args:
        points: (K, 3) in the site's coordinates.
        scales: (K,) typical standard deviation of the Gaussians there.
        best: (K,) index of the nearest pose that sees a point; −1 if no pose does.
        distance: (K,) distance from that pose; inf if no pose sees the point.
    """

    points: Floats
    scales: Floats
    best: NDArray[np.int64]
    distance: Floats

    def unseen(self) -> float:
        """Return the share of the points that no pose sees."""
        return float((self.best < 0).mean())

    def coarse(self, lens: Lens) -> NDArray[np.bool_]:
        """Return (K,) whether points are seen, but with a standard deviation below a pixel."""
        return (self.best >= 0) & (self.scales * float(lens.matrix[0, 0]) < self.distance)


def reach_of(site: Site, poses: Poses, lens: Lens) -> Reach:
    """Cast a ray from every pose to each sample point within its frame."""
    points = site.points[:_POINTS]
    best, nearest = np.full(len(points), -1), np.full(len(points), np.inf)
    wide, tall = lens.tangents
    for i, frame in enumerate(poses.frames()):
        away = points - poses.eyes[i]
        x, y, z = (away @ frame.T).T
        length = norms(away)
        rows = np.flatnonzero((z > 0) & (np.abs(x) < wide * z) & (np.abs(y) < tall * z) & (length < nearest))
        if not len(rows):
            continue
        directions = away[rows] / length[rows, None]
        met = site.grid.cast(np.repeat(poses.eyes[i : i + 1], len(rows), axis=0), directions)
        rows = rows[met > length[rows] - 2 * site.grid.cell]
        best[rows], nearest[rows] = i, length[rows]
    return Reach(points, site.grid.scale_at(points), best, nearest)


def plan_near(site: Site, poses: Poses, reach: Reach, count: int, lens: Lens, seed: int) -> Poses:
    """Plan at most `count` poses between the given ones and points that they see.

    Each pose stands where its point has a standard deviation of 1.5 pixels, at 0.25–0.6 of the original
    distance. Up to half of the poses look at points that the given poses show smaller than a pixel.
    """
    if not count:
        return poses.take(slice(0))
    chance = np.random.default_rng(seed)
    small = chance.permutation(np.flatnonzero(reach.coarse(lens)))[: count // 2]
    rows = np.concatenate([small, np.setdiff1d(np.flatnonzero(reach.best >= 0), small)])
    rows[len(small) :] = chance.permutation(rows[len(small) :])
    if not len(rows):
        return poses.take(slice(0))
    turn, rise = halton(0, len(rows), 2, seed + 3).T
    eyes, points = poses.eyes[reach.best[rows]], reach.points[rows]
    wanted = reach.scales[rows] * float(lens.matrix[0, 0]) / _PIXELS
    share = np.clip(wanted / reach.distance[rows], *_STEP)
    eyes = points + share[:, None] * (eyes - points)
    gazes = (points - eyes) / np.maximum(norms(points - eyes), np.finfo(float).tiny)[:, None]
    gazes += _JITTER * np.stack([turn - 0.5, rise - 0.5, turn - rise], axis=1)
    gazes /= norms(gazes)[:, None]
    free = (site.grid.distance(eyes) > 2 * site.grid.cell) & (site.above_ground(eyes) > _ABOVE)
    near = Poses(eyes[free], gazes[free])
    clear = clearance(site, near, lens) > 2 * site.grid.cell
    return near.take(clear).take(slice(count))
