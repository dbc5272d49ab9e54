"""Cameras for a scene that comes without any: around objects, through rooms and streets, from the air.

The scene is stood upright (`up`), weighed without its floaters and sky (`matter`), its free space mapped
(`grid`, `site`), its shape named (`shape`); then planners (`orbit`, `walk`, `aerial`, `inside`, `focus`)
propose poses from endless even sequences and keep those that stand free and see enough (`sight`, `gather`).
`auto` joins them; `near` steps nearer to what a pool sees and tells what it does not.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from g2ard.poses.pool import Pool, plan_pool
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

__all__ = ["Pool", "make_pool", "plan_pool"]


def make_pool(
    splats: Splats,
    count: int = 128,
    *,
    kind: str = "auto",
    size: tuple[int, int] = (800, 600),
    fov: float | None = None,
    up: ArrayLike | None = None,
    seed: int = 0,
    rows: int | None = None,
    progress: Progress = silent,
) -> Cameras:
    """Poses that see the scene well from free space, evenly spread.

    Args:
        splats: the scene, any unit, origin and orientation.
        count: how many.
        kind: "orbit" (around an object, elevations −5° to 50°), "walk" (in free space at eye height, through
            rooms and streets), "aerial" (straight down and oblique), "inside" (where matter is all around),
            "focus" (free places whose image is full and fine), or "auto": within rooms as far as the
            scene lies within such; orbit for an object, three quarters aerial and a quarter walk for a
            landscape, as far as it is in focus from there; the rest walks or stands where it is in focus.
        size: width and height in pixels.
        fov: horizontal field of view, degrees; None means 50, and 70 for a pool within rooms.
        up: (3,) direction away from the ground; None to estimate it.
        seed: of the placement; the same seed gives the same poses.
        rows: of more Gaussians than this only a fair sample is looked at, on a coarser grid: less sure of
            narrow places, several times as fast. None for all.
        progress: told of each step.

    Returns:
        `count` cameras in world coordinates; by name, every 8th is a fair sample of all.

    Raises:
        InputError: nothing visible in the scene, no free place with a view, or an argument out of range.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(500, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> cameras = make_pool(Splats.create(ball, scales=np.full((500, 3), 0.05)), 16)
    >>> len(cameras), cameras.names[0], bool((np.linalg.norm(cameras.positions, axis=1) > 2).all())
    (16, 'pose_0000', True)
    """
    return plan_pool(
        splats, count, kind=kind, size=size, fov=fov, up=up, seed=seed, rows=rows, progress=progress
    ).cameras
