"""Poses outside: on a dome around an object, and above a wide scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from g2ard.arrays import Float
from g2ard.poses.sight import Lens, Poses, Rays, Survey, gather
from g2ard.poses.site import Site
from g2ard.scene.reproducible import (
    between,
    directions,
    directions_at,
    halton,
    norms,
    quantile,
    turned,
)
from g2ard.scene.samples import evenly_spaced

_ELEVATIONS = (-5.0, 50.0)
"""Range of views around an object: degrees above the horizon of its centre."""

_DISTANCES = (0.9, 1.25)
"""Range of their distances, as multiples of that at which the object just fits."""

_FITTING = 0.97
"""Share of the matter in frame when the object just fits."""

_OUTLINE = 8_000
"""Points that represent an object's outline."""

_FILLED = 0.9
"""Share of the frame that a view of the whole fills."""

_WHOLE = 0.998
"""Share of the matter that is the whole."""

_ROUNDS = 6
"""Steps in which a view of the whole finds its place."""

_NEAREST = 1e-9
"""Least distance of a point in front of a view that is fitted, in scene sizes."""

_FITTED = 24
"""Poses of a circle that are fitted, at most."""

_BELOW_SKY = 0.8
"""Largest distance of a pose from the centre, in distances to the sky."""

_OUTSIDE = 1.2
"""Least distance from the centre: everything lies within about 1 of it."""

_LOWEST = 0.02
"""Least height of a pose above the ground, in scene sizes."""

_CLEAR_CELLS = 4
"""Least number of free cells in front of a pose."""

_NADIR = 0.4
"""Share of the poses above a scene that look straight down."""

_PITCHES = (30.0, 65.0)
"""Range of the other poses' gazes in degrees below the horizon."""

_OVERLAP = 5.0
"""Nadir images that show the same spot of ground, as in drone surveys."""

_INSET = 0.1
"""Margin that no pose aims at, as a share of the scene's sides: frames there would show the outside."""

_LEAST_HEIGHT = 0.85
"""Smallest factor on the height of a pose."""

_HEIGHT_RANGE = 0.3
"""Range of this factor, so that poses see at several scales."""

_ABOVE = 1.3
"""Least height, as a multiple of the height of what stands on the ground."""

_CLEAR = 0.3
"""Share of the height that must be free in front of a pose for the full score."""

_COVERED = 0.75
"""Share of the frame that is covered for the full score."""


def plan_orbit(
    survey: Survey,
    count: int,
    shift: int = 0,
    first: int | None = None,
) -> Poses:
    """Plan at most `count` poses around the centre of the matter, spread evenly over a dome.

    Each is as near as the object fits the frame. Poses below the ground, in matter or close to it are
    dropped. The others see the object, because it fills their frame. `first` is a second limit on the number.
    """
    site = survey.site
    target = site.box.mean(axis=0)
    farthest = _BELOW_SKY * site.horizon - norms((target - site.centre)[None])
    heights = np.sin(np.radians(_ELEVATIONS))

    def tried(start: int, stop: int) -> tuple[Poses, Float]:
        turn, rise, chance = halton(start, stop, 3, survey.seed + shift).T
        z = between(heights, rise)
        outward = directions(turn, np.sqrt(1 - z * z), z)
        fitting = _fit_distances(site, target, outward, survey.lens)
        distances = fitting * between(_DISTANCES, chance)
        distances = np.minimum(distances, farthest)
        poses = Poses(target + distances[:, None] * outward, -outward)
        free = site.is_free(poses.eyes, 2, _LOWEST)
        free &= Rays(survey, poses).close > _CLEAR_CELLS * site.grid.cell
        return poses, free.astype(float)

    return gather(survey, count if first is None else min(first, count), tried)


def _fit_distances(
    site: Site,
    target: Float,
    outward: Float,
    lens: Lens,
) -> Float:
    """Return (P,) distances at which `_FITTING` of the matter is in frame, and all of it ahead."""
    points = site.points[:_OUTLINE] - target
    weights = site.weights[:_OUTLINE]
    wide, tall = lens.tangents
    distances = np.empty(len(outward))
    for i, frame in enumerate(Poses(outward, -outward).frames()):
        x, y, z = turned(points, frame).T
        # least depths that hold the points
        depths = np.maximum(
            np.abs(x) / wide,
            np.abs(y) / tall,
        )
        distances[i] = quantile(depths - z, weights, _FITTING)
    return np.maximum(distances, _OUTSIDE)


def ring(survey: Survey, rises: Sequence[float], turns: int) -> Poses:
    """Return poses all around a scene at some degrees above its horizon, with all of it just in frame.

    Poses in matter are dropped.
    """
    site = survey.site
    points = site.points[:_OUTLINE]
    rise, turn = np.meshgrid(
        np.radians(rises),
        np.arange(turns) / turns,
    )
    gazes = -directions_at(turn.ravel(), rise.ravel())
    eyes = np.empty_like(gazes)
    for i, frame in enumerate(Poses(gazes, gazes).frames()):
        eye = _fit_eye(survey, turned(points, frame))
        eyes[i] = eye @ frame
    free = site.is_free(eyes, 2, _LOWEST)
    return Poses(eyes, gazes).take(free)


