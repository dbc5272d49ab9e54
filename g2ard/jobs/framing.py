"""Fields of view with which pages open, in windows of any shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from g2ard.arrays import Float, Mask
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.lenses import pinhole_matrix
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import Splats

Fields = tuple[tuple[float, float], ...]
"""Vertical fields of view in degrees for windows of rising aspects, see `g2ard.viewer.page.Start`."""

_EXTREMES = (0.1, 10.0)
"""Aspects (width / height) beyond those of all windows."""

_ASPECTS = (0.4, 0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5)
"""Aspects for which the surroundings of a photo are measured: from a phone upright to one on its side."""

_SUBJECT = 0.995
"""Share of the points in a view that its subject consists of, along each axis."""

_MARGIN = 1.1
"""Factor on the subject's width that leaves room around it."""

_SIDE = 200
"""Pixels along a side of the picture of a photo's surroundings."""

_PHOTO_SIDE = 64
"""Pixels along a side of the photos' depths."""

_ROWS = 200_000
"""Most Gaussians that are used."""

_PHOTOS = 64
"""Most photos that are used."""

_WITNESSES = 3
"""Photos that must see a surface for it to be known."""

_TOLERANCE = 0.1
"""Largest relative distance of a known surface from the depths of photos."""

_UNSEEN = 0.05
"""Share of a window that no photo need see."""

_FINEST = 0.05
"""Least share of the view that is shown."""

_STEPS = 60
"""Views tried between the whole view and the least share."""

_EMPTY = 0.05
"""Share of a photo without matter above which emptiness is what photos show."""


def choose_fields(
    view: Camera,
    *,
    subject: Float | None = None,
    scene: Splats | None = None,
    cameras: Cameras | None = None,
) -> Fields:
    """Return the fields of view with which a page opens at a view: all of it fits into the window.

    Args:
        subject: (N, 3) world points. The window holds most of those in the view, and no more.
        scene: what is shown, for `cameras`.
        cameras: views that scene was trained on, one of them `view`. Fields are narrowed until the window
            shows hardly anything that photos did not see.

    >>> view = Camera.facing([0, -1, 0], [0, 0, 0], width=40, height=30, fov=60)
    >>> [(round(aspect, 2), round(degrees)) for aspect, degrees in choose_fields(view)]
    [(0.1, 160), (1.33, 47), (10.0, 47)]
    """
    across, down = _measure_halves(view)
    if subject is not None:
        across, down = _measure_extent(view, subject)
    aspects = np.array(sorted({across / down, *(_EXTREMES if cameras is None else _ASPECTS)}))
    halves = np.maximum(down, across / aspects)
    if cameras is not None and scene is not None:
        halves = _narrow_windows(halves, aspects, view, scene, cameras)
    return tuple(zip(aspects.tolist(), np.degrees(2 * np.arctan(halves)).tolist(), strict=True))


def _measure_halves(view: Camera) -> tuple[float, float]:
    """Return half the width and height of a view at distance 1."""
    return float(view.width / view.K[0, 0] / 2), float(view.height / view.K[1, 1] / 2)


def _measure_extent(view: Camera, points: Float) -> tuple[float, float]:
    """Return half the width and height, at distance 1, around most of the points in a view."""
    held = points[view.holds(points)]
    if not len(held):
        return _measure_halves(view)
    x, y, z = view.viewmat[:3, :3] @ (held - view.position).T
    across, down = (
        max(_FINEST * most, _MARGIN * float(np.quantile(np.abs(along / z), _SUBJECT)))
        for along, most in zip((x, y), _measure_halves(view), strict=True)
    )
    return across, down


def _narrow_windows(
    halves: Float,
    aspects: Float,
    view: Camera,
    scene: Splats,
    cameras: Cameras,
) -> Float:
    """Return half heights of windows that show little else than what photos saw, at most the given ones."""
    reach = float((halves * np.maximum(1, aspects)).max())
    across, down, seen = _look_around(view, scene, cameras, reach)
    narrowed = halves.copy()
    for row, (half, aspect) in enumerate(zip(halves, aspects, strict=True)):
        for narrowed[row] in np.geomspace(half, _FINEST * half, _STEPS):
            window = (across <= aspect * narrowed[row]) & (down <= narrowed[row])
            if np.mean(seen[window]) >= 1 - _UNSEEN:
                break
    return narrowed


def _look_around(
    view: Camera, scene: Splats, cameras: Cameras, reach: float
) -> tuple[Float, Float, Mask]:
    """Look beyond a photo's edges.

    Returns:
        |x|, |y| at distance 1 and whether photos saw it, of each pixel of a square picture whose sides are
        2 · `reach` at distance 1.
    """
    focal = _SIDE / (2 * reach)
    middle = _SIDE / 2
    K = pinhole_matrix(focal, focal, middle, middle)
    renderer = Renderer(_thin_scene(scene))
    drawn = renderer.render(Camera(view.viewmat, K, _SIDE, _SIDE), median=True)
    assert drawn.median is not None
    y, x = (np.mgrid[:_SIDE, :_SIDE].reshape(2, -1) + 0.5 - middle) / focal
    depth = drawn.median.ravel().astype(np.float64)
    surface = np.stack([x * depth, y * depth, depth], axis=1) @ view.viewmat[:3, :3] + view.position
    witnesses = np.zeros(len(surface), np.int64)
    some = take_evenly(cameras, _PHOTOS).scaled(_PHOTO_SIDE)
    for photo in some:
        witnesses += _find_seen(renderer, photo, surface)
    own = (np.abs(x) <= _measure_halves(view)[0]) & (np.abs(y) <= _measure_halves(view)[1])
    empty = depth <= 0
    known = witnesses >= min(_WITNESSES, len(some))
    known[empty] = empty[own].mean() > _EMPTY
    return np.abs(x), np.abs(y), known | own


def _find_seen(renderer: Renderer, photo: Camera, points: Float) -> Mask:
    """Return which of the (N, 3) points are what a photo shows first."""
    depths = renderer.render(photo, median=True).median
    assert depths is not None
    seen = photo.holds(points)
    x, y, z = photo.viewmat[:3, :3] @ (points[seen] - photo.position).T
    column = (photo.K[0, 0] * x / z + photo.K[0, 2]).astype(int).clip(0, photo.width - 1)
    row = (photo.K[1, 1] * y / z + photo.K[1, 2]).astype(int).clip(0, photo.height - 1)
    seen[seen] = np.abs(depths[row, column] - z) < _TOLERANCE * z
    return seen


def _thin_scene(scene: Splats) -> Splats:
    """Return a sample of a large scene, its Gaussians widened so that surfaces stay closed."""
    if len(scene) <= _ROWS:
        return scene
    some = take_evenly(scene, _ROWS)
    return replace(some, scales=some.scales * np.float32(np.sqrt(len(scene) / _ROWS)))
