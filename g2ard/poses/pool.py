"""Candidate pools: which kind a scene asks for, and its poses in an order that splits fairly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.config.choices import POOL_KINDS
from g2ard.errors import InputError
from g2ard.poses.aerial import plan_aerial
from g2ard.poses.auto import plan_auto
from g2ard.poses.focus import Glance, plan_focus
from g2ard.poses.inside import find_inside, plan_inside
from g2ard.poses.lattice import strata
from g2ard.poses.near import Reach, plan_near, reach_of
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.shape import shape_of
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site
from g2ard.poses.walk import plan_walk
from g2ard.progress import Progress, counter, silent
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.splits import HOLD_OUT

_WORTH = 1.1
"""Times as many poses for which planning begins anew."""

_COARSE = (0.2, 0.4)
"""Share of the matter seen only under a pixel: between these ever more poses step nearer. Measured: objects
.06–.17, whole scenes .01–.06, two chunks cut from a room, seen from outside, .44 and .55."""

_POINTS = 4096
"""Of the scene's matter, looked for in the views."""

_FOV, _FOV_INSIDE = 50.0, 70.0
"""Degrees: within rooms people take wider lenses."""

_MOSTLY_INSIDE = 0.5
"""Share of a pool within rooms above which all of it has that lens."""


@dataclass(frozen=True, eq=False)
class Pool:
    """A pool and how it came about.

    Args:
        cameras: in world coordinates; every 8th is a fair sample of all.
        kind: "orbit", "walk", "aerial", "near", …, or several joined by " + ".
        why: what in the scene decided it.
        up: (3,) unit vector in the world.
        unseen: share of a sample of the matter that no pose sees.
        coarse: share that is seen, but nowhere with a standard deviation of a pixel.
        apart: views of another kind than `cameras`, nearer to what those see; None unless asked for.
    """

    cameras: Cameras
    kind: str
    why: str
    up: NDArray[np.float64]
    unseen: float = 0.0
    coarse: float = 0.0
    apart: Cameras | None = None


def plan_pool(
    splats: Splats,
    count: int = 128,
    *,
    kind: str = "auto",
    size: tuple[int, int] = (800, 600),
    fov: float | None = None,
    up: ArrayLike | None = None,
    seed: int = 0,
    rows: int | None = None,
    apart: int = 0,
    grow: float = 1.0,
    near: float = 0.0,
    looks: bool = False,
    represents: float = 1.0,
    progress: Progress = silent,
) -> Pool:
    """As `make_pool` (see there for all but the result), and what was found out about the scene.

    Args:
        splats: as `make_pool`, which has what is not here; or a fair sample of the scene, see `represents`.
        count: poses, where a view holds the whole scene.
        apart: views of another kind to make beside, nearer ones; at most so many.
        grow: where a view holds a share h of the scene there are 1/√h times as many poses, at most this
            many times.
        near: share of the poses, at most, that step nearer to what the others see: near·max(s, 1 − h), where
            s rises from 0 to 1 with the share of the matter that is only seen under a pixel. 1 − h counts in
            pools for `looks` alone.
        looks: a pool to weigh Gaussians by, not to learn from.
        represents: how many of the scene's Gaussians a row of `splats` stands for.

    Raises:
        InputError: as `make_pool`.
    """
    lens = _lens(size, _FOV if fov is None else fov)
    if count < 1:
        raise InputError(f"expected at least 1 pose, got {count}", parameter="count")
    if rows is not None and rows < 1:
        raise InputError(f"expected at least 1, got {rows}", parameter="rows")
    if kind not in POOL_KINDS:
        raise InputError(f"expected one of {', '.join(POOL_KINDS)}, got {kind!r}", parameter="kind")
    progress("scene", 0, 1)
    site = Site.of(splats, up, rows, represents)
    progress("scene", 1, 1)
    tell = counter(progress, "poses")
    inside = find_inside(site, seed) if kind == "auto" else None
    if inside is not None and fov is None and inside.weight > _MOSTLY_INSIDE:
        lens = _lens(size, _FOV_INSIDE)

    def glance() -> Glance:
        return Glance(splats, represents)

    def plan(count: int) -> tuple[Poses, list[str], str]:
        if inside is not None:
            return plan_auto(site, glance, inside, count, lens, seed, tell)
        return _planned(site, glance, kind, count, lens, seed, tell), [kind], "as asked"

    poses, used, why = plan(count)
    held = _held(site, poses, lens)
    wanted = round(count * max(1.0, min(grow, 1 / np.sqrt(held))))
    if len(poses) == count and wanted > _WORTH * count:
        poses, used, why = plan(wanted)
    if len(poses) < count:
        raise InputError(
            f"{len(poses)} of {count} poses found a free place with a view ({kind}: {why}): "
            f"ask for {'fewer, or for ' if len(poses) else ''}another kind (`g2ard poses --kind`), "
            "or give views"
        )
    reach = reach_of(site, poses, lens)
    # Of the pool as planned, before any of its poses steps nearer, and with another seed than those.
    apart_views = _apart(site, poses, reach, apart, lens, seed)
    coarse = float(reach.coarse(lens).mean())
    need = max(float(np.interp(coarse, _COARSE, (0, 1))), 1 - held if looks else 0.0)
    near_poses = plan_near(site, poses, reach, int(near * need * len(poses)), lens, seed + 1)
    if len(near_poses):
        kept = np.linspace(0, len(poses) - 1, len(poses) - len(near_poses)).round().astype(int)
        poses, used = Poses.joined([poses.take(kept), near_poses]), [*used, "near"]
        reach = reach_of(site, poses, lens)
    order = strata(_features(poses), HOLD_OUT, seed)
    return Pool(
        poses.take(order).cameras(site, lens),
        " + ".join(used),
        f"{why}; {site.up.why}",
        site.up.axis,
        unseen=reach.unseen(),
        coarse=float(reach.coarse(lens).mean()),
        apart=apart_views,
    )


