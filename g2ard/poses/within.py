"""Poses within a scene: in its rooms, at eye height, wherever it looks sharp, and near to anything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from g2ard.arrays import Float, Int, Mask
from g2ard.poses.sight import SIGHT_ROWS, Glance, Poses, Rays, Survey, gather
from g2ard.poses.site import Site
from g2ard.scene.reproducible import (
    between,
    directions_at,
    fibonacci,
    halton,
    joined,
    normalized,
    norms,
    turned,
)


@dataclass(frozen=True, eq=False)
class Reach:
    """The nearest pose that sees each of K points.

    Args:
        nearest: (K,) indices of the poses, −1 if none sees the point.
        distances: (K,) distances from them, inf if none sees the point.
        coarse: (K,) whether a point is seen, but with a standard deviation below a pixel.
    """

    nearest: Int
    distances: Float
    coarse: Mask


_ROOM_PITCHES = (-0.3, 0.2)
"""Range of gaze pitches above the horizon in rooms, in radians."""

_WALK_PITCHES = (-25.0, 10.0)
"""Range of gaze pitches of walks, in degrees."""

_SHARP_PITCHES = (-35.0, 20.0)
"""Range of gaze pitches of sharp poses, in degrees."""

_EYES = {True: (0.35, 0.75), False: (0.2, 0.6)}
"""Range of eye heights above the ground: indoors in heights of the room, outdoors in `Site.tallness`."""

_UNDER_A_DOME = (0.1, 0.5)
"""The same below a ceiling that is no room's, in its height: it may be much higher than people."""

WIDE = 70.0
"""Horizontal field of view in degrees: within a scene people use wider lenses."""

_MOSTLY_INSIDE = 0.5
"""Share of a pool within rooms above which the scene is a room."""

_WIDE = 0.25
"""Share of the places in rooms, those with most clearance, where half of the poses stand."""

_COVERED = 0.8
"""Share of the frame that is matter for the full score of a gaze in a room."""

_CLEAR_CELLS = 4
"""Free cells in front for that score."""

_TRIES = (512, 2048)
"""Least and most places tried; if poses outnumber the free ones, they share them."""

_WALLS = 0.7
"""Least share of the directions below and around that is matter indoors."""

_SKY = 0.25
"""Least share of the sky that is open outdoors, because with less the place is inside a hollow building."""

_FLOOR = 0.8
"""Least share of the ground below that is closed outdoors."""

_HALLS = 0.15
"""Least share of all places in a connected group that is kept; smaller groups are hollows. Without this test
taebak 0_4 loses .3 dB, and .6 dB in standing views."""

_FRAME = {True: 0.8, False: 0.5}
"""Share of the frame that is matter for the full score of a walk."""

_THINGS = 0.12
"""Share of the frame that stands on the ground for the full score of a walk outdoors."""

_FULL = (
    (0.8, 0.3, 1.0),
    (0.7, 0.2, 0.8),
    (0.5, 0.1, 0.6),
)
"""Shares of the image that the scene covers, and that detail covers, and the score of a pose that exceeds
both."""

_SHARP_PATIENCE = 8
"""Most candidates per requested sharp pose."""

_AIMED_PATIENCE = 64
"""Most candidates per requested pose anywhere."""

_DISTANCES = (0.04, 0.4)
"""Range of log-uniform distances from an aim, in diagonals of the scene's box."""

_RISES = (-5.0, 35.0)
"""Range of degrees from an aim up to the eye."""

_CLOSE = 0.5 * _DISTANCES[0]
"""Share of the diagonal within which matter is close: half of the least distance of an aim."""

_MURK = 0.08
"""Largest share of the image that shows close matter."""

_CLEAR = 0.35
"""Least transmittance in front of the aim."""

_SOLID = 0.3
"""Least opacity of Gaussians that a view may aim at."""

_SAMPLE = 512
"""Points that represent the scene's matter."""

_PIXELS = 1.5
"""Standard deviation in pixels with which a near pose shows its target."""

