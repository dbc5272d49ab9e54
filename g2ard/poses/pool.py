"""Candidate pools: which kind a scene asks for, and its poses in an order that splits fairly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.cameras import Cameras
from g2ard.errors import InputError
from g2ard.poses.lattice import strata
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site
from g2ard.progress import Progress, silent
from g2ard.splats import Splats
from g2ard.splits import HOLD_OUT

__all__ = ["KINDS", "Pool", "plan_pool"]

KINDS = ("auto", "orbit")


@dataclass(frozen=True, eq=False)
class Pool:
    """A pool and how it came about.

    Args:
        cameras: in world coordinates; every 8th is a fair sample of all.
        kind: "orbit", "walk", "aerial", or several joined by " + ".
        why: what in the scene decided it.
        up: (3,) unit vector in the world.
    """

    cameras: Cameras
    kind: str
    why: str
    up: NDArray[np.float64]


def plan_pool(
    splats: Splats,
    count: int = 128,
    *,
    kind: str = "auto",
    size: tuple[int, int] = (800, 600),
    fov: float = 50.0,
    up: ArrayLike | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Pool:
    """As `make_pool`, with what was found out about the scene."""
    lens = _lens(size, fov)
    if count < 1:
        raise InputError(f"count: expected at least 1 pose, got {count}")
    if kind not in KINDS:
        raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    site = Site.of(splats, up)
    poses = plan_orbit(site, count, lens, seed)
    if len(poses) < count:
        raise InputError(f"only {len(poses)} of {count} poses found a free place with a view")
    order = strata(_features(poses), HOLD_OUT, seed)
    return Pool(poses.take(order).cameras(site, lens), "orbit", site.up.why, site.up.axis)


def _lens(size: tuple[int, int], fov: float) -> Lens:
    if min(size) < 1:
        raise InputError(f"size: expected at least 1×1 pixels, got {size[0]}×{size[1]}")
    if not 0 < fov < 180:
        raise InputError(f"fov: expected degrees between 0 and 180, got {fov}")
    return Lens((int(size[0]), int(size[1])), float(fov))


def _features(poses: Poses) -> Any:
    """What makes two poses alike: where they stand and where they look."""
    spread = max(float(np.ptp(poses.eyes, axis=0).max()), np.finfo(float).tiny)
    return np.concatenate([poses.eyes / spread, poses.gazes / 4], axis=1)
