"""Poses at any distance from any of a scene's matter, as people move about it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.lattice import halton
from g2ard.poses.numbers import norms
from g2ard.poses.sharp import Glance
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site

Floats = NDArray[np.float64]

_DISTANCES = (0.04, 0.4)
"""Range of distances from the aim, in diagonals of the scene's box; drawn log-uniformly."""

_RISES = (-5.0, 35.0)
"""Degrees from the aim up to the eye."""

_CLOSE = 0.5 * _DISTANCES[0]
"""Share of the diagonal within which matter is close: half of the least distance of an aim."""

_MURK, _CLEAR = 0.08, 0.35
"""Largest share of the image that shows close matter, and least transmittance in front of the aim."""

_BATCH, _PATIENCE = 256, 64
"""Poses proposed at once, and proposed per requested pose at most."""


def plan_anywhere(
    site: Site, glance: Glance, count: int, lens: Lens, seed: int, tell: Callable[[int, int], None]
) -> Poses:
    """Return at most `count` poses with a clear line of sight to what they aim at, and nothing close.

    Aims are spread evenly over the scene's Gaussians, distances from 4 to 40 % of its diagonal. Rays in the
    grid reject most poses, and small renders the rest, because the grid knows neither floaters nor fog.
    """
    diagonal = float(norms(site.box[1:] - site.box[:1])[0])
    points = (glance.points - site.origin) @ site.axes.T / site.size
    within = ((points > site.box[0]) & (points < site.box[1])).all(axis=1)
    rows = np.flatnonzero(within & glance.solid)
    parts, found = [Poses(np.zeros((0, 3)), np.zeros((0, 3)))], 0
    for start in range(0, _PATIENCE * count if len(rows) else 0, _BATCH):
        which, far, around, rise = halton(start, start + _BATCH, 4, seed + 5).T
        aims = rows[(which * len(rows)).astype(int)]
        gazes = -_outward(2 * np.pi * around, np.radians(_RISES[0] + (_RISES[1] - _RISES[0]) * rise))
        distances = diagonal * _DISTANCES[0] * (_DISTANCES[1] / _DISTANCES[0]) ** far
        poses = Poses(points[aims] - distances[:, None] * gazes, gazes)
        free = site.grid.cast(poses.eyes, gazes) > distances - 2 * site.grid.cell
        if not free.any():
            continue
        poses, aims = poses.take(free), aims[free]
        murk, clear = glance.sight(poses.cameras(site, lens), aims, _CLOSE * diagonal * site.size)
        parts.append(poses.take((murk <= _MURK) & (clear >= _CLEAR)))
        found += len(parts[-1])
        tell(min(found, count), count)
        if found >= count:
            break
    return Poses.joined(parts).take(slice(count))


def _outward(turn: Floats, rise: Floats) -> Floats:
    """Return (P, 3) unit vectors at these angles around the vertical and above the horizon."""
    return np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)
