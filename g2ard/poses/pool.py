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
from g2ard.poses.anywhere import ANYWHERE_FOV, plan_anywhere
from g2ard.poses.auto import plan_auto
from g2ard.poses.focus import SIGHT_ROWS, Glance, plan_focus
from g2ard.poses.inside import find_inside, plan_inside
from g2ard.poses.lattice import strata
from g2ard.poses.near import Reach, plan_near, reach_of
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.shape import shape_of
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

_FOV, _FOV_INSIDE = 50.0, 70.0
"""Horizontal fields of view in degrees: within rooms people use wider lenses."""

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
        apart: additional views nearer to what `cameras` see; None unless requested.
        anywhere: plans additional views from anywhere, at most as many as requested.
    """

    cameras: Cameras
    kind: str
    why: str
    up: NDArray[np.float64]
    unseen: float = 0.0
    coarse: float = 0.0
    held: float = 1.0
    apart: Cameras | None = None
    anywhere: Callable[[int], list[Camera]] = field(default=lambda count: [])


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
    """Plan a pool like `make_pool`, and return it with the reasons and statistics.

    Arguments not listed here are those of `make_pool`.

    Args:
        splats: the scene, or a fair sample of it (see `represents`).
        count: number of poses if a view holds the whole scene.
        apart: largest number of nearer views to plan in addition, as a separate set.
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
        lens = _lens(size, _FOV_INSIDE)

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
    # Based on the pool before any pose steps nearer, and on another seed than the near poses.
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
        held=held,
        apart=apart_views,
        anywhere=lambda count: _anywhere(
            site, Glance(splats, represents, SIGHT_ROWS), count, size, seed, tell
        ),
    )


def _held(site: Site, poses: Poses, lens: Lens) -> float:
    """Return the share of the scene's matter that a typical pose has in its frame."""
    if not len(poses):
        return 1.0
    points = site.origin + site.size * (site.points[:_POINTS] @ site.axes)
    return max(poses.cameras(site, lens).usual_share(points), 1 / _POINTS)


def _apart(site: Site, poses: Poses, reach: Reach, count: int, lens: Lens, seed: int) -> Cameras | None:
    """Return nearer views as a separate set, or None if none is requested or none has room."""
    nearer = plan_near(site, poses, reach, count, lens, seed)
    if not len(nearer):
        return None
    cameras = nearer.cameras(site, lens)
    return replace(cameras, names=tuple(name.replace("pose", "near") for name in cameras.names))


def _anywhere(
    site: Site, glance: Glance, count: int, size: tuple[int, int], seed: int, tell: Callable[[int, int], None]
) -> list[Camera]:
    """Return at most `count` views from anywhere, half as large as others because they see little."""
    lens = _lens((max(1, size[0] // 2), max(1, size[1] // 2)), ANYWHERE_FOV)
    cameras = plan_anywhere(site, glance, count, lens, seed, tell).cameras(site, lens)
    return [replace(view, name=view.name.replace("pose", "anywhere")) for view in cameras]


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
    """Return features that are close for poses with similar positions and gazes."""
    spread = max(float(np.ptp(poses.eyes, axis=0).max()), np.finfo(float).tiny)
    return np.concatenate([poses.eyes / spread, poses.gazes / 4], axis=1)