_STEP = (0.25, 0.6)
"""Range of its distance as a share of the original one."""

_JITTER = 0.2
"""Scale of the random offset between a gaze and its target, as a tangent, so that not every image has the
target in the middle."""

_LOWEST = 0.01
"""Least height of a near pose above the ground, in scene sizes."""


_OUTLOOKS = 8
"""Places that are tried for a view of what lies beyond the near matter."""


def is_room(survey: Survey) -> bool:
    """Return whether most of a pool stands within rooms."""
    return survey.inside.weight > _MOSTLY_INSIDE


def plan_inside(survey: Survey, count: int) -> Poses:
    """Plan at most `count` poses within rooms, gazing all around and near the horizon.

    Every second pose stands where there is most clearance. Gazes into a near wall, or out of the scene, are
    dropped.
    """
    places = survey.inside.places
    widest = max(1, int(_WIDE * len(places)))
    clear = _CLEAR_CELLS * survey.site.grid.cell

    def tried(start: int, stop: int) -> tuple[Poses, Float]:
        at, turn, pitch = halton(start, stop, 3, survey.seed + 1).T
        is_even = np.arange(start, stop) % 2 == 0
        choices = np.where(is_even, widest, len(places))
        rows = (at * choices).astype(int)
        gazes = directions_at(turn, between(_ROOM_PITCHES, pitch))
        poses = Poses(places[rows], gazes)
        seen = Rays(survey, poses)
        scores = np.minimum(
            seen.covered / _COVERED,
            seen.close / clear,
        )
        return poses, scores

    return gather(survey, count if len(places) else 0, tried)


def plan_walk(
    survey: Survey,
    count: int,
    shift: int = 0,
    *,
    indoors: bool | None = None,
) -> Poses:
    """Plan at most `count` poses at eye height in connected free space, gazing all around.

    Gazes into a near wall or leaves, or out of the scene, are dropped. `indoors`, places lie between walls;
    otherwise under an open sky. None means indoors if the scene is a room.
    """
    site = survey.site
    room_like = is_room(survey)
    if indoors is None:
        indoors = room_like
    if indoors:
        tall = site.sides[2]
        far = 0.4 * min(site.sides[:2])
    else:
        tall = site.tallness
        far = 0.6 * tall
    room = max(2 * site.grid.cell, 0.06 * tall)
    if indoors and not room_like:
        eyes = _UNDER_A_DOME
    else:
        eyes = _EYES[indoors]
    tries = int(np.clip(4 * count, *_TRIES))
    at = halton(0, tries, 3, survey.seed + shift)
    places = site.place_at(at, tall * between(eyes, at[:, 2]))
    places = places[site.is_free(places, room / site.grid.cell)]
    if indoors:
        walled = closed(site, places, 64, -1.0, 0.5)
        places = places[walled > _WALLS]
    else:
        covered = closed(site, places, 32, 0.5, 1.0)
        places = places[covered < 1 - _SKY]
        grounded = closed(site, places, 16, -1.0, -0.8)
        places = places[grounded > _FLOOR]
    places = places[_find_connected(site, places)]

    def tried(start: int, stop: int) -> tuple[Poses, Float]:
        turn, pitch = halton(start, stop, 2, survey.seed + shift + 1).T
        gazes = directions_at(turn, np.radians(between(_WALK_PITCHES, pitch)))
        rows = np.arange(start, stop) % len(places)
        poses = Poses(places[rows], gazes)
        seen = Rays(survey, poses)
        scores = [
            seen.covered / _FRAME[indoors],
            seen.close / (2 * room),
            seen.median / far,
        ]
        if not indoors:
            scores.append(seen.standing / _THINGS)
        return poses, np.min(scores, axis=0)

    return gather(survey, count if len(places) else 0, tried)


