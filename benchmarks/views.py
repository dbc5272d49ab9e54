"""Views that no method sees, of other kinds than a pool's: close up, where people stand, from anywhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard import io
from g2ard.config.choices import Colour
from g2ard.errors import InputError
from g2ard.io.splits import for_scores
from g2ard.poses import plan_pool
from g2ard.poses.outside import plan_orbit
from g2ard.poses.sight import Lens, Poses, Rays, Survey
from g2ard.poses.site import Site
from g2ard.rendering.renderer import RasterSettings, arrays_of, view_of
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.reproducible import halton
from g2ard.scene.splats import Splats

__all__ = ["anywhere_views", "given_views", "hidden_targets", "standing_views"]

_SEED = 7919
"""Added to the seed of a pool, so that these poses differ from all poses that methods use."""

_POOL, _NEAR, _STANDING, _ANYWHERE = 128, 16, 24, 24
_FOV = 70.0
"""Degrees; a pool's poses have 50."""

_BETWEEN = (0.35, 0.8)
"""Range of the remaining share of the way to an object's surface, for poses between near and far."""

_SIZE, _TRIED = (800, 600), (200, 150)
"""Pixels of a view from anywhere and of the render that tests it."""

_DISTANCES, _RISES = (0.04, 0.4), (-5.0, 35.0)
"""Ranges of the eye's position around its aim: distance in scene diagonals (log-uniform), and degrees above
the horizon."""

_CLOSE = 0.02
"""Share of the diagonal within which nothing may give more than `_MURK` of the picture's light."""

_MURK, _CLEAR = 0.08, 0.35
"""Most light from what is close, and least mean transmittance in front of the aim."""

_ROWS = 200_000
"""Gaussians that tell which way is up."""

_PATIENCE = 40
"""Poses tried per view, at most."""


def hidden_targets(
    splats: Splats,
    scene: Path,
    kinds: tuple[str, ...],
    *,
    seed: int,
    size: int | None,
    background: Colour,
) -> dict[str, TeacherRenders]:
    """Return renders of the kinds "near", "standing" and "anywhere" that are requested and have room.

    Views are shrunk to `size`; those that show nothing of the scene are dropped.

    Raises:
        InputError: as `standing_views`.
    """
    views: dict[str, Cameras] = {}
    if "standing" in kinds:
        views |= standing_views(splats, scene, seed)
    if "anywhere" in kinds:
        views["anywhere"] = anywhere_views(splats, seed=seed)
    found = {}
    for kind, cameras in views.items():
        targets = TeacherRenders(splats, cameras.resized(size), background=background)
        shown = [bool(np.ptp(targets[view], axis=(0, 1)).any()) for view in range(len(cameras))]
        if not all(shown):
            cameras = targets.cameras.take(np.array(shown))
            targets = TeacherRenders(splats, cameras, background=background)
        if any(shown):
            found[kind] = targets
    return found


def standing_views(splats: Splats, scene: Path, seed: int = 0) -> dict[str, Cameras]:
    """Return views by kind, "near" and "standing"; kinds without room are missing.

    near: at most 16 views between poses of a pool and what those see. standing: the views of a standing.json
    beside the scene, otherwise 24 poses 70° wide. These lie between near and far for an object, at eye level
    for a landscape, and in a pool of their own for other scenes. All use another seed than the pools of
    methods.

    Raises:
        InputError: nothing is visible in the scene, or a standing.json is invalid.
    """
    pool = plan_pool(splats, _POOL, seed=seed + _SEED)
    near = pool.more("near", _NEAR)
    found = {"near": Cameras.of(near)} if near else {}
    given = given_views(scene)
    standing = given if given is not None else _standing(splats, pool.kind, seed + 2 * _SEED)
    return found if standing is None or not len(standing) else {**found, "standing": standing}


def given_views(scene: Path) -> Cameras | None:
    """Return the views of a standing.json in the scene's folder or its parent; None without one.

    Raises:
        InputError: the file is invalid.
    """
    folder = scene.absolute() if scene.is_dir() else scene.absolute().parent
    path = next(
        (p for place in (folder, folder.parent) if (p := place / "standing.json").is_file()), None
    )
    if path is None:
        return None
    found = io.read_view_set(path)
    return found.cameras.take(for_scores(path, found.cameras.names, found.splits))


