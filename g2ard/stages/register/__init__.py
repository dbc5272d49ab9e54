"""Photos registered against a scene: where was each of them taken?"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.cameras import Camera, Cameras
from g2ard.errors import InputError
from g2ard.images import load_image, load_mask, resized
from g2ard.progress import Progress, silent
from g2ard.splats import Splats
from g2ard.stages.register.align import Aligned, Level, align, level_of
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import band_passed, grey_of, local_zncc
from g2ard.stages.register.outcome import (
    PhotoReport,
    PoseError,
    Registered,
    RegisterReport,
    Status,
)
from g2ard.stages.register.pool import PoolRenders, small_render, turned
from g2ard.stages.register.pose import pose_error
from g2ard.stages.render import Renderer

__all__ = [
    "PhotoReport",
    "PoseError",
    "RegisterConfig",
    "RegisterReport",
    "Registered",
    "pose_error",
    "register",
]

Float = NDArray[np.float64]
_KEPT = {"registered": ("registered",), "uncertain": ("registered", "uncertain")}


@dataclass(frozen=True, eq=False)
class _Photo:
    """A photo at every level; `small` is at the size of the pool's renders, `whole` grey without a blur."""

    pyramid: list[tuple[Camera, Level]]
    small: tuple[Camera, Float]
    whole: Float


@dataclass(frozen=True)
class _Start:
    """A pose to start from; `turned`, where it is not None, is what alignment begins with."""

    pose: Float
    name: str
    rank: int | None = None
    turned: Float | None = None


@dataclass(frozen=True, eq=False)
class _Candidate:
    start: _Start
    found: Aligned
    zncc: float


def register(
    scene: Splats,
    photos: Cameras,
    *,
    starts: Mapping[str, ArrayLike] | None = None,
    pool: Cameras | None = None,
    truth: Mapping[str, ArrayLike] | None = None,
    config: RegisterConfig | None = None,
    keep: str = "registered",
    background: Sequence[float] = (0.0, 0.0, 0.0),
    progress: Progress = silent,
) -> Registered:
    """Find the poses of photos by direct alignment with renders of the scene.

    A photo starts from its own pose in `starts`, and where that ends in doubt once more from there, turned
    to where a small render lies best on the photo. Without a pose it starts from the `candidates` poses of
    `pool` whose renders at `pool_size` pixels, turned alike, are most like it. From each start it is aligned,
    coarse to fine (`g2ard.stages.register.align`); the result with the highest median local ZNCC is kept, and
    that decides what it is worth.
    A photo that cannot be read is refused like any other: the rest goes on.

    Args:
        scene: the Gaussians; its offset counts, poses are in world coordinates.
        photos: C views with photos, K, size and distortion; their poses do not count.
        starts: name → (4, 4) camera_from_world.
        pool: poses to start from where `starts` has none.
        truth: name → (4, 4) camera_from_world, to score with; it decides nothing.
        config: see `RegisterConfig`.
        keep: "registered", or "uncertain" to keep those as well.
        background: RGB behind the scene.
        progress: told of every photo.

    Returns:
        A `Registered`: the kept cameras, and a report on all photos.

    Raises:
        InputError: no photos, another `keep`, no pose to start any photo from, or a pose that is none.

    >>> from g2ard.cameras import Camera
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1] * 3], logit_opacities=[9])
    >>> view = Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0], name="a.png")])
    >>> report = register(dot, view, starts={"a.png": view.viewmats[0]}).report
    >>> report.photos[0].status, report.photos[0].reason
    ('refused', 'view 0 (a.png) has no photo: its views name no image for it')
    """
    config = config or RegisterConfig()
    if not len(photos):
        raise InputError("photos: there are none")
    if keep not in _KEPT:
        raise InputError(f"keep: expected registered or uncertain, got {keep!r}")
    given = _poses("starts", starts, photos)
    true = _poses("truth", truth, photos)
    if not given and pool is None:
        raise InputError("starts: no photo has a pose, and there is no pool to look for one in")
    renderer = Renderer(scene, background=background)
    renders = None if pool is None else PoolRenders(renderer, pool, config)
    rows, kept, poses = [], [], []
    for i, name in enumerate(photos.names):
        began = time.perf_counter()
        start = _Start(given[name], name) if name in given else None
        row, pose = _one(renderer, photos, i, start, renders, config, true.get(name))
        rows.append(replace(row, seconds=time.perf_counter() - began))
        if pose is not None and row.status in _KEPT[keep]:
            kept.append(i)
            poses.append(pose)
        progress("register", i + 1, len(photos))
    cameras = photos.take(np.array(kept, int))
    if kept:
        cameras = replace(cameras, viewmats=np.stack(poses))
    return Registered(cameras, RegisterReport(tuple(rows)))


def _poses(what: str, poses: Mapping[str, ArrayLike] | None, photos: Cameras) -> dict[str, Float]:
    """The poses of those photos that have one."""
    out = {}
    for name in photos.names:
        if poses and name in poses:
            pose = np.asarray(poses[name], np.float64)
            rigid = pose.shape == (4, 4) and np.isfinite(pose).all()
            if not (rigid and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)):
                raise InputError(f"{what}: {name}: not a rigid 4×4 pose")
            out[name] = pose
    return out