def closed(
    site: Site,
    points: Float,
    rays: int,
    low: float,
    high: float,
) -> Float:
    """Return (M,) shares of the directions between two heights on the sphere that meet matter."""
    directions = fibonacci(rays, low, high)
    distances = site.met(points, directions)
    return np.isfinite(distances).mean(axis=1)


def _find_connected(site: Site, points: Float) -> Mask:
    """Return whether each point belongs to a large part of the graph that joins neighbours in sight."""
    count = len(points)
    # of the distances, (M, M)
    squares = sum((column[:, None] - column) ** 2 for column in points.T)
    near = np.argsort(squares, axis=1, kind="stable")[:, 1:13]  # the first is the point itself
    start = np.repeat(np.arange(count), near.shape[1])
    stop = near.ravel()
    ways = points[stop] - points[start]
    lengths = np.linalg.norm(ways, axis=1)
    ways /= np.where(lengths > 0, lengths, 1.0)[:, None]
    in_sight = site.grid.cast(points[start], ways) >= lengths
    label = joined(np.arange(count), start[in_sight], stop[in_sight])
    sizes = np.bincount(label, minlength=count)
    return sizes[label] >= max(2.0, _HALLS * count)


def plan_sharp(survey: Survey, count: int, also: Poses | None = None) -> Poses:
    """Plan at most `count` poses in free space whose image is full and shows detail.

    A trained scene does so from where its photos were taken. `also` are poses to try first.
    """
    site = survey.site

    def tried(start: int, stop: int) -> tuple[Poses, Float]:
        *at, turn, pitch = halton(2 * start, 2 * stop, 5, survey.seed + 2).T
        points = between(site.box, np.stack(at, axis=1))
        gazes = directions_at(turn, np.radians(between(_SHARP_PITCHES, pitch)))
        poses = Poses(points, gazes).take(site.is_free(points, 3))
        close = Rays(survey, poses).close
        poses = poses.take(close > 4 * site.grid.cell)
        if also is not None and not start:
            poses = Poses.joined([also, poses])
        covered, fine, _ = survey.glance.of(survey.cameras(poses))
        scores = np.zeros(len(poses))
        for least_covered, least_fine, score in _FULL:
            exceeds = covered > least_covered
            exceeds &= fine > least_fine
            scores = np.maximum(scores, exceeds * score)
        return poses, scores

    return gather(survey, count, tried, patience=_SHARP_PATIENCE)


def plan_anywhere(survey: Survey, count: int) -> Poses:
    """Plan at most `count` poses with a clear line of sight to what they aim at, and nothing close.

    Aims are spread evenly over the scene's Gaussians, distances from 4 to 40 % of its diagonal. Rays in the
    grid reject most poses, and small renders the rest, because the grid knows neither floaters nor fog.
    """
    site = survey.site
    glance = Glance(survey.splats, survey.represents, SIGHT_ROWS)
    least, most = _DISTANCES
    least_distance = site.diagonal * least
    close = _CLOSE * site.diagonal * site.size
    points = site.localize(glance.points)
    solid = site.encloses(points)
    solid &= glance.opacities > _SOLID
    rows = np.flatnonzero(solid)

    def tried(start: int, stop: int) -> tuple[Poses, Float]:
        which, far, turn, rise = halton(start, stop, 4, survey.seed + 5).T
        aims = rows[(which * len(rows)).astype(int)]
        gazes = -directions_at(turn, np.radians(between(_RISES, rise)))
        distances = least_distance * (most / least) ** far
        poses = Poses(points[aims] - distances[:, None] * gazes, gazes)
        met = site.grid.cast(poses.eyes, gazes)
        free = met > distances - 2 * site.grid.cell
        poses = poses.take(free)
        transmittances = glance.clear(
            survey.cameras(poses),
            aims[free],
            close,
        )
        poses = poses.take(transmittances >= _CLEAR)
        murk = glance.murk(survey.cameras(poses), close)
        return poses, (murk <= _MURK).astype(float)

    return gather(survey, count if len(rows) else 0, tried, patience=_AIMED_PATIENCE)


