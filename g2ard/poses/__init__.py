"""Candidate cameras for a scene that comes without any."""

from __future__ import annotations

from numpy.typing import ArrayLike

from g2ard.cameras import Cameras
from g2ard.poses.pool import KINDS, Pool, plan_pool
from g2ard.progress import Progress, silent
from g2ard.splats import Splats

__all__ = ["KINDS", "Pool", "make_pool", "plan_pool"]


def make_pool(
    splats: Splats,
    count: int = 128,
    *,
    kind: str = "auto",
    size: tuple[int, int] = (800, 600),
    fov: float = 50.0,
    up: ArrayLike | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Cameras:
    """Poses that see the scene well from free space, evenly spread.

    Args:
        splats: the scene, any unit, origin and orientation.
        count: how many.
        kind: "auto" (by the scene's shape) or "orbit".
        size: width and height in pixels.
        fov: horizontal field of view, degrees.
        up: (3,) direction away from the ground; None to estimate it.
        seed: of the placement; the same seed gives the same poses.
        progress: told of each step.

    Returns:
        `count` cameras in world coordinates; by name, every 8th is a fair sample of all.

    Raises:
        InputError: nothing visible in the scene, no free place with a view, or an argument out of range.
    """
    return plan_pool(
        splats, count, kind=kind, size=size, fov=fov, up=up, seed=seed, progress=progress
    ).cameras
