"""Overdraw in near views, as a headset draws them when its wearer steps closer."""

from __future__ import annotations

from g2ard.errors import InputError
from g2ard.poses import plan_pool
from g2ard.rendering.visibility import overdraw
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

_NEAR_VIEWS = 6
"""Number of near views."""

_NEAR_POOL = 16
"""Poses that near views step from."""

_NEAR_SIZE = (320, 240)
"""Pixels of near views."""

_NEAR_ROWS = 50_000
"""Gaussians that near views are planned by."""


def close_up(splats: Splats) -> dict[str, float] | None:
    """Return the mean Gaussians per pixel with α ≥ 1/255 over six near views, and in the worst; None for a
    scene without a place for them.

    Near views stand where what they look at has a standard deviation of about 1.5 pixels, at a quarter to six
    tenths of the distance of usual ones. A headset draws such views when its wearer steps closer.
    """
    try:
        near = plan_pool(splats, _NEAR_POOL, size=_NEAR_SIZE, rows=_NEAR_ROWS).more(
            "near", _NEAR_VIEWS
        )
    except InputError:
        return None
    found = [overdraw(splats, Cameras.of([view])) for view in near]
    return {"mean": sum(found) / len(found), "worst": max(found)} if found else None
