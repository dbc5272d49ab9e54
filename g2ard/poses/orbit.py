"""Poses on a dome around a thing, each as near as the thing fits the frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.lattice import fibonacci, halton
from g2ard.poses.matter import quantile
from g2ard.poses.sight import Lens, Poses, look
from g2ard.poses.site import Site

__all__ = ["ELEVATIONS", "plan_orbit"]

Floats = NDArray[np.float64]

ELEVATIONS = (-5.0, 50.0)
"""Degrees above the horizon of the thing's middle."""

_DISTANCES = (0.9, 1.25)
"""Each pose's own share of the distance at which the thing just fits."""


def plan_orbit(site: Site, count: int, lens: Lens, seed: int) -> Poses:
    """Up to `count` poses around the middle of the matter, evenly over the dome.

    Poses below the ground, in or close to matter, or that see much less than the others do are left out;
    the dome is asked for more until enough are left.
    """
    low, high = np.sin(np.radians(ELEVATIONS))
    target = _target(site)
    asked = count
    for _ in range(6):
        turn, *_ = np.random.default_rng(seed).random(1)
        outward = fibonacci(asked, turn, low, high)
        poses = _fitting(site, target, outward, halton(asked, 1, seed)[:, 0], lens)
        good = np.flatnonzero(_allowed(site, poses, lens))
        if len(good) >= count:
            break
        asked = int(np.ceil(1.1 * asked * min(4.0, count / max(len(good), 1)))) + 1
    spread = np.floor((np.arange(min(count, len(good))) + 0.5) * len(good) / min(count, max(len(good), 1)))
    return poses.take(good[spread.astype(int)])


def _target(site: Site) -> Floats:
    """The middle of the extents; over a ground, of what lies around the middle of the mass."""
    return site.box.mean(axis=0)


def _fitting(site: Site, target: Floats, outward: Floats, chance: Floats, lens: Lens) -> Poses:
    """Eyes so far out that 97 % of the matter is in frame, times a share between `_DISTANCES`."""
    points, weights = site.points[:20_000] - target, site.weights[:20_000]
    frames = Poses(outward, -outward).frames()
    wide, tall = lens.tangents
    distances = np.empty(len(outward))
    for i, (right, down, ahead) in enumerate(frames):
        x, y, z = (
            points[:, 0] * a[0] + points[:, 1] * a[1] + points[:, 2] * a[2] for a in (right, down, ahead)
        )
        needed = np.maximum(np.abs(x) / wide, np.abs(y) / tall) - z
        distances[i] = quantile(needed, weights, 0.97)
    distances *= _DISTANCES[0] + (_DISTANCES[1] - _DISTANCES[0]) * chance
    return Poses(target + distances[:, None] * outward, -outward)


def _allowed(site: Site, poses: Poses, lens: Lens) -> NDArray[np.bool_]:
    clear = site.grid.distance(poses.eyes) > 2 * site.grid.cell
    above = site.above_ground(poses.eyes) > 0.02
    good = clear & above
    if good.any():
        rows = np.flatnonzero(good)
        seen = look(site, poses.take(rows), lens)
        good[rows] = (seen.covered > 0.4 * np.median(seen.covered)) & (seen.close > 4 * site.grid.cell)
    return good