def reach_of(survey: Survey, poses: Poses) -> Reach:
    """Find the nearest pose that sees each of the first points of the site."""
    site = survey.site
    points = site.points[:_SAMPLE]
    best = np.full(len(points), -1)
    nearest = np.full(len(points), np.inf)
    for i, frame in enumerate(poses.frames()):
        away = points - poses.eyes[i]
        x, y, z = (away @ frame.T).T
        length = norms(away)
        nearer = survey.lens.holds(x, y, z)
        nearer &= length < nearest
        rows = np.flatnonzero(nearer)
        eyes = np.repeat(poses.eyes[i : i + 1], len(rows), axis=0)
        met = site.grid.cast(eyes, away[rows] / length[rows, None])
        rows = rows[met > length[rows] - 2 * site.grid.cell]
        best[rows] = i
        nearest[rows] = length[rows]
    coarse = best >= 0
    coarse &= site.grid.scale_at(points) * survey.lens.focal < nearest
    return Reach(best, nearest, coarse)


def plan_near(
    survey: Survey,
    poses: Poses,
    reach: Reach,
    count: int,
    shift: int = 0,
) -> Poses:
    """Plan at most `count` poses between the given ones and points that they see.

    Each pose stands where its point has a standard deviation of 1.5 pixels, at 0.25–0.6 of the original
    distance. Up to half of the poses look at points that the given poses show smaller than a pixel.
    """
    site = survey.site
    chance = np.random.default_rng(survey.seed + shift)
    small = chance.permutation(np.flatnonzero(reach.coarse))[: count // 2]
    seen = np.flatnonzero(reach.nearest >= 0)
    others = chance.permutation(np.setdiff1d(seen, small))
    rows = np.concatenate([small, others])
    points = site.points[rows]
    wanted = site.grid.scale_at(points) * survey.lens.focal / _PIXELS  # distances
    share = np.clip(wanted / reach.distances[rows], *_STEP)
    ways = poses.eyes[reach.nearest[rows]] - points
    eyes = points + share[:, None] * ways
    gazes = normalized(points - eyes)
    right, up = halton(0, len(rows), 2, survey.seed + shift + 3).T
    jitter = np.stack(
        [
            right - 0.5,
            up - 0.5,
            right - up,
        ],
        axis=1,
    )
    gazes += _JITTER * jitter
    gazes /= norms(gazes)[:, None]
    near = Poses(eyes, gazes)
    near = near.take(site.is_free(eyes, 2, _LOWEST))
    near = near.take(Rays(survey, near).close > 2 * site.grid.cell)
    return near.take(slice(count))


def framed(survey: Survey, poses: Poses, points: Float) -> Mask:
    """Return (F,) whether any pose has each point in its frame."""
    found = np.zeros(len(points), bool)
    for eye, frame in zip(poses.eyes, poses.frames(), strict=True):
        x, y, z = turned(points - eye, frame).T
        found |= survey.lens.holds(x, y, z)
    return found


def plan_beyond(
    survey: Survey,
    poses: Poses,
    points: Float,
    count: int,
) -> Poses:
    """Plan at most `count` poses at the given places that look at points beyond the near matter.

    Each looks at a point that none before has in its frame, from where near matter hides little of the view.
    """
    chances = halton(0, max(1, count), 2, survey.seed + 6)
    missing = points
    found = Poses.joined([])
    for aim, place in chances[:count]:
        if not len(missing):
            missing = points
        first = int(place * len(poses))
        places = (np.arange(_OUTLOOKS) + first) % len(poses)
        eyes = poses.eyes[places]
        target = missing[int(aim * len(missing))]
        ways = target - eyes
        tried = Poses(eyes, ways / norms(ways)[:, None])
        covered = Rays(survey, tried).covered
        freest = np.argsort(covered, kind="stable")[:1]
        chosen = tried.take(freest)
        missing = missing[~framed(survey, chosen, missing)]
        found = Poses.joined([found, chosen])
    return found
