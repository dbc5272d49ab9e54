"""Error of a leaf's coarser levels against its finest, measured with g2ard's rasteriser."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from g2ard.levels.tree import Leaf, Level
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.scene.splats import Splats

Float = NDArray[np.float64]

_DISTANCE = 200.0
"""Distance of the camera in radii of the leaf: ray directions differ by ⅓° across the image."""
_MARGIN = 1.05
_SMALLEST, _LARGEST = 64, 512
"""Limits of the image size in pixels; within them it shows the finest footprints at four pixels each."""
_FOOTPRINT = 0.1
"""Quantile of the longest scales taken as the finest level's footprint."""
_TURN = np.radians((40.0, 25.0, 10.0))
"""Rotation of the view axes about x, y and z; along the scene's axes half of the harmonics vanish."""


def leaf_errors(leaf: Leaf, levels: Sequence[Level]) -> list[float]:
    """Return Σ‖RGBA − RGBA_f‖² / Σ‖RGBA_f‖² per level over six views of the leaf's Gaussians alone.

    f is the finest level with Gaussians in the leaf. Errors never decrease from a level to the next coarser
    one, because viewers rank loads by the error removed. f and levels without Gaussians here have error 0.
    """
    there = [level for level, rows in enumerate(leaf.rows) if len(rows)]
    errors = [0.0] * len(levels)
    if len(there) < 2:
        return errors
    finest = levels[there[0]].take(leaf.rows[there[0]])
    cameras = _cameras(leaf, finest)
    wanted = _images(finest, cameras)
    whole = float(np.sum(np.square(wanted, dtype=np.float64)))
    worst = 0.0
    for level in there[1:]:
        got = _images(levels[level].take(leaf.rows[level]), cameras)
        lost = float(np.sum(np.square(got - wanted, dtype=np.float64)))
        worst = errors[level] = max(worst, lost / whole if whole > 0 else 0.0)
    return errors


def _cameras(leaf: Leaf, finest: Splats) -> list[Camera]:
    """Place cameras at both ends of three rotated axes with the bounding ball in each image."""
    middle = (leaf.low + leaf.high) / 2 + finest.offset
    radius = max(float(np.linalg.norm(leaf.high - leaf.low)) / 2, 1e-3)
    footprint = max(float(np.quantile(finest.scales.max(axis=1), _FOOTPRINT)), 1e-6)
    size = int(np.clip(4 * radius / footprint, _SMALLEST, _LARGEST))
    fov = float(np.degrees(2 * np.arctan(_MARGIN / _DISTANCE)))
    axes = _axes()
    return [
        Camera.facing(
            middle + sign * _DISTANCE * radius * axis,
            middle,
            width=size,
            height=size,
            fov=fov,
            up=axes[(i + 1) % 3],
        )
        for i, axis in enumerate(axes)
        for sign in (1.0, -1.0)
    ]


def _axes() -> Float:
    """Return (3, 3) orthonormal rows, none along an axis of the scene."""
    turn = np.eye(3)
    for axis, angle in enumerate(_TURN):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[a, a] = step[b, b] = np.cos(angle)
        step[b, a], step[a, b] = np.sin(angle), -np.sin(angle)
        turn = step @ turn
    return turn


def _images(splats: Splats, cameras: Sequence[Camera]) -> NDArray[np.float32]:
    """Render (6, S, S, 4) colours over black with alpha."""
    renderer = Renderer(splats)
    drawn = [renderer.render(camera) for camera in cameras]
    return np.stack([np.dstack([np.clip(image.image, 0, 1), image.alpha]) for image in drawn])
