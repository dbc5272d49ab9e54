"""Candidate pools: which kind a scene asks for, and its poses in an order that splits fairly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.cameras import Cameras
from g2ard.errors import InputError
from g2ard.poses.aerial import plan_aerial
from g2ard.poses.lattice import strata
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.shape import shape_of
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site
from g2ard.poses.walk import plan_walk
from g2ard.progress import Progress, counter, silent
from g2ard.splats import Splats
from g2ard.splits import HOLD_OUT

__all__ = ["KINDS", "Pool", "plan_pool"]

KINDS = ("auto", "orbit", "walk", "aerial")

_STREET = 0.25
"""Share of a landscape's poses that stand in it, where there is room."""


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
    rows: int | None = None,
    progress: Progress = silent,
) -> Pool:
    """As `make_pool` (see there for all but the result), and what was found out about the scene.

    Raises:
        InputError: as `make_pool`.
    """
    lens = _lens(size, fov)
    if count < 1:
        raise InputError(f"count: expected at least 1 pose, got {count}")
    if rows is not None and rows < 1:
        raise InputError(f"rows: expected at least 1, got {rows}")
    if kind not in KINDS:
        raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    progress("scene", 0, 1)
    site = Site.of(splats, up, rows)
    progress("scene", 1, 1)
    kinds, why = _kinds(site, kind)
    tell = counter(progress, "poses")
    poses, used = _planned(site, kinds, count, lens, seed, tell)
    if len(poses) < count:
        raise InputError(
            f"{len(poses)} of {count} poses found a free place with a view ({kind}: {why}): "
            "ask for fewer, or for another kind"
        )
    order = strata(_features(poses), HOLD_OUT, seed)
    cameras = poses.take(order).cameras(site, lens)
    return Pool(cameras, " + ".join(used), f"{why}; {site.up.why}", site.up.axis)


def _kinds(site: Site, kind: str) -> tuple[dict[str, float], str]:
    """Kinds of poses and their shares, and why."""
    if kind != "auto":
        return {kind: 1.0}, "as asked"
    shape, why = shape_of(site)
    shares = {  # an orbit takes what the others could not place
        "object": {"orbit": 1.0},
        "room": {"walk": 1.0, "orbit": 1.0},
        "landscape": {"walk": _STREET, "aerial": 1.0, "orbit": 1.0},
    }
    return shares[shape], f"{shape}: {why}"


def _planned(
    site: Site, kinds: dict[str, float], count: int, lens: Lens, seed: int, tell: Callable[[int, int], None]
) -> tuple[Poses, list[str]]:
    """Each kind's share of what is left to plan; a kind that falls short leaves more to the next."""
    parts: list[Poses] = []
    used: list[str] = []
    for kind, share in kinds.items():
        wanted = round(share * (count - sum(len(part) for part in parts)))
        if not wanted:
            continue
        if kind == "walk":
            part = plan_walk(site, wanted, lens, seed, tell, indoors=shape_of(site)[0] == "room")
        else:
            part = {"orbit": plan_orbit, "aerial": plan_aerial}[kind](site, wanted, lens, seed, tell)
        if len(part):
            parts.append(part)
            used.append(kind)
    return (Poses.joined(parts) if parts else Poses(np.zeros((0, 3)), np.zeros((0, 3)))), used


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
