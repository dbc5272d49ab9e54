"""Turntables: ordered views on a circle around a scene."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from g2ard.jobs.view_checks import opaque_points
from g2ard.poses import plan_pool
from g2ard.progress import Progress, Say, direction, silent, unsaid
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats

_TURN_POOL = 32
"""Generated poses, of which the one that shows most of the scene begins the turn."""


def turntable(
    scene: Splats,
    count: int,
    *,
    size: tuple[int, int] = (800, 600),
    up: Sequence[float] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Cameras:
    """Return views at equal angles on a level circle, all of which look at its middle.

    The first view is the generated one that shows most of the scene; the circle's middle is what lies at the
    median depth in its direction.

    Args:
        count: number of views; the one after the last would be the first again.
    """
    pool = plan_pool(scene, _TURN_POOL, size=size, up=up, seed=seed, progress=progress)
    points, axis = opaque_points(scene), np.asarray(pool.up, np.float64)
    if up is None:
        say(f"up: {direction(axis)}, estimated; --up X,Y,Z sets it")
    first = max(pool.cameras, key=lambda view: float(view.holds(points).mean()))
    eye, ahead = first.position, first.viewmat[2, :3]
    held = points[first.holds(points)]
    target = eye + float(np.median((held - eye) @ ahead)) * ahead
    height = ((eye - target) @ axis) * axis
    level = eye - target - height
    across = np.cross(axis, level)
    views = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        position = target + height + np.cos(angle) * level + np.sin(angle) * across
        views.append(replace(first, viewmat=look_at(position, target, axis), name=f"{k:04d}"))
    return Cameras.of(views)