def _standing(splats: Splats, kind: str, seed: int) -> Cameras | None:
    if kind == "orbit":
        return _between(splats, seed)
    for other in ("walk", "auto") if "aerial" in kind else ("auto",):
        try:
            cameras = plan_pool(splats, _STANDING, kind=other, fov=_FOV, seed=seed).cameras
        except InputError:
            continue
        return _named(cameras)
    return None


def _between(splats: Splats, seed: int) -> Cameras:
    """Return views in free space around an object, nearer than a pool and farther than near views."""
    survey = Survey(splats, 1.0, Site.of(splats), Lens(fov=_FOV), seed)
    site, far = survey.site, plan_orbit(survey, 4 * _STANDING)
    met = site.grid.cast(far.eyes, far.gazes)
    far, met = far.take(np.isfinite(met)), met[np.isfinite(met)]
    share = _BETWEEN[0] + (_BETWEEN[1] - _BETWEEN[0]) * halton(0, len(far), 1, seed)[:, 0]
    eyes = far.eyes + ((1 - share) * met)[:, None] * far.gazes
    free = site.is_free(eyes, 2, 0.01)
    poses = Poses(eyes[free], far.gazes[free])
    poses = poses.take(Rays(survey, poses).close > 2 * site.grid.cell)
    return _named(survey.cameras(poses.take(slice(_STANDING))))


def _named(cameras: Cameras) -> Cameras:
    return replace(cameras, names=tuple(name.replace("pose", "standing") for name in cameras.names))


def anywhere_views(splats: Splats, count: int = _ANYWHERE, seed: int = 0) -> Cameras:
    """Return views of random visible Gaussians from free places with a clear line of sight.

    There are fewer than `count` where few poses pass.

    Raises:
        InputError: nothing visible in the scene.
    """
    chance = np.random.default_rng(seed + 777)
    up = Site.of(splats, rows=_ROWS).vertical.axis
    means = splats.means.astype(np.float64) + splats.offset
    box = np.quantile(means[splats.opacities > 0.1], [0.02, 0.98], axis=0)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    inside = ((means > box[0]) & (means < box[1])).all(axis=1)
    rows = np.flatnonzero((splats.opacities > 0.3) & inside)
    level = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    level /= np.linalg.norm(level)
    frame = np.stack([level, np.cross(up, level), up])
    arrays, found = arrays_of(splats), []
    for _ in range(_PATIENCE * count if len(rows) else 0):
        row = int(rows[chance.integers(len(rows))])
        distance = diagonal * np.exp(chance.uniform(*np.log(_DISTANCES)))
        rise, turn = np.radians(chance.uniform(*_RISES)), chance.uniform(0, 2 * np.pi)
        outward = (
            np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
            @ frame
        )
        eye = means[row] + distance * outward
        view = look_at(eye, means[row], up)
        away = np.linalg.norm(means - eye, axis=1)
        if _is_clear(arrays, view, splats, row, away < _CLOSE * diagonal, 1e-3 * diagonal):
            found.append(view)
        if len(found) == count:
            break
    return _cameras(found, _SIZE)


def _is_clear(arrays: Any, view: Any, splats: Splats, row: int, close: Any, near: float) -> bool:
    """Return whether a small render shows the aim through little matter, and little that is close."""
    camera = _cameras([view], _TRIED).recentred(splats.offset)
    settings = RasterSettings(antialiased=False, near=near)
    sums: dict[str, Any] = _core.accumulate(arrays, [view_of(camera, 0, settings)], settings, None)
    if sums["weight"][close].sum() > _MURK * _TRIED[0] * _TRIED[1] or not sums["hits"][row]:
        return False
    return bool(sums["transmittance"][row] / sums["hits"][row] >= _CLEAR)


def _cameras(views: list[Any], size: tuple[int, int]) -> Cameras:
    focal = size[0] / 2 / np.tan(np.radians(_FOV / 2))
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    names = [f"anywhere_{i:04d}" for i in range(len(views))]
    return Cameras.from_lists(views, [K] * len(views), [size] * len(views), names)
