"""Representative views of a scene: where a person would stand to show it to others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Float32
from g2ard.errors import InputError
from g2ard.poses.outside import circle, ring
from g2ard.poses.sight import Lens, Poses, Survey
from g2ard.poses.site import Site
from g2ard.poses.within import WIDE, closed, is_room, plan_inside, plan_sharp, plan_walk
from g2ard.scene.cameras import Cameras
from g2ard.scene.reproducible import around, between, canonical_order, halton, turned
from g2ard.scene.samples import take_evenly
from g2ard.scene.splats import Splats

_ROWS = 150_000
"""Gaussians that places are planned on, and that small pictures show."""

_RISES = (12.0, 26.0, 40.0)
"""Degrees above the horizon of views from around."""

_TURNS = 12
"""Number of views from around at each of these heights."""

_STANDING = 32
"""Views within the scene that each planner proposes."""

_GAZES = (-0.35, 0.15)
"""Heights of the unit gazes of these views: people look ahead."""

_PLACES = 256
"""Places that tell whether there is a ceiling."""

_ROOFED = 0.25
"""Share of the free places with matter above in most directions that a ceiling needs."""

_WALLED = 0.8
"""Share of the directions near the level that meet matter between walls."""

_HORIZON = 0.1
"""Largest slope of these directions, up and down."""

_HEIGHTS = (0.2, 0.6)
"""Range of heights of places, in heights of what stands on the ground."""

_FINER = 0.5
"""Votes for views from around, relative to those for places between walls, below which a scene without a roof
is shown from within."""

_PHOTOS = 64
"""Photos that are judged, at most."""

_OPEN = 0.8
"""Share of what all views see that those from around see together, above which a scene is shown from around.
Measured: objects and maps above .96, rooms and a hall .60 to .66, an open scene under its own sky .97."""

_CRISP = 0.6
"""Mean share of what views from around show that is sharp, above which a scene is shown from around.
Measured: objects and maps above .99, an open scene under its own sky .47."""

_GOOD = 0.4
"""Least clearness of a view within a scene that counts."""

_LEAST = 0.05
"""Clearness that all views have, so that a coarse scene has some."""

_AGAIN = 0.1
"""Worth of seeing again what an earlier view shows."""

_APART = 60.0
"""Degrees between views that are different."""

_MIDDLE = 0.35
"""Width of the middle of photos, in halves of the image."""

_EDGE = 0.15
"""Width of the margin of photos, in halves of the image."""

_UNCUT = 8.0
"""Power of the share of the subject that is within the margin."""

_GAP = np.pi / 2
"""Angle without photos, radians, that a turn does not enter."""

_FULL = 4.0
"""Power of the covered share of the frame that counts in views within a scene."""

_CLEAR = 0.5
"""Least clearness of a view, relative to the clearest."""


@dataclass(frozen=True, eq=False)
class Outlook:
    """Figures of V views of a scene's subject: its Gaussians within the site's box.

    Args:
        cameras: the views.
        seen: (V, N) share of the subject's opacity that each view sees at each of N Gaussians.
        clear: (V,) share of the image that shows Gaussians under 0.03 rad, times a power of the share that is
            not empty.
        detail: (V,) mean difference of neighbouring pixels.
        spread: (V,) standard deviation of the colours: fronts are more colourful than backs.
    """

    cameras: Cameras
    seen: Float32
    clear: Float
    detail: Float
    spread: Float

    @classmethod
    def of(
        cls,
        survey: Survey,
        cameras: Cameras,
        full: float = -1.0,
    ) -> Outlook:
        """Look through the views, whose covered share to the power of `full` counts."""
        glance = survey.outlook
        within = survey.site.encloses(survey.site.localize(glance.points))
        mass = glance.opacities * within
        covered, sharp, detail, spread, seen = glance.sights(cameras)
        seen *= (mass / max(float(mass.sum()), 1e-9)).astype(np.float32)
        clear = sharp * np.maximum(covered, 1e-9) ** full
        return cls(cameras, seen, clear, detail, spread)


def _look_from_outside(survey: Survey, every: int = 1) -> Outlook:
    """Return views from around a scene, which show it whole; there are fewer if `every` is more than 1."""
    return Outlook.of(survey, survey.cameras(ring(survey, _RISES, _TURNS // every)))


def _look_from_within(survey: Survey, every: int = 1) -> Outlook:
    """Return views at eye level within a scene; there are fewer if `every` is more than 1."""
    wide = replace(survey, lens=Lens(survey.lens.size, WIDE))
    count = _STANDING // every
    poses = Poses.joined(
        [
            plan_inside(wide, count),
            plan_walk(wide, count),
            plan_sharp(wide, count),
        ]
    )
    pitch = poses.gazes[:, 2]
    lowest, highest = _GAZES
    level = poses.take((pitch > lowest) & (pitch < highest))
    return Outlook.of(survey, wide.cameras(level), _FULL)


def is_hidden(survey: Survey) -> bool:
    """Return whether views from around see little of what clear views within do, as above a ceiling, or show
    below a pixel what walls surround."""
    if is_walled(survey):
        return True
    return _is_roofed(survey) and _sees_less(
        _look_from_outside(survey, 2), _look_from_within(survey, 2)
    )


def _is_roofed(survey: Survey) -> bool:
    """Return whether many free places have matter above. Without a ground, a closed shell is an object."""
    site = survey.site
    if site.terrain is None:
        return False
    places = between(site.box, halton(0, _PLACES, 3, 0))
    places = places[site.is_free(places, 2)]
    above = closed(site, places, 16, 0.5, 1.0)
    return bool((above > 0.5).sum() > _ROOFED * len(above))


def is_walled(survey: Survey) -> bool:
    """Return whether most free places at eye height lie between walls, and resolve far more than views from
    around, as in a hall without a roof."""
    site = survey.site
    if site.terrain is None:
        return False
    at = halton(0, _PLACES, 3, 1)
    heights = site.tallness * between(_HEIGHTS, at[:, 2])
    places = site.place_at(at, heights)
    places = places[site.is_free(places, 2)]
    walled = closed(site, places, 24, -_HORIZON, _HORIZON)
    within = places[walled > _WALLED]
    if len(within) <= len(places) / 2:
        return False
    eyes = ring(survey, _RISES[1:2], _TURNS).eyes
    if not len(eyes):
        return False
    votes = survey.votes
    return bool(votes.at(eyes).mean() < _FINER * votes.at(within).mean())


def _sees_less(around: Outlook, within: Outlook) -> bool:
    seen = around.seen.max(axis=0, initial=0.0)
    seen_within = within.seen[within.clear > _GOOD].max(axis=0, initial=0.0)
    both = np.maximum(seen, seen_within)
    return bool(seen.sum(dtype=np.float64) < _OPEN * both.sum(dtype=np.float64))


def _plan_looks(survey: Survey) -> tuple[Outlook, str]:
    """Return views that show a scene "within" it, planned only if it may be shown so, or from "around"."""
    around = _look_from_outside(survey)
    blurred = around.clear.sum() <= _CRISP * len(around.cameras)
    room = is_room(survey) or (not blurred and is_walled(survey))
    if not (room or blurred or _is_roofed(survey)):
        return around, "around"
    within = _look_from_within(survey)
    if not len(within.cameras):
        return around, "around"
    good = within.clear.max(initial=0.0) > _GOOD
    if room or (good and (blurred or _sees_less(around, within))):
        return within, "within"
    return around, "around"


def best_views(
    splats: Splats,
    count: int = 1,
    cameras: Cameras | None = None,
    *,
    size: tuple[int, int] = (800, 600),
    axis: ArrayLike | None = None,
) -> Cameras:
    """Return at most `count` views that show a scene best, the best first, each different from those before.

    Objects and maps are shown whole, from around and somewhat above. What a ceiling hides, or a sky blurs, is
    shown from within, at eye level.

    Args:
        splats: the scene.
        cameras: views to choose from, such as photos'; None places views.
        size: width and height of placed views, pixels.
        axis: (3,) direction away from the ground; None estimates it.

    Raises:
        InputError: nothing in the scene is visible, or no free place sees it.
    """
    cameras = cameras and cameras.usual()
    if cameras is not None and len(cameras) == 1:
        return cameras
    return _find_best(_create_survey(splats, size, axis), count, cameras)[0]


def turntable(
    splats: Splats,
    count: int,
    cameras: Cameras | None = None,
    *,
    size: tuple[int, int] = (800, 600),
    axis: ArrayLike | None = None,
) -> tuple[Cameras, Float]:
    """Return views at equal angles that begin with the best one, and the up direction.

    Scenes that are shown from around turn as a whole. Within a scene, the camera turns in place. Photos turn
    around what the best one has in the middle, to and fro if none are on one side.

    Args and Raises: as `best_views`.
    """
    survey = _create_survey(splats, size, axis)
    best, kind = _find_best(survey, 1, cameras and cameras.usual())
    site = survey.site
    first = best[0]
    eye = site.localize(first.position)
    gaze = best.forwards[0] @ site.axes.T
    angles = 2 * np.pi * np.arange(count) / count
    away = 0.0  # from the eye to the axis of the turn
    if kind == "photos":
        assert cameras is not None
        away = _measure_subject_distance(survey, best)
        eyes = (cameras.positions - site.origin) / site.size
        offsets = turned(eyes, site.axes) - (eye + away * gaze)
        photo_angles = np.arctan2(offsets[:, 1], offsets[:, 0])
        first_angle = np.arctan2(-gaze[1], -gaze[0])
        angles = _turn_within_arc(angles, photo_angles - first_angle)
    gazes = around(gaze, angles)
    if kind == "around":
        poses = circle(survey, gazes)
    else:
        poses = Poses(eye + away * (gaze - gazes), gazes)
    across = first.width / first.K[0, 0]
    down = first.height / first.K[1, 1]
    half = max(across, down * size[0] / size[1]) / 2  # tangent of half the field of view
    half_angle = np.degrees(np.arctan(half))
    lens = Lens(size, 2 * float(half_angle))
    views = replace(survey, lens=lens).cameras(poses)
    names = tuple(f"{i:04d}" for i in range(count))
    return replace(views, names=names), site.axes[2]


def _measure_subject_distance(survey: Survey, best: Cameras) -> float:
    """Return the median depth of what the first view has in the middle, in site units; 0 without any."""
    first = best[0]
    points = survey.outlook.points
    middle = points[first.outward(points) < _MIDDLE]
    if not len(middle):
        return 0.0
    depths = (middle - first.position) @ best.forwards[0]
    return float(np.median(depths)) / survey.site.size


def _turn_within_arc(angles: Float, seen: Float) -> Float:
    """Turn full circles into swings that begin at 0 and keep to the `seen` angles, if these leave a gap.

    >>> _turn_within_arc(np.radians([0, 90, 180, 270]), np.radians([0, 60, -30])).round(3).tolist()
    [0.0, 1.047, 0.0, -0.524]
    """
    order = np.sort(np.append(seen % (2 * np.pi), 0.0))
    gaps = np.diff(order, append=2 * np.pi)
    widest = np.argmax(gaps)
    if gaps[widest] < _GAP:
        return angles
    high = order[widest]
    low = high + gaps[widest] - 2 * np.pi
    swing = np.sin(angles)
    return np.where(swing > 0, high, -low) * swing


def _create_survey(splats: Splats, size: tuple[int, int], axis: ArrayLike | None) -> Survey:
    rows = splats.visible_rows()
    some = splats.take(rows[canonical_order(splats, rows, _ROWS)])
    represents = len(rows) / max(1, len(some))
    if len(some):
        some = some.take(some.finite_rows())
    return Survey(some, represents, Site.of(some, axis, None, represents), Lens(size))


def _find_best(survey: Survey, count: int, cameras: Cameras | None) -> tuple[Cameras, str]:
    """Return the best views, and where they are: "photos", "within" or "around"."""
    if cameras is not None:
        look = Outlook.of(survey, take_evenly(cameras, _PHOTOS))
        worth = look.detail * _measure_wholeness(survey, look)
        return look.cameras.take(_choose(look, worth, count)), "photos"
    look, kind = _plan_looks(survey)
    if kind == "within":
        worth = look.detail
    else:
        worth = look.detail * look.spread
    found = look.cameras.take(_choose(look, worth, count))
    if not len(found):
        raise InputError("no free place has a view of the scene; give views")
    names = tuple(f"view_{i:04d}" for i in range(len(found)))
    return replace(found, names=names), kind


def _measure_wholeness(survey: Survey, look: Outlook) -> Float:
    """Return (V,) how much photos show of their subject, which most have in the middle, and how whole."""
    points = survey.outlook.points
    # From 0 in the middle of the image to 1 at its edge, (V, N).
    outward = np.stack([camera.outward(points) for camera in look.cameras])
    centrality = np.exp(-np.square(outward / _MIDDLE) / 2)
    middle = (look.seen * centrality).mean(axis=0)
    most_seen = np.maximum(look.seen.max(axis=0), 1e-30)
    share = np.sqrt(middle / most_seen)  # of the subject, per Gaussian
    shown = (look.seen * share).sum(axis=1)
    shown /= max(shown.max(), 1e-30)
    uncut = np.clip((1 - outward) / _EDGE, 0, 1)
    subject = middle * share
    within = (uncut * middle * share).sum(axis=1)
    within /= max(subject.sum(), 1e-30)
    return shown * within**_UNCUT


def _choose(look: Outlook, worth: Float, count: int) -> list[int]:
    """Return clear views in order of what they add, times their worth."""
    clear = look.clear + _LEAST
    is_clear = clear >= _CLEAR * clear.max(initial=0)
    worth = np.where(is_clear, worth * clear, 0.0)
    total = look.seen.sum(axis=1, dtype=np.float64)
    forwards = look.cameras.forwards
    least = np.full(len(total), np.inf)  # degrees to the nearest chosen view
    union = np.zeros_like(look.seen[:1])
    chosen: list[int] = []
    while len(chosen) < min(count, len(total)):
        new = np.maximum(look.seen - union, 0).sum(axis=1, dtype=np.float64)
        value = worth * (new + _AGAIN * total)
        value *= np.minimum(1, least / _APART)
        best = int(np.argmax(value))
        if not value[best] > 0:
            break
        chosen.append(best)
        union = np.maximum(union, look.seen[best])
        cosines = np.clip(forwards @ forwards[best], -1, 1)
        least = np.minimum(least, np.degrees(np.arccos(cosines)))
        worth[best] = 0
    if not chosen and len(total):
        return [0]
    return chosen
