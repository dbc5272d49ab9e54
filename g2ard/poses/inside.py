"""Poses within rooms and other enclosed places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.gather import gather
from g2ard.poses.lattice import fibonacci, halton
from g2ard.poses.sight import Lens, Poses, view_statistics
from g2ard.poses.site import Site

Floats = NDArray[np.float64]

_TRIES = 4096
"""Places tried."""

_DIRECTIONS = 64
"""Rays cast from a place to measure how much of the sphere around it is matter."""

_ENCLOSED = 0.7
"""Least share of the sphere around a place within a room that is matter; a path under open sky has half. With
0.55 or 0.35, the showroom loses .2 and .4 dB, because some places at the edges of rooms lie behind walls."""

_SHARP = 0.05
"""Radians: within a room, three quarters of the matter seen has a smaller standard deviation. Measured
.013–.026; in the hollow of an object .13 and more."""

_SOME_INSIDE, _ALL_INSIDE = 0.005, 0.025
"""Share of the box that lies within rooms: below the first no pose stands inside, from the second on all do.
Measured: showroom .026–.079, objects and open scenes 0.000."""

_MOSTLY = 0.75
"""Share of the matter seen that must have a standard deviation below `_SHARP`."""

_COVERED, _CLEAR_CELLS = 0.8, 4
"""Share of the frame that is matter, and free cells in front, at which a gaze gets the full score."""

_SHELL = 0.5
"""Largest share of a pool that stands within a scene without ground."""

_PITCHES = (-0.3, 0.2)
"""Range of gaze pitches, in radians above the horizon."""

_WIDE = 0.25
"""Share of the places, those with most clearance, for half of the poses; the others stand anywhere."""


@dataclass(frozen=True, eq=False)
class Inside:
    """Places within the rooms of a scene.

    Args:
        places: (K, 3) places, those with most clearance first.
        share: share of the scene's box that lies within rooms.
        grounded: whether the scene has a ground.
    """

    places: Floats
    share: float
    grounded: bool

    @property
    def weight(self) -> float:
        """Share of a pool that stands within: up to 1, or ½ without a ground (a shell may be an object)."""
        most = 1.0 if self.grounded else _SHELL
        return most * float(np.clip((self.share - _SOME_INSIDE) / (_ALL_INSIDE - _SOME_INSIDE), 0, 1))


def find_inside(site: Site, seed: int) -> Inside:
    """Find free places around which matter covers most of the sphere and is near enough to look sharp."""
    grid = site.grid
    points = site.box[0] + (site.box[1] - site.box[0]) * halton(0, _TRIES, 3, seed)
    clearance = grid.distance(points)
    free = clearance > 2 * grid.cell
    points, clearance = points[free], clearance[free]
    if not len(points):
        return Inside(points, 0.0, site.up.grounded)
    directions = fibonacci(_DIRECTIONS)
    eyes, rays = np.repeat(points, _DIRECTIONS, axis=0), np.tile(directions, (len(points), 1))
    distances = grid.cast(eyes, rays)
    hit = np.isfinite(distances)
    met = eyes[hit] + (distances[hit] + 0.5 * grid.cell)[:, None] * rays[hit]
    sharp = np.zeros(len(hit), bool)
    sharp[hit] = grid.scale_at(met) < _SHARP * distances[hit]
    around = hit.reshape(-1, _DIRECTIONS).mean(axis=1)
    sharply = sharp.reshape(-1, _DIRECTIONS).mean(axis=1) > _MOSTLY * around
    rows = np.flatnonzero((around > _ENCLOSED) & sharply)
    rows = rows[np.argsort(-clearance[rows], kind="stable")]
    return Inside(points[rows], len(rows) / _TRIES, site.up.grounded)


def plan_inside(
    site: Site, inside: Inside, count: int, lens: Lens, seed: int, tell: Callable[[int, int], None]
) -> Poses:
    """Plan at most `count` poses at the places found, gazing all around and near the horizon.

    Every second pose stands where there is most clearance. Gazes into a near wall, or out of the scene, are
    dropped.
    """
    places = inside.places
    if not len(places):
        return Poses(np.zeros((0, 3)), np.zeros((0, 3)))
    wide = max(1, int(_WIDE * len(places)))

    def propose(start: int, stop: int) -> Poses:
        at, turn, pitch = halton(start, stop, 3, seed + 1).T
        reach = np.where(np.arange(start, stop) % 2 == 0, wide, len(places))
        around = 2 * np.pi * turn
        rise = _PITCHES[0] + (_PITCHES[1] - _PITCHES[0]) * pitch
        gazes = np.stack([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)], axis=1)
        return Poses(places[(at * reach).astype(int)], gazes)

    def judge(poses: Poses) -> Floats:
        seen = view_statistics(site, poses, lens)
        return np.minimum(seen.covered / _COVERED, seen.close / (_CLEAR_CELLS * site.grid.cell))

    return gather(count, propose, judge, tell)
