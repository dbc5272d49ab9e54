"""Poses over a wide scene: a grid looking straight down, and obliques from all sides."""

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
"""Degrees below the horizon of the others."""

_OVERLAP = 5.0
"""Nadir images that show the same spot of ground, as drone surveys fly it."""

_INSET = 0.1
"""Share of the scene's sides along its edges that no pose aims at: frames there would show what is out."""

_LOWEST, _SPREAD = 0.85, 0.3
"""Each pose's own share of the height, from the lowest on, so that not all see at one scale."""

_CLEAR = 0.3
"""Share of the height over the ground that is free in front of a pose."""

_COVERED = 0.75
"""Share of the frame that is filled in poses that are as good as any."""

_ABOVE = 1.3
"""Poses stand at least so many times as high as what stands on the ground."""


def plan_aerial(
    site: Site,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
    *,
    first: int | None = None,
) -> Poses:
    """At most `count` poses above everything, their footprints spread evenly over the scene.

    The height follows from the count: few poses see much each, many see detail. Poses in or close to
    matter, or with a quarter of their frame empty, are left out. `first` asks for so many of them only.
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
    """Over the ground: each spot in `_OVERLAP` nadir frames, above all that stands, below what fits all."""
    sides = (site.box[1] - site.box[0])[:2]
    wide, tall = lens.tangents
    by_count = np.sqrt(_OVERLAP * sides[0] * sides[1] / (max(1.0, _NADIR * count) * 4 * wide * tall))
    fits = min(sides) / (2 * min(wide, tall))
    return max(min(by_count, fits), _ABOVE * site.tallness)
