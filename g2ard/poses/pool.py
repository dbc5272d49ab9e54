"""Pools of views: the planners that suit a scene, their number, and an order that splits fairly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Int, Mask
from g2ard.config.choices import POOL_KINDS
from g2ard.errors import InputError, require
from g2ard.io.splits import HOLD_OUT
from g2ard.poses.outside import plan_aerial, plan_orbit
from g2ard.poses.showing import is_hidden
from g2ard.poses.sight import Lens, Poses, Survey
from g2ard.poses.site import Site
from g2ard.poses.within import (
    WIDE,
    Reach,
    framed,
    is_room,
    plan_anywhere,
    plan_beyond,
    plan_inside,
    plan_near,
    plan_sharp,
    plan_walk,
    reach_of,
)
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.reproducible import middle, norms, positive, strata
from g2ard.scene.splats import Splats

_PLANNERS: dict[str, Callable[..., Poses]] = {
    "orbit": plan_orbit,
    "aerial": plan_aerial,
    "inside": plan_inside,
    "walk": plan_walk,
    "sharp": plan_sharp,
}

_POINTS = 4096
"""Points of the scene's matter that are projected into the views to tell how many are needed."""

_WORTH = 1.1
"""Factor by which the number of views must grow before they are planned again."""

_COARSE = (0.2, 0.4)
"""Shares of the matter seen only below a pixel between which more and more poses step nearer. Measured:
objects .06–.17, whole scenes .01–.06, two chunks cut from a room, seen from outside, .44 and .55."""

_BEYOND_UNSEEN = 0.05
"""Share of the scene beyond near matter that no frame needs to hold."""

_MOST_BEYOND = 0.1
"""Largest share of a pool that looks beyond near matter: a sky has few details."""

_FOV = 50.0
"""Horizontal field of view in degrees of poses around or above a scene."""

_STREET = 0.25
"""Share of a landscape's poses that stand on its ground, where there is room."""

_SHARP = 0.04
"""Radians: a pose from around or above is sharp if what it sees (`Glance.of`) is smaller than this or than
`_SHARP_IN_SCALES`. Measured: objects .007–.01, a park .012, an open scene seen through its own sky .1 and
more."""

_SHARP_IN_SCALES = 12.0
"""Multiples of the median Gaussian's angular standard deviation, because a scene of few Gaussians has large
ones. Measured without fog: 4 median Gaussians in an object, 9 and 12 in it at 12,500 and 3,000 rows."""

_SAMPLED = 16
"""Poses from around or above that are rendered first."""

_FEW = 0.5
"""Share of sharp poses among these below which no pose from there is used."""