def _held(site: Site, poses: Poses, lens: Lens) -> float:
    """Share of the scene's matter that a pose has in its frame."""
    if not len(poses):
        return 1.0
    points = site.origin + site.size * (site.points[:_POINTS] @ site.axes)
    return max(poses.cameras(site, lens).usual_share(points), 1 / _POINTS)


def _apart(site: Site, poses: Poses, reach: Reach, count: int, lens: Lens, seed: int) -> Cameras | None:
    """Views of another kind; None where none is asked for or has room."""
    nearer = plan_near(site, poses, reach, count, lens, seed)
    if not len(nearer):
        return None
    cameras = nearer.cameras(site, lens)
    return replace(cameras, names=tuple(name.replace("pose", "near") for name in cameras.names))


def _planned(
    site: Site,
    glance: Callable[[], Glance],
    kind: str,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
) -> Poses:
    """Poses of a kind that was asked for."""
    if kind == "inside":
        return plan_inside(site, find_inside(site, seed), count, lens, seed, tell)
    if kind == "focus":
        return plan_focus(site, glance(), count, lens, seed, tell)
    if kind == "walk":
        return plan_walk(site, count, lens, seed, tell, indoors=shape_of(site)[0] == "room")
    return {"orbit": plan_orbit, "aerial": plan_aerial}[kind](site, count, lens, seed, tell)


def _lens(size: tuple[int, int], fov: float) -> Lens:
    if min(size) < 1:
        raise InputError(f"expected at least 1×1 pixels, got {size[0]}×{size[1]}", parameter="size")
    if not 0 < fov < 180:
        raise InputError(f"expected degrees between 0 and 180, got {fov}", parameter="fov")
    return Lens((int(size[0]), int(size[1])), float(fov))


def _features(poses: Poses) -> Any:
    """What makes two poses alike: where they stand and where they look."""
    spread = max(float(np.ptp(poses.eyes, axis=0).max()), np.finfo(float).tiny)
    return np.concatenate([poses.eyes / spread, poses.gazes / 4], axis=1)