def _fit_eye(survey: Survey, points: Float) -> Float:
    """Return the (3,) eye of a view that just holds points right, down and ahead, in these directions.

    In turns, it aims at the middle of what the frame shows, and stands as near as it fits.
    """
    weights = survey.site.weights[:_OUTLINE]
    x, y, z = points.T
    eye = np.zeros(3)
    for _ in range(_ROUNDS):
        away = _measure_away(survey, x - eye[0], y - eye[1]) - z
        eye[2] = -quantile(away, weights, _WHOLE)
        ahead = np.flatnonzero(away <= -eye[2])
        depths = z[ahead] - eye[2]
        depths = np.maximum(depths, _NEAREST)
        for axis, across in ((0, x), (1, y)):
            slopes = (across[ahead] - eye[axis]) / depths
            eye[axis] -= eye[2] * (slopes.max() + slopes.min()) / 2
    return eye


def _measure_away(survey: Survey, x: Float, y: Float) -> Float:
    """Return the distances from which points (x, y) off the line of sight, and the body of a Gaussian around
    them, are in frame."""
    body = survey.site.body
    wide, tall = np.array(survey.lens.tangents) * _FILLED
    depths = np.maximum(
        (np.abs(x) + body) / wide,
        (np.abs(y) + body) / tall,
    )
    return depths + body


def circle(survey: Survey, gazes: Float) -> Poses:
    """Return poses on a level circle around a scene, with all of it just in frame.

    In turns, they aim at the middle of what the frames show, and stand as near as it fits all of them.
    """
    target = survey.site.box.mean(axis=0)
    points = survey.site.points[:_OUTLINE] - target
    weights = survey.site.weights[:_OUTLINE]
    frames = Poses(gazes, gazes).frames()
    seen = [turned(points, frames[i]).T for i in evenly_spaced(len(gazes), _FITTED)]
    away = 0.0
    down = 0.0
    for _ in range(_ROUNDS):
        needed = [_measure_away(survey, x, y - down) - z for x, y, z in seen]
        away = max(float(quantile(distances, weights, _WHOLE)) for distances in needed)
        slopes = []
        for (_, y, z), distances in zip(seen, needed, strict=True):
            depth = np.maximum(z + away, _NEAREST)
            slope = (y - down) / depth
            slopes.append(slope[distances <= away])
        all_slopes = np.concatenate(slopes)
        down += away * (all_slopes.max() + all_slopes.min()) / 2
    return Poses(target + down * frames[:, 1] - away * gazes, gazes)


def plan_aerial(
    survey: Survey,
    count: int,
    shift: int = 0,
    first: int | None = None,
) -> Poses:
    """Plan at most `count` poses above everything, their footprints spread evenly over the scene.

    Some look straight down and the others obliquely to all sides. The height follows from `count`: few poses
    see much each, many see detail. Poses in matter or close to it are dropped, and poses with at least three
    quarters of the frame covered are preferred. `first` limits the number without changing the height.
    """
    site = survey.site
    height = _choose_height(site, count, survey.lens)
    low = site.box[0] + _INSET * site.sides
    sides = site.sides - 2 * (_INSET * site.sides)

    def tried(start: int, stop: int) -> tuple[Poses, Float]:
        x, y, kind, turn, pitch, chance = halton(start, stop, 6, survey.seed + shift).T
        spots = low + sides * np.stack([x, y, x], axis=1)
        spots[:, 2] = site.ground(spots)
        nadir = kind < _NADIR
        oblique = np.radians(between(_PITCHES, pitch))
        down = np.where(nadir, np.pi / 2, oblique)
        level = np.where(nadir, 0.0, np.cos(down))
        gazes = directions(turn, level, -np.sin(down))
        away = height * (_LEAST_HEIGHT + _HEIGHT_RANGE * chance)
        away /= np.sqrt(np.sin(down))
        poses = Poses(spots - away[:, None] * gazes, gazes)
        seen = Rays(survey, poses)
        clear = site.is_free(poses.eyes, 3, 0.0)
        clear &= seen.close > _CLEAR * height
        scores = np.where(clear, seen.covered / _COVERED, 0.0)
        return poses, scores

    return gather(survey, count if first is None else min(first, count), tried)


def _choose_height(site: Site, count: int, lens: Lens) -> float:
    """Return the height above the ground at which each spot lies in `_OVERLAP` nadir frames.

    It is at most the height from which one frame spans the scene, and always above what stands on the ground.
    """
    wide, tall = lens.tangents
    x_side, y_side = site.sides[:2]
    nadir_views = max(1.0, _NADIR * count)
    # A frame from height h covers 4 h² wide·tall of the ground.
    covered = nadir_views * 4 * wide * tall
    by_count = np.sqrt(_OVERLAP * x_side * y_side / covered)
    fits = min(x_side, y_side) / (2 * min(wide, tall))
    highest = min(by_count, fits)
    return float(max(highest, _ABOVE * site.tallness))