_MOST = 0.9
"""Share of sharp poses above which all are used. Between the two, each pose is rendered and judged."""


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
        more: plans additional views of a kind, near, standing or anywhere: at most as many as requested.
    """

    cameras: Cameras
    kind: str
    why: str
    up: Float
    unseen: float = 0.0
    coarse: float = 0.0
    more: Callable[[str, int], list[Camera]] = field(default=lambda kind, count: [])


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
    represents: float = 1.0,
    progress: Progress = silent,
) -> Pool:
    """Plan a pool like `make_pool`, and return it with the reasons and statistics.

    Other arguments and errors are those of `make_pool`.

    Args:
        count: number of poses if a view holds the whole scene.
        grow: largest factor on `count`; if a view holds a share h of the scene, the factor is 1/√h.
        near: largest share of the poses that step nearer to what the others see. The actual share is near·s,
            where s is at least 1−h and rises to 1 with the share of the matter that is only seen below a
            pixel.
        represents: Gaussians of the scene per row of `splats`.
    """
    lens = Lens(size, _FOV if fov is None else fov)
    require("count", count, count >= 1, "at least 1 pose")
    require("rows", rows, rows is None or rows >= 1, "at least 1")
    require("kind", repr(kind), kind in POOL_KINDS, f"one of {', '.join(POOL_KINDS)}")
    progress("scene", 0, 1)
    site = Site.of(splats, up, rows, represents)
    progress("scene", 1, 1)

    def tell(done: int, total: int) -> None:
        progress("poses", done, total)
        if done >= total:
            progress("poses", 0, 0)  # until the next kind of poses

    tell(0, 0)
    survey = Survey(splats, represents, site, lens, seed, tell)
    if kind == "auto" and fov is None and is_room(survey):
        survey = replace(survey, lens=Lens(size, WIDE))
    poses, used, why = _plan(survey, kind, count)
    held = _measure_share_held(survey, poses)
    growth = min(grow, 1 / np.sqrt(held))
    wanted = round(count * max(1.0, growth))
    if len(poses) == count and wanted > _WORTH * count:
        first = poses
        before = used
        poses, used, why = _plan(survey, kind, wanted)
        if set(before) - set(used):  # more poses from above are lower, and may be judged otherwise
            further = _spread_rows(len(poses), wanted - count)
            poses = Poses.joined([first, poses.take(further)])
            used = list(dict.fromkeys([*before, *used]))
    if len(poses) < count:
        raise InputError(
            f"{len(poses)} of {count} poses found a free place with a view ({kind}: {why}); "
            f"request {'fewer, or ' if len(poses) else ''}another kind (`g2ard poses --kind`), "
            "or give views of the scene"
        )
    poses, looks_beyond = _add_beyond(survey, poses)
    if looks_beyond:
        used.append("beyond")
    reach = reach_of(survey, poses)
    more = partial(_plan_more, survey, poses, reach)
    coarse_need = float(np.interp(reach.coarse.mean(), _COARSE, (0, 1)))
    need = max(coarse_need, 1 - held)
    near_poses = plan_near(survey, poses, reach, int(near * need * len(poses)), 1)
    if len(near_poses):
        poses = _replace_some(poses, near_poses)
        used.append("near")
        reach = reach_of(survey, poses)
    spread = positive(np.ptp(poses.eyes, axis=0).max())
    # close for similar poses
    features = np.concatenate([poses.eyes / spread, poses.gazes / 4], axis=1)
    order = strata(features, HOLD_OUT, seed)
    progress("poses", 1, 1)
    return Pool(
        survey.cameras(poses.take(order)),
        " + ".join(used),
        f"{why}; {site.vertical.why}",
        site.vertical.axis,
        unseen=float((reach.nearest < 0).mean()),
        coarse=float(reach.coarse.mean()),
        more=more,
    )


def _spread_rows(count: int, some: int) -> Int:
    """Return `some` evenly spread rows of `count`."""
    return np.linspace(0, count - 1, some).round().astype(np.int64)


def _replace_some(poses: Poses, others: Poses) -> Poses:
    """Return as many poses as before, of which `others` take the places of evenly spread ones."""
    kept = _spread_rows(len(poses), len(poses) - len(others))
    return Poses.joined([poses.take(kept), others])


def _add_beyond(survey: Survey, poses: Poses) -> tuple[Poses, bool]:
    """Let some poses look at a sky or surroundings that no frame holds; return whether any does."""
    beyond = survey.site.beyond
    if not len(beyond):
        return poses, False
    missing = ~framed(survey, poses, beyond)
    share = survey.site.beyond_share * float(missing.mean()) - _BEYOND_UNSEEN
    count = round(float(np.clip(share, 0, _MOST_BEYOND)) * len(poses))
    others = plan_beyond(survey, poses, beyond[missing], count)
    return _replace_some(poses, others), count > 0


def _plan(survey: Survey, kind: str, count: int) -> tuple[Poses, list[str], str]:
    """Return at most `count` poses of a kind, the kinds used, and the reasons."""
    if kind == "auto":
        parts, why = _plan_auto(survey, count)
    else:
        parts = {kind: _PLANNERS[kind](survey, count)}
        why = "as requested"
    return Poses.joined([*parts.values()]).take(slice(count)), [*parts], why


def _plan_more(
    survey: Survey,
    poses: Poses,
    reach: Reach,
    kind: str,
    count: int,
) -> list[Camera]:
    """Plan `Pool.more` views; near ones step from `poses`, with another seed than the pool's own."""
    survey.tell(0, 0)
    wide = replace(survey, lens=Lens(survey.lens.size, WIDE))
    if kind == "near":
        views = survey.cameras(plan_near(survey, poses, reach, count))
    elif kind == "anywhere":
        views = wide.cameras(plan_anywhere(wide, count))
    else:
        indoors = True if is_hidden(survey) else None  # below a ceiling, not on it
        views = wide.cameras(plan_walk(wide, count, 3, indoors=indoors))
    return [replace(view, name=view.name.replace("pose", kind), kind=kind) for view in views]


