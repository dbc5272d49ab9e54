"""Poses over a wide scene: a grid looking straight down, and oblique views from all sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.gather import gather
from g2ard.poses.lattice import halton
from g2ard.poses.sight import Lens, Poses, view_statistics
from g2ard.poses.site import Site

Floats = NDArray[np.float64]

_NADIR = 0.4
"""Share of the poses that look straight down."""

_PITCHES = (30.0, 65.0)
"""Range of pitches of the other poses, in degrees below the horizon."""

_OVERLAP = 5.0
"""Nadir images that show the same spot of ground, as in drone surveys."""

_INSET = 0.1
"""Margin that no pose aims at, as a share of the scene's sides: frames there would show the outside."""

_LOWEST, _SPREAD = 0.85, 0.3
"""Smallest factor on the height of a pose, and the range above it, so that poses see at several scales."""

_CLEAR = 0.3
"""Share of the height that must be free in front of a pose."""

_COVERED = 0.75
"""Share of the frame that is covered in a pose with the full score."""

_ABOVE = 1.3
"""Least height of the poses, as a multiple of the height of what stands on the ground."""


def plan_aerial(
    site: Site,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
    *,
    first: int | None = None,
) -> Poses:
    """Plan at most `count` poses above everything, their footprints spread evenly over the scene.

    The height follows from `count`: few poses see much each, many see detail. Poses in matter or close to it
    are dropped, and poses with at least three quarters of the frame covered are preferred. `first` limits the
    number of poses without changing their height.
    """
    height = _height(site, count, lens)

    def propose(start: int, stop: int) -> Poses:
        x, y, kind, turn, pitch, chance = halton(start, stop, 6, seed).T
        inset = _INSET * (site.box[1] - site.box[0])
        spots = site.box[0] + inset + (site.box[1] - site.box[0] - 2 * inset) * np.stack([x, y, x], axis=1)
        spots[:, 2] = site.ground(spots)
        down = np.radians(_PITCHES[0] + (_PITCHES[1] - _PITCHES[0]) * pitch)
        down = np.where(kind < _NADIR, np.pi / 2, down)
        around = 2 * np.pi * turn
        level = np.where(kind < _NADIR, 0.0, np.cos(down))
        gazes = np.stack([level * np.cos(around), level * np.sin(around), -np.sin(down)], axis=1)
        away = height * (_LOWEST + _SPREAD * chance) / np.sqrt(np.sin(down))
        return Poses(spots - away[:, None] * gazes, gazes)

    def judge(poses: Poses) -> Floats:
        free = (site.grid.distance(poses.eyes) > 3 * site.grid.cell) & (site.above_ground(poses.eyes) > 0)
        seen = view_statistics(site, poses, lens, free)
        return np.where(seen.close > _CLEAR * height, seen.covered / _COVERED, 0.0)

    return gather(count if first is None else min(first, count), propose, judge, tell)


def _height(site: Site, count: int, lens: Lens) -> Floats | float:
    """Return the height above the ground at which each spot lies in `_OVERLAP` nadir frames.

    It is at most the height from which one frame spans the scene, and always above what stands on the ground.
    """
    sides = (site.box[1] - site.box[0])[:2]
    wide, tall = lens.tangents
    by_count = np.sqrt(_OVERLAP * sides[0] * sides[1] / (max(1.0, _NADIR * count) * 4 * wide * tall))
    fits = min(sides) / (2 * min(wide, tall))
    return max(min(by_count, fits), _ABOVE * site.tallness)
