"""Poses for a scene of any kind: from within, from around and above, from where it is in focus."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.aerial import plan_aerial
from g2ard.poses.focus import Glance, plan_focus
from g2ard.poses.inside import find_inside, plan_inside
from g2ard.poses.numbers import middle, norms
from g2ard.poses.orbit import plan_orbit
from g2ard.poses.shape import shape_of
from g2ard.poses.sight import Lens, Poses
from g2ard.poses.site import Site
from g2ard.poses.walk import plan_walk
from g2ard.splats import Splats

__all__ = ["plan_auto"]

_SOME_INSIDE, _ALL_INSIDE = 0.005, 0.025
"""Share of the box that lies within rooms: below the first nobody stands inside, from the second on everybody
does. Measured: showroom .026–.079, objects and open scenes 0.000."""

_STREET = 0.25
"""Share of a landscape's poses that stand in it, where there is room."""

_SHARP = 0.04
"""Radians: the 90th percentile of what a pose from around or above shows, at most. Measured: objects
.007–.01, a park .012, an open scene seen through its own sky .1 and more."""

_OWN = 12.0
"""A scene of few Gaussians is as sharp as they are large: this many times their median is sharp as well.
Measured without fog: 4 in an object, 9 and 12 in its thinnings to 12,500 and 3,000 Gaussians."""

_SAMPLED = 16
"""Poses from around or above that are looked through: if three quarters are sharp, all are taken, if under a
quarter, none, else each is looked through."""


def plan_auto(
    site: Site, splats: Splats, count: int, lens: Lens, seed: int, tell: Callable[[int, int], None]
) -> tuple[Poses, list[str], str]:
    """At most `count` poses, the kinds they are of, and why.

    Nothing is decided for the scene as a whole: what lies within rooms is seen from within, in proportion;
    the others stand around or above the scene as its shape allows, as far as it is in focus from there; what
    is then missing stands on the ground and wherever the scene is in focus.
    """
    parts: dict[str, Poses] = {}
    inside = find_inside(site, seed)
    share = float(np.clip((inside.share - _SOME_INSIDE) / (_ALL_INSIDE - _SOME_INSIDE), 0, 1))
    why = [f"{inside.share:.1%} of its box lies within rooms"]

    def missing() -> int:
        return count - sum(len(part) for part in parts.values())

    def add(kind: str, poses: Poses) -> None:
        if len(poses):
            parts[kind] = poses if kind not in parts else Poses.joined([parts[kind], poses])

    add("inside", plan_inside(site, inside, round(share * count), lens, seed, tell))
    if missing():
        shape, shape_why = shape_of(site)
        why.append(f"{shape}: {shape_why}")
        if shape != "object":
            part = _STREET if shape == "landscape" else 1.0
            indoors = shape == "room"
            add("walk", plan_walk(site, round(part * missing()), lens, seed, tell, indoors=indoors))
        glance = Glance(splats)
        kind = "aerial" if shape == "landscape" else "orbit"
        _add_far(site, glance, kind, missing(), lens, seed, tell, add, why)
    if missing():
        add("walk", plan_walk(site, missing() // 2, lens, seed + 1, tell, indoors=False))
        add("focus", plan_focus(site, glance, missing(), lens, seed, tell)[0])
    for kind in ("aerial", "orbit"):  # better a view through fog than none
        if missing():
            plan = plan_aerial if kind == "aerial" else plan_orbit
            add(kind, plan(site, missing(), lens, seed + 1, tell))
    none = Poses(np.zeros((0, 3)), np.zeros((0, 3)))
    return Poses.joined([none, *parts.values()]).take(slice(count)), list(parts), "; ".join(why)


def _add_far(
    site: Site,
    glance: Glance,
    kind: str,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
    add: Callable[[str, Poses], None],
    why: list[str],
) -> None:
    """Poses around or above, those that are sharp."""
    plan = plan_aerial if kind == "aerial" else plan_orbit
    poses = plan(site, count, lens, seed, tell)
    if not len(poses):
        return
    some = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _SAMPLED)).round().astype(int))
    sharp = _sharp(site, glance, poses.take(some), lens, tell)
    if sharp.mean() < 0.25:
        poses = poses.take(slice(0))
    elif sharp.mean() < 0.75:
        poses = poses.take(_sharp(site, glance, poses, lens, tell))
    if sharp.mean() < 0.75:
        why.append(f"{sharp.mean():.0%} of the {kind} poses see it in focus")
    add(kind, poses)


def _sharp(
    site: Site, glance: Glance, poses: Poses, lens: Lens, tell: Callable[[int, int], None]
) -> NDArray[np.bool_]:
    """Whether poses see the scene in focus; what stands behind all of it does not count."""
    away = norms(poses.eyes - site.box.mean(axis=0))
    reach = away + norms(site.box[1:] - site.box[:1]) / 2
    own = middle(site.grid.scale_at(site.points))  # by count: a sky is few rows and much area
    coarse = glance.of(poses.cameras(site, lens), tell, site.size * reach).coarse
    return coarse < np.maximum(_SHARP, _OWN * own / np.maximum(away, np.finfo(float).tiny))
