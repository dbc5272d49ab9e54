"""Poses on a dome around an object, each as near as the object fits the frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.gather import gather
from g2ard.poses.lattice import halton
from g2ard.poses.numbers import quantile, turned
from g2ard.poses.sight import Lens, Poses, view_statistics
from g2ard.poses.site import Site

Floats = NDArray[np.float64]

_ELEVATIONS = (-5.0, 50.0)
"""Range of elevations, in degrees above the horizon of the object's centre."""

_DISTANCES = (0.9, 1.25)
"""Range of distances, as multiples of the distance at which the object just fits."""

_FITTING = 0.97
"""Share of the matter in frame when the object just fits."""

_OUTSIDE = 1.2
"""Least distance from the centre: everything lies within about 1 of it."""

_ABOVE, _CLEAR_CELLS = 0.02, 4
"""Least height of a pose above the ground, in scene sizes, and least number of free cells in front of it."""

_OUTLINE = 8_000
"""Points that represent the object's outline."""


def plan_orbit(
    site: Site,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
    *,
    first: int | None = None,
) -> Poses:
    """Plan at most `count` poses around the centre of the matter, spread evenly over the dome.

    Poses below the ground, in matter or close to it are dropped. The others see the object, because it fills
    their frame. `first` is a second limit on the number of poses.
    """
    target = site.box.mean(axis=0)
    low, high = np.sin(np.radians(_ELEVATIONS))

    def propose(start: int, stop: int) -> Poses:
        across, rise, chance = halton(start, stop, 3, seed).T
        z = low + (high - low) * rise
        flat, turn = np.sqrt(1 - z * z), 2 * np.pi * across
        outward = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
        distances = _fitting(site, target, outward, lens)
        distances *= _DISTANCES[0] + (_DISTANCES[1] - _DISTANCES[0]) * chance
        return Poses(target + distances[:, None] * outward, -outward)

    def judge(poses: Poses) -> Floats:
        free = (site.grid.distance(poses.eyes) > 2 * site.grid.cell) & (
            site.above_ground(poses.eyes) > _ABOVE
        )
        return (view_statistics(site, poses, lens, free).close > _CLEAR_CELLS * site.grid.cell).astype(float)

    return gather(count if first is None else min(first, count), propose, judge, tell)


def _fitting(site: Site, target: Floats, outward: Floats, lens: Lens) -> Floats:
    """Return (P,) distances at which `_FITTING` of the matter is in frame, and all of it ahead."""
    points, weights = site.points[:_OUTLINE] - target, site.weights[:_OUTLINE]
    wide, tall = lens.tangents
    distances = np.empty(len(outward))
    for i, frame in enumerate(Poses(outward, -outward).frames()):
        x, y, z = turned(points, frame).T
        distances[i] = quantile(np.maximum(np.abs(x) / wide, np.abs(y) / tall) - z, weights, _FITTING)
    return np.maximum(distances, _OUTSIDE)
