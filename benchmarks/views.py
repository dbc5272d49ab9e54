"""Hidden views from anywhere in a scene, accepted by renders alone, not by the grid that plans pools."""

from __future__ import annotations

from typing import Any

import numpy as np

from g2ard import _core
from g2ard.poses.site import Site
from g2ard.rendering.renderer import RasterSettings, arrays_of, view_of
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats

__all__ = ["anywhere_views"]

_SIZE, _TRIED, _FOV = (800, 600), (200, 150), 70.0
"""Pixels of a view and of the render that tests it, and degrees across."""

_DISTANCES, _RISES = (0.04, 0.4), (-5.0, 35.0)
"""Ranges of the eye's position around its aim: distance in scene diagonals (log-uniform), and degrees above
the horizon."""

_CLOSE = 0.02
"""Share of the diagonal within which nothing may give more than `_MURK` of the picture's light."""

_MURK, _CLEAR = 0.08, 0.35
"""Most light from what is close, and least mean transmittance in front of the aim."""

_ROWS = 200_000
"""Gaussians that tell which way is up."""

_PATIENCE = 40
"""Poses tried per view, at most."""


def anywhere_views(splats: Splats, count: int = 24, seed: int = 0) -> Cameras:
    """Return views of random visible Gaussians from free places with a clear line of sight.

    There are fewer than `count` where few poses pass.

    Raises:
        InputError: nothing visible in the scene.
    """
    chance = np.random.default_rng(seed + 777)
    up = Site.of(splats, rows=_ROWS).up.axis
    means = splats.means.astype(np.float64) + splats.offset
    box = np.quantile(means[splats.opacities > 0.1], [0.02, 0.98], axis=0)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    inside = ((means > box[0]) & (means < box[1])).all(axis=1)
    rows = np.flatnonzero((splats.opacities > 0.3) & inside)
    level = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    level /= np.linalg.norm(level)
    frame = np.stack([level, np.cross(up, level), up])
    arrays, found = arrays_of(splats), []
    for _ in range(_PATIENCE * count if len(rows) else 0):
        row = int(rows[chance.integers(len(rows))])
        distance = diagonal * np.exp(chance.uniform(*np.log(_DISTANCES)))
        rise, turn = np.radians(chance.uniform(*_RISES)), chance.uniform(0, 2 * np.pi)
        outward = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)]) @ frame
        eye = means[row] + distance * outward
        view = look_at(eye, means[row], up)
        away = np.linalg.norm(means - eye, axis=1)
        if _is_clear(arrays, view, splats, row, away < _CLOSE * diagonal, 1e-3 * diagonal):
            found.append(view)
        if len(found) == count:
            break
    return _cameras(found, _SIZE)


def _is_clear(arrays: Any, view: Any, splats: Splats, row: int, close: Any, near: float) -> bool:
    """Return whether a small render shows the aim through little matter, and little that is close."""
    camera = _cameras([view], _TRIED).recentred(splats.offset)
    settings = RasterSettings(antialiased=False, near=near)
    sums: dict[str, Any] = _core.accumulate(arrays, [view_of(camera, 0, settings)], settings, None)
    if sums["weight"][close].sum() > _MURK * _TRIED[0] * _TRIED[1] or not sums["hits"][row]:
        return False
    return bool(sums["transmittance"][row] / sums["hits"][row] >= _CLEAR)


def _cameras(views: list[Any], size: tuple[int, int]) -> Cameras:
    focal = size[0] / 2 / np.tan(np.radians(_FOV / 2))
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    names = [f"anywhere_{i:04d}" for i in range(len(views))]
    return Cameras.from_lists(views, [K] * len(views), [size] * len(views), names)
