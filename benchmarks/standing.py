"""Views of other kinds than a pool's, unseen by every method: close up, and from where people stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from g2ard import io
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.poses import plan_pool
from g2ard.poses.numbers import halton
from g2ard.poses.outside import plan_orbit
from g2ard.poses.sight import Lens, Poses, Rays, Survey
from g2ard.poses.site import Site
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.splits import for_scores
from g2ard.scene.targets import TeacherRenders

__all__ = ["given_views", "standing_targets", "standing_views"]

_SEED = 7919
"""Added to the seed of a pool, so that these poses differ from all poses that methods use."""

_POOL, _NEAR, _STANDING = 128, 16, 24
_FOV = 70.0
"""Degrees; a pool's poses have 50."""

_BETWEEN = (0.35, 0.8)
"""Range of the remaining share of the way to an object's surface, for poses between near and far."""


def given_views(scene: Path) -> Cameras | None:
    """Return the views of a standing.json in the scene's folder or its parent; None without one.

    Raises:
        InputError: the file is invalid.
    """
    folder = scene.absolute() if scene.is_dir() else scene.absolute().parent
    path = next((p for place in (folder, folder.parent) if (p := place / "standing.json").is_file()), None)
    if path is None:
        return None
    found = io.read_view_set(path)
    return found.cameras.take(for_scores(path, found.cameras.names, found.splits))


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


def standing_targets(
    splats: Splats,
    scene: Path,
    seed: int = 0,
    *,
    size: int | None = None,
    background: Colour = BLACK,
) -> dict[str, TeacherRenders]:
    """Return renders of `standing_views`, shrunk to `size`, without views that show nothing of the scene.

    Raises:
        InputError: as `standing_views`.
    """
    found = {}
    for kind, cameras in standing_views(splats, scene, seed).items():
        targets = TeacherRenders(splats, cameras.resized(size), background=background)
        shown = np.array([np.ptp(targets[view], axis=(0, 1)).any() for view in range(len(cameras))])
        if shown.any():
            found[kind] = (
                targets
                if shown.all()
                else TeacherRenders(splats, targets.cameras.take(shown), background=background)
            )
    return found


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
