"""Registration of photos: estimating camera poses against a scene."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float
from g2ard.config.choices import BLACK, Keep
from g2ard.errors import InputError, require
from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register.attempts import (
    Candidate,
    Photo,
    PoolRenders,
    Search,
    Start,
    loaded,
    small_render,
    turned,
)
from g2ard.stages.register.config import TAIL, RegisterConfig
from g2ard.stages.register.grey import band_passed
from g2ard.stages.register.matchers import matcher_named
from g2ard.stages.register.pose import motion_between, pose_error
from g2ard.stages.register.report import (
    KEPT,
    PhotoReport,
    PoseError,
    Registered,
    RegisterReport,
    Status,
)

_FEATURES_BONUS = 0.05
"""Bonus in likeness for a pose confirmed by features: they detect errors of decimetres, ZNCC of metres."""


def register(
    scene: Splats,
    photos: Cameras,
    *,
    starts: Mapping[str, ArrayLike] | None = None,
    pool: Cameras | None = None,
    config: RegisterConfig | None = None,
    keep: Keep = "registered",
    background: Sequence[float] = BLACK,
    progress: Progress = silent,
) -> Registered:
    """Estimate the poses of photos by features and by direct alignment with renders of the scene.

    A photo starts from its pose in `starts`. Matches with a render at that pose, lifted by the render's
    depth, give a new pose by PnP; this is repeated and refined (`g2ard.stages.register.solve`). If there are
    too few matches, the photo is aligned directly, coarse to fine (`g2ard.stages.register.align`). If the
    result is doubtful, alignment is tried again from the start rotated so that a small render fits best.

    A photo without a pose starts from the `candidates` poses of `pool` whose renders at `pool_size` pixels,
    rotated likewise, are most similar: by features from the pose with the most inliers, or by alignment from
    each. The result with the highest median local ZNCC is kept. An unreadable photo gets status "refused".

    Other arguments, results and errors are those of `g2ard.register`; `starts` are its poses, name → (4, 4)
    camera_from_world.
    """
    config = config or RegisterConfig()
    if not len(photos):
        raise InputError("no photos to register")
    require("keep", repr(keep), keep in KEPT, ", ".join(KEPT))
    given = _check_poses(starts, photos)
    if not given and pool is None:
        raise InputError(
            "no photo has a starting pose; pass starting poses or a pool", parameter="starts"
        )
    renderer = Renderer(scene, background=background)
    if pool is None:
        renders = None
    else:
        renders = PoolRenders(renderer, pool, config, progress)
    search = Search(renderer, config, matcher_named(config.matcher, config.ratio, config.features))
    rows = []
    kept = []
    poses = []
    zooms = []
    matches = {}
    for i, name in enumerate(photos.names):
        progress("register", i, len(photos))
        began = time.perf_counter()
        if name in given:
            start = Start(given[name], given[name], name)
        else:
            start = None
        row, best = _register_photo(search, photos, i, start, renders)
        if best is not None and best.solved is not None:
            matches[name] = np.concatenate([best.solved.pixels, best.solved.seen], 1)
        if best is None and keep == "all" and start is not None:
            row = replace(row, camera_from_world=_list_rows(start.pose))
        rows.append(replace(row, seconds=time.perf_counter() - began))
        if row.camera_from_world is not None and row.status in KEPT[keep]:
            kept.append(i)
            poses.append(np.array(row.camera_from_world))
            zooms.append(1.0 if row.focal is None else row.focal / photos.Ks[i, 0, 0])
    progress("register", len(photos), len(photos))
    cameras = photos.take(np.array(kept, int))
    if kept:
        Ks = cameras.Ks.copy()
        Ks[:, [0, 1], [0, 1]] *= np.array(zooms)[:, None]
        cameras = replace(cameras, viewmats=np.stack(poses), Ks=Ks)
    return Registered(cameras, RegisterReport(tuple(rows)), matches)


def _list_rows(matrix: Float) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def _check_poses(poses: Mapping[str, ArrayLike] | None, photos: Cameras) -> dict[str, Float]:
    out = {}
    for name in photos.names:
        if poses and name in poses:
            pose = np.asarray(poses[name], np.float64)
            rigid = pose.shape == (4, 4) and np.isfinite(pose).all()
            if not (rigid and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)):
                raise InputError(f"{name}: not a rigid 4×4 pose", parameter="starts")
            out[name] = pose
    return out


def _register_photo(
    search: Search,
    photos: Cameras,
    index: int,
    given: Start | None,
    pool: PoolRenders | None,
) -> tuple[PhotoReport, Candidate | None]:
    """Register one photo from the pose `given`, otherwise from the pool; return its best candidate."""
    name = photos.names[index]
    refused = PhotoReport(name, "refused", start=given.name if given else None)
    if given is None and pool is None:
        return replace(refused, reason="no pose to start from"), None
    try:
        photo = loaded(photos, index, search.config, search.renderer.background)
    except InputError as error:
        return replace(refused, reason=str(error)), None
    search.renders = 0
    if given is not None:
        candidates = _start_from_pose(search, given, photo)
    else:
        assert pool is not None
        candidates = _start_from_pool(search, pool, photo)
    if not candidates:
        least = f"{search.config.min_overlap:.0%} of the photo"
        why = f"away from edges, the scene covers less than {least} at the starting pose"
        if not search.config.fallback:
            why = f"fewer than {search.config.min_inliers} matches confirm a pose"
        return replace(refused, reason=why, renders=search.renders), None
    best = max(candidates, key=lambda c: c.zncc + (_FEATURES_BONUS if c.solved else 0))
    alike: list[Float] = []
    if search.config.fallback and best.zncc >= min(search.config.doubt, search.config.accept):
        best, alike = search.against_repeats(best, photo)
    return _report(name, best, search.config, search.renders, photos[index].K[0, 0], alike), best


def _start_from_pose(search: Search, given: Start, photo: Photo) -> list[Candidate]:
    """Try features, then alignment, then alignment from a rotated start, then features from the result."""
    config = search.config

    def accepted(found: list[Candidate]) -> bool:
        return any(c.zncc >= config.accept for c in found)

    out = []
    by_features = search.by_features(given, photo)
    if by_features:
        out.append(by_features)
    if accepted(out) or not config.fallback:
        return out
    aligned = []
    by_alignment = search.by_alignment(given, photo)
    if by_alignment:
        aligned.append(by_alignment)
    if not accepted(aligned):
        camera, grey = photo.small
        render = small_render(search.renderer, replace(camera, viewmat=given.pose), config)
        pose, _, shift = turned(given.pose, render, band_passed(grey), camera.K)
        search.renders += 1
        if shift:
            again = search.by_alignment(replace(given, begins=pose), photo)
            if again:
                aligned.append(again)
    return out + aligned + _try_features(search, aligned, photo)


def _start_from_pool(search: Search, pool: PoolRenders, photo: Photo) -> list[Candidate]:
    """Try features from the pose with the most inliers, otherwise alignment from each similar pose."""
    order, renders = pool.ranked(*photo.small)
    search.renders += renders
    starts = [
        Start(pool.pool.viewmats[at], pose, pool.pool.names[at], rank)
        for rank, (at, pose) in enumerate(order[: search.config.candidates], 1)
    ]
    best = None
    most = 0
    for start in starts:
        solved = search.by_matches(start.begins, photo, 1)
        if solved and solved.inliers > most:
            best = replace(start, begins=solved.viewmat)
            most = solved.inliers
    if best:
        found = search.by_features(best, photo)
        if found:
            return [found]
    if not search.config.fallback:
        return []
    attempts = [search.by_alignment(start, photo) for start in starts]
    aligned = [candidate for candidate in attempts if candidate]
    return aligned + _try_features(search, aligned, photo)


def _try_features(search: Search, aligned: list[Candidate], photo: Photo) -> list[Candidate]:
    """Try features from the most similar aligned pose, unless its status would be refused."""
    best = max(aligned, key=lambda c: c.zncc, default=None)
    if best is None or best.zncc < min(search.config.doubt, search.config.accept):
        return []
    candidate = search.by_features(replace(best.start, begins=best.found.viewmat), photo)
    return [candidate] if candidate else []


def _report(
    name: str,
    best: Candidate,
    config: RegisterConfig,
    renders: int,
    focal: float,
    alike: list[Float],
) -> PhotoReport:
    estimate = best.found
    sigma = None
    covariance = None
    if best.solved:
        prior = best.solved.focal_sigma
    else:
        prior = config.focal_sigma
    if estimate.covariance is not None:
        motions = [motion_between(estimate.viewmat, other) for other in alike]
        covariance = _add_tail(estimate.covariance, prior)[:6, :6] + sum(
            np.outer(m, m) for m in motions
        ) / (1 + len(motions))
        position = np.sqrt(np.trace(covariance[:3, :3]))
        rotation = np.sqrt(np.trace(covariance[3:6, 3:6]))
        sigma = PoseError(float(position), float(np.degrees(rotation)))
    status, reason = _judge(best.zncc, sigma, estimate.depth, config)
    if alike and status != "refused":
        away = min(pose_error(estimate.viewmat, other)[0] for other in alike)
        status = "uncertain"
        reason = f"places look alike: a pose {away:.2g} units away fits as well"
    names = ("matches", "inliers", "spread", "reprojection", "passes") if best.solved else ()
    of_features: dict[str, Any] = {name: getattr(best.solved, name) for name in names}
    return PhotoReport(
        name=name,
        status=status,
        reason=reason,
        start=best.start.name,
        rank=best.start.rank,
        **of_features,
        zncc=best.zncc,
        gain=estimate.gain,
        bias=estimate.bias,
        overlap=estimate.overlap,
        covariance=None if covariance is None else _list_rows(covariance),
        focal=float(focal * estimate.zoom),
        focal_sigma=None
        if estimate.covariance is None
        else float(estimate.covariance[6, 6]) ** 0.5,
        sigma=sigma,
        renders=renders,
        camera_from_world=_list_rows(estimate.viewmat),
    )


def _add_tail(covariance: Float, prior: float) -> Float:
    """Return the covariance of an estimate with `prior` as σ of log f, which varies by `TAIL` times that.

    C = (Λ + eeᵀ/s²)⁻¹ becomes C (Λ + eeᵀ TAIL²/s²) C, where e is the axis of φ.
    """
    return covariance + np.outer(covariance[6], covariance[6]) * (TAIL**2 - 1) / prior**2


def _judge(
    zncc: float,
    sigma: PoseError | None,
    depth: float,
    config: RegisterConfig,
) -> tuple[Status, str | None]:
    """Return the status of a pose and the reason, None if it is registered."""
    if sigma is None:
        return "refused", "the photo does not determine the pose"
    if zncc < min(config.doubt, config.accept):
        return "refused", f"the best render looks unlike it (ZNCC {zncc:.2f})"
    if zncc < config.accept:
        return "uncertain", f"the best render looks unlike it (ZNCC {zncc:.2f})"
    if sigma.rotation > config.max_angle_sigma:
        return "uncertain", f"the rotation is only known to {sigma.rotation:.2g}°"
    if sigma.position > config.max_position_sigma * depth:
        return (
            "uncertain",
            f"the position is only known to {sigma.position / depth:.2g} of the depth",
        )
    return "registered", None
