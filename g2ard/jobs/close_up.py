"""Overdraw of near views: the Gaussians blended per pixel close to a scene's surfaces."""

from dataclasses import dataclass

from g2ard.errors import InputError
from g2ard.io.reports import Report
from g2ard.poses import plan_pool
from g2ard.rendering.visibility import overdraw
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

_VIEWS, _POOL, _SIZE, _ROWS = 6, 16, (320, 240), 50_000
"""Near views, poses that they step from, their pixels, and the Gaussians they are planned by."""


@dataclass(frozen=True)
class CloseUp(Report):
    """Mean Gaussians per pixel with α ≥ 1/255 in near views: over all of them, and in the worst."""

    mean: float
    worst: float


def close_up(splats: Splats) -> CloseUp | None:
    """Measure the overdraw in six near views, or return None for a scene without a place for them.

    Near views stand where what they look at has a standard deviation of about 1.5 pixels, at a quarter to six
    tenths of the distance of usual ones. A headset draws such views when its wearer steps closer.
    """
    try:
        near = plan_pool(splats, _POOL, size=_SIZE, rows=_ROWS).more("near", _VIEWS)
    except InputError:
        return None
    found = [overdraw(splats, Cameras.of([view])) for view in near]
    return CloseUp(sum(found) / len(found), max(found)) if found else None
