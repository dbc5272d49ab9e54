"""Poses for a scene of any kind: within rooms, around and above, and wherever it looks sharp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.aerial import plan_aerial
from g2ard.poses.inside import Inside, plan_inside
from g2ard.poses.numbers import middle, norms
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.shape import shape_of
from g2ard.poses.sharp import Glance, plan_sharp
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site
from g2ard.poses.walk import plan_walk

_STREET = 0.25
"""Share of a landscape's poses that stand on its ground, where there is room."""

_SHARP = 0.04
"""Radians: a pose from around or above is sharp if `Sharpness.coarse`, the 90th percentile of the angular
standard deviations it sees, is smaller. Measured: objects .007–.01, a park .012, an open scene seen through
its own sky .1 and more."""

_SHARP_IN_SCALES = 12.0
"""The same limit as a multiple of the median Gaussian's angular standard deviation. The larger limit applies,
because a scene of few Gaussians has large ones. Measured without fog: 4 in an object, 9 and 12 in it at
12,500 and 3,000 rows."""

_SAMPLED = 16
"""Poses from around or above that are rendered first."""

_FEW, _MOST = 0.5, 0.9
"""Shares of sharp poses among those sampled: below the first, no pose from around or above is used; above the
second, all are. Between the two, each pose is rendered and judged."""


def plan_auto(
    site: Site,
    look: Callable[[], Glance],
    inside: Inside,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
) -> tuple[Poses, list[str], str]:
    """Plan at most `count` poses, and return them with their kinds and the reasons.

    No decision covers the scene as a whole. Rooms are seen from within, in proportion to their size. The
    other poses stand around or above the scene as its shape allows, where it looks sharp. The remaining poses
    stand on the ground and wherever the scene looks sharp.
    """
    parts: dict[str, Poses] = {}
    why = [f"{inside.share:.1%} of its box lies within rooms"]

    def missing() -> int:
        return count - sum(len(part) for part in parts.values())

    def add(kind: str, poses: Poses) -> None:
        if len(poses):
            parts[kind] = poses if kind not in parts else Poses.joined([parts[kind], poses])

    add("inside", plan_inside(site, inside, round(inside.weight * count), lens, seed, tell))
    if missing():
        shape, shape_why = shape_of(site)
        why.append(f"{shape}: {shape_why}")
        glance = look()
        far = _far(site, glance, "aerial" if shape == "landscape" else "orbit", missing(), lens, seed, tell)
        if shape != "object" and far.sharp:
            part = round((_STREET if shape == "landscape" else 1.0) * missing())
            add("walk", plan_walk(site, part, lens, seed, tell, indoors=shape == "room"))
        add(far.kind, far.poses.take(slice(missing())))
        if not far.sharp:
            why.append(f"from around or above it looks blurred ({far.share:.0%} of the poses are sharp)")
        if missing():
            ground = plan_walk(site, missing() // 2, lens, seed + 1, tell, indoors=False)
            add("sharp", plan_sharp(site, glance, missing(), lens, seed, tell, also=ground))
        if missing() and not far.sharp:
            add("walk", plan_walk(site, missing(), lens, seed + 2, tell, indoors=False))
    for kind, plan in (("aerial", plan_aerial), ("orbit", plan_orbit)):  # better foggy views than none
        if missing() and (not parts or kind in parts):
            add(kind, plan(site, missing(), lens, seed + 1, tell))
    for kind, plan in (("aerial", plan_aerial), ("orbit", plan_orbit)):  # or than too few
        if missing():
            add(kind, plan(site, missing(), lens, seed + 1, tell))
    none = Poses(np.zeros((0, 3)), np.zeros((0, 3)))
    return Poses.joined([none, *parts.values()]).take(slice(count)), list(parts), "; ".join(why)


@dataclass(frozen=True, eq=False)
class _Far:
    """Poses from around or above that look sharp, and the share of sampled poses that are."""

    kind: str
    poses: Poses
    share: float

    @property
    def sharp(self) -> bool:
        """Whether enough poses are sharp to rely on them."""
        return self.share >= _FEW


def _far(
    site: Site, glance: Glance, kind: str, count: int, lens: Lens, seed: int, tell: Callable[[int, int], None]
) -> _Far:
    plan = plan_aerial if kind == "aerial" else plan_orbit
    some = plan(site, count, lens, seed, tell, first=_SAMPLED)
    if not len(some):
        return _Far(kind, some, 1.0)
    share = float(_sharp(site, glance, some, lens, tell).mean())
    if share < _FEW:
        return _Far(kind, some.take(slice(0)), share)
    poses = plan(site, count, lens, seed, tell)
    if share < _MOST:
        poses = poses.take(_sharp(site, glance, poses, lens, tell))
    return _Far(kind, poses, share)


def _sharp(
    site: Site, glance: Glance, poses: Poses, lens: Lens, tell: Callable[[int, int], None]
) -> NDArray[np.bool_]:
    """Return whether each pose sees the scene sharply; matter behind the scene does not count."""
    away = norms(poses.eyes - site.box.mean(axis=0))
    reach = away + norms(site.box[1:] - site.box[:1]) / 2
    usual = middle(site.grid.scale_at(site.points))  # unweighted: a sky has few rows and much area
    coarse = glance.of(poses.cameras(site, lens), tell, site.size * reach).coarse
    return coarse < np.maximum(_SHARP, _SHARP_IN_SCALES * usual / np.maximum(away, np.finfo(float).tiny))
