"""Poses in free space within a scene: through rooms, along streets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.gather import gather
from g2ard.poses.lattice import fibonacci, halton
from g2ard.poses.sight import Lens, Poses, view_statistics
from g2ard.poses.site import Site

Floats = NDArray[np.float64]

_PITCHES = (-25.0, 10.0)
"""Range of gaze pitches, in degrees above the horizon."""

_HEIGHTS = {True: (0.35, 0.75), False: (0.2, 0.6)}
"""Range of eye heights above the ground: indoors in heights of the room, outdoors in `Site.tallness`."""

_SKY = 0.25
"""Least share of the sky that is open outdoors; with less, the place is inside a hollow building."""

_TRIES = (512, 2048)
"""Least and most places tried; if poses outnumber the free places, they share them and look elsewhere."""

_THINGS = 0.12
"""Least share of the frame outdoors that shows what stands on the ground, for the full score."""

_HALLS = 0.15
"""Least share of all places in a connected group that is kept; smaller groups are hollows."""


def plan_walk(
    site: Site, count: int, lens: Lens, seed: int, tell: Callable[[int, int], None], *, indoors: bool
) -> Poses:
    """Plan at most `count` poses at eye height in connected free space, gazing all around.

    Gazes into a near wall or leaves, or out of the scene, are dropped.
    """
    room = _clearance(site, indoors)
    far = 0.4 * min(site.box[1, :2] - site.box[0, :2]) if indoors else 0.6 * site.tallness
    places = _places(site, int(np.clip(4 * count, *_TRIES)), seed, room, indoors)
    if not len(places):
        return Poses(np.zeros((0, 3)), np.zeros((0, 3)))

    def propose(start: int, stop: int) -> Poses:
        turn, pitch = halton(start, stop, 2, seed + 1).T
        around = 2 * np.pi * turn
        rise = np.radians(_PITCHES[0] + (_PITCHES[1] - _PITCHES[0]) * pitch)
        gazes = np.stack([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)], axis=1)
        return Poses(places[np.arange(start, stop) % len(places)], gazes)

    def judge(poses: Poses) -> Floats:
        seen = view_statistics(site, poses, lens)
        covered = seen.covered / (0.8 if indoors else 0.5)
        limits = [covered, seen.close / (2 * room), seen.median / far]
        return np.min(limits if indoors else [*limits, seen.standing / _THINGS], axis=0)

    return gather(count, propose, judge, tell)


def enclosed(site: Site, points: Floats) -> Floats:
    """Return (M,) shares of the directions, from straight down to 30° above the horizon, that meet matter."""
    return _met(site, points, fibonacci(64, low=-1.0, high=0.5))


def _met(site: Site, points: Floats, directions: Floats) -> Floats:
    eyes = np.repeat(points, len(directions), axis=0)
    hits = site.grid.cast(eyes, np.tile(directions, (len(points), 1)))
    return np.isfinite(hits).reshape(len(points), -1).mean(axis=1)


def _clearance(site: Site, indoors: bool) -> float:
    tall = float(site.box[1, 2] - site.box[0, 2]) if indoors else site.tallness
    return max(2 * site.grid.cell, 0.06 * tall)


def _places(site: Site, tries: int, seed: int, room: float, indoors: bool) -> Floats:
    """Return (K, 3) free places at eye height that lines of sight connect to many others, step by step."""
    box = site.box
    at = halton(0, tries, 3, seed)
    points = box[0] + (box[1] - box[0]) * at
    low, high = _HEIGHTS[indoors]
    tall = float(box[1, 2] - box[0, 2]) if indoors else site.tallness
    points[:, 2] = site.ground(points) + tall * (low + (high - low) * at[:, 2])
    points = points[site.grid.distance(points) > room]
    if not len(points):
        return points
    if indoors:
        points = points[enclosed(site, points) > 0.7]
    else:
        points = points[_met(site, points, fibonacci(32, low=0.5, high=1.0)) < 1 - _SKY]
        points = points[_met(site, points, fibonacci(16, low=-1.0, high=-0.8)) > 0.8]
    return points[_together(site, points)] if len(points) else points


def _together(site: Site, points: Floats) -> NDArray[np.bool_]:
    """Return whether each point belongs to a large part of the graph that joins neighbours in sight."""
    count = len(points)
    apart = sum((column[:, None] - column) ** 2 for column in points.T)
    near = np.argsort(apart, axis=1, kind="stable")[:, 1:13]
    start, stop = np.repeat(np.arange(count), near.shape[1]), near.ravel()
    ways = points[stop] - points[start]
    lengths = np.linalg.norm(ways, axis=1)
    safe = np.where(lengths > 0, lengths, 1.0)
    seen = site.grid.cast(points[start], ways / safe[:, None]) >= lengths
    start, stop = start[seen], stop[seen]
    label = np.arange(count)
    while True:
        low = label.copy()
        np.minimum.at(low, start, label[stop])
        np.minimum.at(low, stop, label[start])
        low = low[low]
        if (low == label).all():
            break
        label = low
    return np.bincount(label, minlength=count)[label] >= max(2.0, _HALLS * count)
