"""Candidate pools: the kind of poses that suits a scene, in an order that splits fairly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.config.choices import POOL_KINDS
from g2ard.errors import InputError
from g2ard.poses.aerial import plan_aerial
from g2ard.poses.anywhere import plan_anywhere
from g2ard.poses.auto import plan_auto
from g2ard.poses.inside import find_inside, plan_inside
from g2ard.poses.lattice import strata
from g2ard.poses.near import plan_near, reach_of
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.shape import shape_of
from g2ard.poses.sharp import SIGHT_ROWS, Glance, plan_sharp
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site
from g2ard.poses.walk import plan_walk
from g2ard.progress import Progress, counter, silent
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.splits import HOLD_OUT

_WORTH = 1.1
"""Factor by which the number of poses must grow before they are planned again."""

_COARSE = (0.2, 0.4)
"""Shares of the matter seen only below a pixel between which more and more poses step nearer. Measured:
objects .06–.17, whole scenes .01–.06, two chunks cut from a room, seen from outside, .44 and .55."""

_POINTS = 4096
"""Points of the scene's matter that are projected into the views."""

_FOV, _FOV_WIDE = 50.0, 70.0
"""Horizontal fields of view in degrees: within a scene people use wider lenses."""

_MOSTLY_INSIDE = 0.5
"""Share of a pool within rooms above which the whole pool uses the wider lens."""


@dataclass(frozen=True, eq=False)
class Pool:
    """A pool of cameras, and how it was planned.

    Args:
        cameras: in world coordinates; every 8th is a fair sample of all.
        kind: "orbit", "walk", "aerial", "near", …, or several joined by " + ".
        why: the reasons for the kind and the up direction.
        up: (3,) unit vector in world coordinates.
        unseen: share of a sample of the matter that no pose sees.
        coarse: share that is seen, but nowhere with a standard deviation of a pixel.
        held: share of the matter that a typical pose has in its frame.
        more: plans additional views of a kind, near, standing or anywhere: at most as many as requested.
    """

    cameras: Cameras
    kind: str
    why: str
    up: NDArray[np.float64]
    unseen: float = 0.0
    coarse: float = 0.0
    held: float = 1.0
    more: Callable[[str, int], list[Camera]] = field(default=lambda kind, count: [])


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
    grow: float = 1.0,
    near: float = 0.0,
    looks: bool = False,
    represents: float = 1.0,
    progress: Progress = silent,
) -> Pool:
    """Plan a pool like `make_pool`, and return it with the reasons and statistics.

    Arguments not listed here are those of `make_pool`.

    Args:
        splats: the scene, or a fair sample of it (see `represents`).
        count: number of poses if a view holds the whole scene.
        grow: largest factor on `count`; if a view holds a share h of the scene, the factor is 1/√h.
        near: largest share of the poses that step nearer to what the others see. The actual share is near·s,
            where s rises from 0 to 1 with the share of the matter that is only seen below a pixel. With
            `looks`, s is at least 1−h.
        looks: whether the pool is for weighing Gaussians rather than for training.
        represents: Gaussians of the scene per row of `splats`.

    Raises:
        InputError: as for `make_pool`.
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
        lens = _lens(size, _FOV_WIDE)

    def glance() -> Glance:
        return Glance(splats, represents)

    def plan(count: int) -> tuple[Poses, list[str], str]:
        if inside is not None:
            return plan_auto(site, glance, inside, count, lens, seed, tell)
        return _planned(site, glance, kind, count, lens, seed, tell), [kind], "as requested"

    poses, used, why = plan(count)
    held = _held(site, poses, lens)
    wanted = round(count * max(1.0, min(grow, 1 / np.sqrt(held))))
    if len(poses) == count and wanted > _WORTH * count:
        poses, used, why = plan(wanted)
    if len(poses) < count:
        raise InputError(
            f"{len(poses)} of {count} poses found a free place with a view ({kind}: {why}); "
            f"request {'fewer, or ' if len(poses) else ''}another kind (`g2ard poses --kind`), "
            "or give views of the scene"
        )
    reach = reach_of(site, poses, lens)
    far = poses, reach
    coarse = float(reach.coarse(lens).mean())
    need = max(float(np.interp(coarse, _COARSE, (0, 1))), 1 - held if looks else 0.0)
    near_poses = plan_near(site, poses, reach, int(near * need * len(poses)), lens, seed + 1)
    if len(near_poses):
        kept = np.linspace(0, len(poses) - 1, len(poses) - len(near_poses)).round().astype(int)
        poses, used = Poses.joined([poses.take(kept), near_poses]), [*used, "near"]
        reach = reach_of(site, poses, lens)

    def more(kind: str, count: int) -> list[Camera]:
        if kind == "near":  # of the pool before any pose stepped nearer, and with another seed
            return _named(kind, plan_near(site, *far, count, lens, seed), site, lens)
        wide = _lens(size, _FOV_WIDE)
        if kind == "standing":
            return _named(kind, _planned(site, glance, "walk", count, wide, seed + 3, tell), site, wide)
        small = _lens((max(1, size[0] // 2), max(1, size[1] // 2)), _FOV_WIDE)  # they see little
        eyes = plan_anywhere(site, Glance(splats, represents, SIGHT_ROWS), count, small, seed, tell)
        return _named(kind, eyes, site, small)

    order = strata(_features(poses), HOLD_OUT, seed)
    return Pool(
        poses.take(order).cameras(site, lens),
        " + ".join(used),
        f"{why}; {site.up.why}",
        site.up.axis,
        unseen=reach.unseen(),
        coarse=float(reach.coarse(lens).mean()),
        held=held,
        more=more,
    )


def _held(site: Site, poses: Poses, lens: Lens) -> float:
    """Return the share of the scene's matter that a typical pose has in its frame."""
    if not len(poses):
        return 1.0
    points = site.origin + site.size * (site.points[:_POINTS] @ site.axes)
    return max(poses.cameras(site, lens).usual_share(points), 1 / _POINTS)


def _named(kind: str, poses: Poses, site: Site, lens: Lens) -> list[Camera]:
    """Return cameras whose names state their kind."""
    return [replace(view, name=view.name.replace("pose", kind)) for view in poses.cameras(site, lens)]


def _planned(
    site: Site,
    glance: Callable[[], Glance],
    kind: str,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
) -> Poses:
    """Plan poses of a given kind."""
    if kind == "inside":
        return plan_inside(site, find_inside(site, seed), count, lens, seed, tell)
    if kind == "sharp":
        return plan_sharp(site, glance(), count, lens, seed, tell)
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
    """Return features that are close for poses with similar positions and gazes."""
    spread = max(float(np.ptp(poses.eyes, axis=0).max()), np.finfo(float).tiny)
    return np.concatenate([poses.eyes / spread, poses.gazes / 4], axis=1)
