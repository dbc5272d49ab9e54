"""Kind of a scene, by which planners are chosen."""

from __future__ import annotations

import numpy as np

from g2ard.poses.lattice import halton
from g2ard.poses.site import Site
from g2ard.poses.walk import enclosed

_TRIES = 400
"""Places tried."""

_ROOM = (0.5, 0.75)
"""Share of the box that is free and enclosed, above which a scene is a room: with a ground, and without one,
where a hollow object also encloses much."""

_ENCLOSED = 0.8
"""Share of the directions below and around a place that meet matter, above which it is enclosed."""

_FLAT = 0.25
"""Height over width below which a scene with a ground is a landscape."""


def shape_of(site: Site) -> tuple[str, str]:
    """Classify a site as "object", "room" or "landscape", and return the reason.

    A room has free space that matter surrounds, and a landscape is much wider than high. Anything else is an
    object, with or without a piece of ground.
    """
    inside = _surrounded(site)
    if inside > _ROOM[site.terrain is None]:
        return "room", f"{inside:.0%} of its box is free and enclosed"
    sides = site.box[1] - site.box[0]
    flat = float(sides[2] / max(np.sqrt(sides[0] * sides[1]), np.finfo(float).tiny))
    if site.terrain is not None and flat < _FLAT:
        return "landscape", f"{flat:.2g} times as high as wide"
    return "object", f"{flat:.2g} times as high as wide, open around"


def _surrounded(site: Site) -> float:
    """Return the share of the scene's box that is free and enclosed from below and around."""
    points = site.box[0] + (site.box[1] - site.box[0]) * halton(0, _TRIES, 3, seed=0)
    free = site.grid.distance(points) > site.grid.cell
    if not free.any():
        return 0.0
    return float((enclosed(site, points[free]) > _ENCLOSED).sum() / _TRIES)
