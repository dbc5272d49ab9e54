"""Turntables: ordered views on a circle around a scene."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from g2ard.config.checks import AtLeastOne, checks_arguments
from g2ard.jobs.view_checks import opaque_points
from g2ard.poses import plan_pool
from g2ard.progress import Progress, Say, direction, silent, unsaid
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats

_TURN_POOL = 32
"""Generated poses, of which the one that shows most of the scene begins the turn."""


@checks_arguments
def orbit(
    scene: Splats,
    count: AtLeastOne = 48,
    *,
    size: tuple[int, int] = (800, 600),
    up: Sequence[float] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Cameras:
    """Return views at equal angles on a level circle around a scene, like `g2ard render --orbit`.

    All look at the circle's middle.

    The first view is the generated one that shows most of the scene; the circle's middle is what lies at the
    median depth in its direction.

    Args:
        scene: the scene.
        count: number of views; the one after the last would be the first again.
        size: width and height, pixels.
        up: (3,) direction away from the ground; None estimates it.
        seed: seed of the generated poses.
        progress: called while poses are planned.
        say: called with the estimated up direction.

    Returns:
        The views, in order.

    Raises:
        InputError: the scene is not visible, or has no room for poses around it.

    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> len(orbit(scene, 4, size=(64, 48)))
    4
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
