"""Zooms: windows of views at twice their size, where the views show Gaussians too small to determine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from g2ard.arrays import Float, Int
from g2ard.scene.cameras import ZOOM, Camera, Cameras
from g2ard.scene.reproducible import along, halton
from g2ard.scene.samples import spread, take_evenly
from g2ard.scene.splats import Splats

_TIMES = 2.0
"""Size of the view that a zoom is a window of, relative to the view."""
_FINEST = 2.0
"""Pixels: seen from twice as far, a Gaussian of a smaller standard deviation is below the sampling limit."""
_MOST = 1 / 3
"""Largest share of the views that become zooms."""
_SAMPLE = 8192
"""Gaussians that represent the scene."""

_SOLID = 0.3
"""Least opacity of those that count."""


def zoomed(
    scene: Splats,
    cameras: Cameras,
    *,
    represents: float = 1.0,
    share: float = 1.0,
) -> Cameras:
    """Turn some of the views into zooms: half the share of the Gaussians in sight that they show small.

    A zoom has as many pixels as its view, shows a window of the view at twice its size, and holds a Gaussian
    that the view shows with a standard deviation below two pixels, chosen at random. Views with photos stay.

    Args:
        scene: the compact scene.
        represents: Gaussians to be trained per row of `scene`.
        share: factor on the number of zooms.

    Returns:
        The views, in the same order; zooms are of the kind "zoom".
    """
    some = take_evenly(scene, _SAMPLE)
    some = some.take(some.opacities > _SOLID)
    points = some.positions
    scales = np.sort(some.scales.astype(np.float64), axis=1)
    sizes = np.sqrt(scales[:, 1] * scales[:, 2] / represents)
    small: list[Int] = []  # per view, the rows in sight below `_FINEST` pixels
    seen = 0
    for view in cameras:
        rows = np.flatnonzero(view.holds(points))
        depths = along(points[rows], view.viewmat[2, :3]) + view.viewmat[2, 3]
        focal = np.sqrt(view.K[0, 0] * view.K[1, 1])
        is_small = sizes[rows] * focal < _FINEST * depths
        small.append(rows[is_small])
        seen += len(rows)
    small_share = sum(map(len, small)) / (2 * max(1, seen))
    wanted = round(share * min(_MOST, small_share) * len(cameras))
    free = [i for i in spread(len(cameras)) if len(small[i]) and cameras.image_paths[i] is None]
    chances = halton(0, len(cameras), 3, 0)
    views = list(cameras)
    for i in free[:wanted]:
        chance, *at = chances[i]
        row = small[i][int(chance * len(small[i]))]
        views[i] = _place_window(
            views[i],
            points[row],
            np.array(at),
        )
    return Cameras.of(views)


def _place_window(view: Camera, point: Float, at: Float) -> Camera:
    """Return the window of a view that has a point at this share of its width and height, within the view."""
    size = np.array([view.width, view.height], np.float64)
    x, y, z = view.K @ (view.viewmat[:3, :3] @ point + view.viewmat[:3, 3])
    pixel = _TIMES * np.array([x, y]) / z
    last_corner = (_TIMES - 1) * size
    corner = np.clip(pixel - at * size, 0, last_corner)
    K = view.K.copy()
    K[:2] *= _TIMES
    K[:2, 2] -= corner
    return replace(
        view,
        K=K,
        name=f"{view.name}_zoom",
        kind=ZOOM,
    )