def _one(
    renderer: Renderer,
    photos: Cameras,
    index: int,
    given: _Start | None,
    pool: PoolRenders | None,
    config: RegisterConfig,
    true: Float | None,
) -> tuple[PhotoReport, Float | None]:
    """One photo from whatever it can start from."""
    name = photos.names[index]
    start_error = None if given is None or true is None else PoseError(*pose_error(given.pose, true))
    refused = PhotoReport(name, "refused", start=given.name if given else None, start_error=start_error)
    if given is None and pool is None:
        return replace(refused, reason="no pose to start from"), None
    try:
        photo = _loaded(photos, index, config)
    except InputError as error:
        return replace(refused, reason=str(error)), None
    renders = 0
    if given is not None:
        starts = [given]
    else:
        assert pool is not None
        order, renders = pool.ranked(*photo.small)
        best = enumerate(order[: config.candidates], 1)
        starts = [
            _Start(pool.pool.viewmats[at], pool.pool.names[at], rank, there.viewmat)
            for rank, (at, there) in best
        ]
    candidates = [found for start in starts if (found := _tried(renderer, start, photo, config))]
    if given is not None and not any(c.zncc >= config.accept for c in candidates):
        camera, grey = photo.small
        render = small_render(renderer, replace(camera, viewmat=given.pose), config)
        there = turned(given.pose, render, band_passed(grey), camera.K)
        again = replace(given, turned=there.viewmat)
        renders += 1
        if there.pixels and (found := _tried(renderer, again, photo, config)):
            candidates.append(found)
    renders += sum(c.found.steps + 1 for c in candidates)
    if not candidates:
        return replace(refused, reason="the scene is out of the starting pose's sight", renders=renders), None
    best_one = max(candidates, key=lambda c: c.zncc)
    row = _reported(name, best_one, config, renders)
    if true is not None:
        start_error = PoseError(*pose_error(best_one.start.pose, true))
        end_error = PoseError(*pose_error(best_one.found.viewmat, true))
        row = replace(row, start_error=start_error, error=end_error)
    return row, best_one.found.viewmat


def _loaded(photos: Cameras, index: int, config: RegisterConfig) -> _Photo:
    """Read a photo, once, and shrink it to each level."""
    sizes = config.levels()
    one = photos.take([index]).resized(sizes[-1])
    image, mask = load_image(one, 0), load_mask(one, 0)

    def shrunk(side: int) -> tuple[Camera, Float, NDArray[np.bool_] | None]:
        camera = one.resized(side)[0]
        size = camera.width, camera.height
        grey = grey_of(resized(image, size))
        if mask is None:
            return camera, grey, None
        share = resized(np.repeat(mask[..., None].astype(np.float32), 3, 2), size)[..., 0]
        return camera, grey, share > 0.999

    levels = [shrunk(side) for side in sizes]
    small = shrunk(config.pool_size)
    pyramid = [(camera, level_of(grey, counts)) for camera, grey, counts in levels]
    return _Photo(pyramid, small[:2], levels[-1][1])


def _tried(renderer: Renderer, start: _Start, photo: _Photo, config: RegisterConfig) -> _Candidate | None:
    """Align from one start; None where the scene is out of its sight."""
    pose = start.pose if start.turned is None else start.turned
    found = align(renderer, pose, photo.pyramid, config)
    return None if found is None else _Candidate(start, found, _likeness(renderer, found, photo, config))


def _likeness(renderer: Renderer, found: Aligned, photo: _Photo, config: RegisterConfig) -> float:
    """Median local ZNCC at the finest level, without a blur."""
    camera, level = photo.pyramid[-1]
    out = renderer.render(replace(camera, viewmat=found.viewmat))
    mask = level.mask & (out.alpha >= config.min_alpha)
    return local_zncc(grey_of(np.clip(out.image, 0, 1)), photo.whole, mask, config.window)


def _reported(name: str, best: _Candidate, config: RegisterConfig, renders: int) -> PhotoReport:
    found = best.found
    sigma = None
    if found.covariance is not None:
        position, rotation = (np.sqrt(np.trace(found.covariance[at, at])) for at in _HALVES)
        sigma = PoseError(float(position), float(np.degrees(rotation)))
    status, reason = _status(best.zncc, sigma, found.depth, config)
    return PhotoReport(
        name=name,
        status=status,
        reason=reason,
        start=best.start.name,
        rank=best.start.rank,
        zncc=best.zncc,
        gain=found.gain,
        bias=found.bias,
        overlap=found.overlap,
        covariance=None if found.covariance is None else tuple(map(tuple, found.covariance.tolist())),
        sigma=sigma,
        renders=renders,
        camera_from_world=tuple(map(tuple, found.viewmat.tolist())),
    )


_HALVES = (slice(0, 3), slice(3, 6))


def _status(
    zncc: float, sigma: PoseError | None, depth: float, config: RegisterConfig
) -> tuple[Status, str | None]:
    """What a result is worth, and why it is worth no more."""
    if sigma is None:
        return "refused", "the photo does not determine the pose"
    if zncc < min(config.doubt, config.accept):
        return "refused", f"render and photo differ: ZNCC {zncc:.2f}"
    if zncc < config.accept:
        return "uncertain", f"render and photo differ: ZNCC {zncc:.2f}"
    if sigma.rotation > config.max_angle_sigma:
        return "uncertain", f"the rotation is known to {sigma.rotation:.2g}° only"
    if sigma.position > config.max_position_sigma * depth:
        return "uncertain", f"the position is known to {sigma.position / depth:.2g} of the depth only"
    return "registered", None