class _Mix:
    """Poses of several kinds, up to a number."""

    def __init__(self, count: int) -> None:
        self.parts: dict[str, Poses] = {}
        self._count = count

    @property
    def missing(self) -> int:
        """Number of poses that are missing."""
        return self._count - sum(len(part) for part in self.parts.values())

    def add(self, kind: str, poses: Poses) -> None:
        """Add poses to those of their kind."""
        if not len(poses):
            return
        before = [self.parts[kind]] if kind in self.parts else []
        self.parts[kind] = Poses.joined([*before, poses])


def _plan_auto(survey: Survey, count: int) -> tuple[dict[str, Poses], str]:
    """Plan poses for a scene of any kind; return them by kind, and the reasons.

    No decision covers the scene as a whole. Rooms are seen from within, in proportion to their size. The
    other poses stand around or above the scene as its shape allows, where it looks sharp from there. The
    remaining poses stand on the ground and wherever the scene looks sharp.
    """
    mix = _Mix(count)
    inside = survey.inside
    why = [f"{inside.share:.1%} of its box lies within rooms"]
    mix.add("inside", plan_inside(survey, round(inside.weight * count)))
    if mix.missing > 0 and is_hidden(survey):
        why.append("a ceiling hides it from around and above")
        mix.add("walk", plan_walk(survey, mix.missing, indoors=True))
        mix.add("walk", plan_walk(survey, mix.missing))
        mix.add("sharp", plan_sharp(survey, mix.missing))
    elif mix.missing:
        why += _add_from_outside(survey, mix)
    for kind in sorted(("aerial", "orbit"), key=lambda kind: kind not in mix.parts):
        if mix.missing:  # rather hidden or foggy views than too few
            mix.add(kind, _PLANNERS[kind](survey, mix.missing, 1))
    return mix.parts, "; ".join(why)


def _add_from_outside(survey: Survey, mix: _Mix) -> list[str]:
    """Add poses around or above a scene that look sharp, and others within it; return the reasons."""
    landscape = survey.site.is_landscape
    kind = "aerial" if landscape else "orbit"
    why = ["a landscape" if landscape else "an object"]
    plan = _PLANNERS[kind]
    sharp = _see_sharply(survey, plan(survey, mix.missing, first=_SAMPLED))
    if len(sharp):
        share = float(sharp.mean())
    else:
        share = 1.0
    if share < _FEW:
        why.append(f"from around or above it looks blurred ({share:.0%} of the poses are sharp)")
        far = Poses.joined([])
    else:
        far = plan(survey, mix.missing)
        if share < _MOST:
            far = far.take(_see_sharply(survey, far))
        if landscape or is_room(survey):
            walks = _STREET if landscape else 1.0
            mix.add("walk", plan_walk(survey, round(walks * mix.missing)))
    mix.add(kind, far.take(slice(mix.missing)))
    if mix.missing:
        walk = plan_walk(survey, mix.missing // 2, 1)
        mix.add("sharp", plan_sharp(survey, mix.missing, also=walk))
    if mix.missing and share < _FEW:
        mix.add("walk", plan_walk(survey, mix.missing, 2))
    return why


def _see_sharply(survey: Survey, poses: Poses) -> Mask:
    """Return whether each pose sees the scene sharply; matter behind the scene does not count."""
    site = survey.site
    away = norms(poses.eyes - site.box.mean(axis=0))
    reach = away + site.diagonal / 2
    # unweighted: a sky has few rows and much area
    usual = float(middle(site.grid.scale_at(site.points)))
    _, _, coarse = survey.glance.of(survey.cameras(poses), site.size * reach)
    return coarse < np.maximum(_SHARP, _SHARP_IN_SCALES * usual / positive(away))


def _measure_share_held(survey: Survey, poses: Poses) -> float:
    """Return the share of the scene's matter that a typical pose has in its frame."""
    if not len(poses):
        return 1.0
    points = survey.site.globalize(survey.site.points[:_POINTS])
    return max(survey.cameras(poses).usual_share(points), 1 / _POINTS)
