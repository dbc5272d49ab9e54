"""The public function that plans a pool of poses."""

from __future__ import annotations

from numpy.typing import ArrayLike

from g2ard.poses.pool import plan_pool
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats


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
    """Plan poses that see the scene well from free space, evenly spread.

    Args:
        splats: the scene, in any unit, origin and orientation.
        count: number of poses.
        kind: "orbit" (around an object, elevations −5° to 50°), "walk" (at eye height in free space, through
            rooms and streets), "aerial" (straight down and oblique), "inside" (surrounded by matter), "sharp"
            (free places whose image is full and sharp), or "auto". "auto" places poses within rooms in
            proportion to their share of the scene. An object is orbited. A landscape is seen from the air by
            three quarters of the poses and from the ground by one, where that is sharp. The remaining
            poses walk, or stand where the scene looks sharp.
        size: width and height in pixels.
        fov: horizontal field of view, degrees; None means 50, and 70 for a pool within rooms.
        up: (3,) direction away from the ground; None to estimate it.
        seed: seed of the placement; the same seed gives the same poses.
        rows: largest number of Gaussians to use, as a fair sample on a coarser grid. A sample is several
            times as fast, but less reliable in narrow places. None uses all.
        progress: called at each step.

    Returns:
        `count` cameras in world coordinates; by name, every 8th is a fair sample of all.

    Raises:
        InputError: nothing in the scene is visible, no free place has a view, or an argument is out of range.

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
