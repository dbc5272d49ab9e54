"""Starting points from photos with poses: COLMAP's sparse points, and as a fallback points along camera rays.

A point along a camera ray lies on the ray of a random pixel, at the depth where photos of nearby views agree
best on its colour (a plane sweep, one ray at a time). The points are a start for distillation, not a
reconstruction.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.io.types import Points
from g2ard.jobs.inputs import load_for_training, load_view_sets
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.cameras import Cameras
from g2ard.scene.images import load_image

if TYPE_CHECKING:
    from g2ard.jobs.inputs import Views

_SIDE = 240
"""Longer side in pixels of the photos used to place points."""
_DEPTHS = 48
_NEAREST, _FARTHEST = 0.3, 4.0
"""Range of trial depths, evenly spaced in 1/z, as multiples of the view's distance from the common centre."""
_NOTHING = 2 / 255
"""A pixel this close to the background colour is empty."""
_ALIKE = 1e-4
"""Variance of colour, summed over channels, within which depths count as equal."""
_OTHERS = 6
"""Number of nearby views compared; at least two must contain a point."""
_RAYS = 2048
"""Rays at a time."""

Float = NDArray[np.float64]


def points_of_photos(
    views: Views,
    held_out: Views | None,
    count: int | None,
    *,
    asked: str = "ratio",
    background: Colour = BLACK,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Points:
    """Return starting points: sparse points stored with the views, topped up to `count` along camera rays.

    Args:
        views: cameras with photos, or their path; only training views are used.
        held_out: separate views for scoring; all of `views` are then for training.
        count: least number of points; None means only the sparse points.
        asked: the kind of budget if it is not a count: ratio, share, fit, min_psnr or min_ssim.
        background: RGB of empty pixels.
        seed: seed of the rays.
        progress: called with the number of points.
        say: called with a summary.

    Raises:
        InputError: a view without a photo, or no sparse points and no `count`.
    """
    from g2ard.io import ViewFiles

    path = views.path if isinstance(views, ViewFiles) else views
    sparse = sparse_points(Path(path)) if isinstance(path, str | Path) else None
    if count is None and sparse is None:
        raise InputError(
            "needs sparse points, and there are none",
            parameter=asked,
            path=str(views),
            hint="give {count=COUNT}",
        )
    return topped_up(
        sparse, views, held_out, count or 0, background=background, seed=seed, progress=progress, say=say
    )


def topped_up(
    points: Points | None,
    views: Views,
    held_out: Views | None,
    count: int,
    *,
    background: Colour = BLACK,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Points:
    """Add points along camera rays until there are `count`; arguments as for `points_of_photos`."""
    found = 0 if points is None else len(points)
    wanting = max(0, count - found)
    parts = [] if points is None else [points]
    if wanting:
        train = (
            load_view_sets(views, ["train"], _SIDE)[0]
            if held_out is None
            else load_for_training(views, _SIDE)
        )
        parts.append(
            points_within_sight(train.cameras, wanting, background=background, seed=seed, progress=progress)
        )
    starts = [
        words
        for count, words in (
            (found, plural(found, "sparse point")),
            (wanting, f"{plural(wanting, 'point')} along camera rays"),
        )
        if count
    ]
    say(f"starting from {' and '.join(starts)}")
    return Points(
        np.concatenate([part.positions for part in parts]), np.concatenate([part.colors for part in parts])
    )


def sparse_points(views: Path) -> Points | None:
    """Return the points of a COLMAP model, of a transforms.json's `ply_file_path`, or of the input.ply beside
    INRIA's cameras.json; None if there are none."""
    from g2ard.io import read_points
    from g2ard.io.detect import file_format
    from g2ard.io.jsonfile import read_json

    found = file_format(views)
    try:
        if found == "colmap":
            return read_points(views if views.is_dir() else views.parent)
        if found == "transforms":
            file = views / "transforms.json" if views.is_dir() else views
            listed = read_json(file).get("ply_file_path") if file.is_file() else None
            return read_points(file.parent / str(listed)) if listed else None
        if found == "inria":
            return read_points((views if views.is_dir() else views.parent) / "input.ply")
    except InputError:
        return None
    return None


def points_within_sight(
    cameras: Cameras,
    count: int,
    *,
    background: Colour = BLACK,
    seed: int = 0,
    progress: Progress = silent,
) -> Points:
    """Place points on the rays of random pixels, where nearby photos agree best on the colour.

    z* = argmin_z Var_v[c_v(x(z))] over the nearest views v that contain x(z), at least two besides the ray's
    own.

    Args:
        cameras: C ≥ 3 views with photos, in world coordinates.
        count: number of points.
        background: RGB of empty pixels.
        seed: seed of the rays.
        progress: called with the number of points.

    Returns:
        `count` points in world coordinates, with the colour of their ray's pixel.

    Raises:
        InputError: fewer than three views, a view without a photo, or no point seen by three views.
    """
    if len(cameras) < 3:
        raise InputError(f"photos: expected at least 3 views, got {len(cameras)}; pass more, or a scene")
    bare = [name for name, path in zip(cameras.names, cameras.image_paths, strict=True) if path is None]
    if bare:
        raise InputError(f"photos: view {bare[0]} has no photo; pass views with photos, or a scene")
    photos = [load_image(cameras, i, background) for i in range(len(cameras))]
    rng = np.random.default_rng([seed, 11])
    middle = _looked_at(cameras)
    reach = np.linalg.norm(cameras.positions - middle, axis=1)
    near = [_neighbours(cameras, i) for i in range(len(cameras))]
    positions, colors, tried = np.zeros((0, 3)), np.zeros((0, 3), np.float32), 0
    while len(positions) < count:
        if tried > 64 * max(count, _RAYS):
            raise InputError("photos: no point was found that three views see; pass a point cloud")
        view = int(rng.integers(len(cameras)))
        rays = min(_RAYS, max(64, -(-count // len(cameras))))
        xyz, rgb = _swept(cameras, photos, view, near[view], float(reach[view]), rays, background, rng)
        tried += rays
        positions, colors = np.concatenate([positions, xyz]), np.concatenate([colors, rgb])
        progress("points", min(len(positions), count), count)
    return Points(positions[:count], np.ascontiguousarray(colors[:count]))


def _looked_at(cameras: Cameras) -> Float:
    """Return the (3,) point nearest to all optical axes, or a point ahead of the mean camera if they hardly
    cross."""
    across = np.eye(3) - cameras.forwards[:, :, None] * cameras.forwards[:, None, :]
    pull = across.sum(0)
    away = cameras.extent or 1.0
    ahead = cameras.positions.mean(0) + away * cameras.forwards.mean(0)
    if np.linalg.cond(pull) > 1e4:
        return ahead
    middle = np.linalg.solve(pull, np.einsum("cij,cj->i", across, cameras.positions))
    before = np.einsum("ci,ci->c", middle - cameras.positions, cameras.forwards) > 0
    return middle if before.mean() > 0.5 else ahead


def _neighbours(cameras: Cameras, view: int) -> NDArray[np.int64]:
    """Return the views nearest to one in position and direction."""
    away = np.linalg.norm(cameras.positions - cameras.positions[view], axis=1) / (cameras.extent or 1.0)
    turn = 1 - cameras.forwards @ cameras.forwards[view]
    order = np.argsort(away + turn, kind="stable")
    return order[order != view][:_OTHERS]


def _swept(
    cameras: Cameras,
    photos: list[NDArray[np.float32]],
    view: int,
    others: NDArray[np.int64],
    reach: float,
    rays: int,
    background: tuple[float, float, float],
    rng: np.random.Generator,
) -> tuple[Float, NDArray[np.float32]]:
    """Return points and colours on random rays of one view that at least two others contain."""
    photo, K, pose = photos[view], cameras.Ks[view], cameras.viewmats[view]
    columns, rows = rng.integers(photo.shape[1], size=rays), rng.integers(photo.shape[0], size=rays)
    own = photo[rows, columns]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(rays)])
    depths = reach / np.linspace(1 / _NEAREST, 1 / _FARTHEST, _DEPTHS)
    local = (np.linalg.inv(K) @ pixels).T[:, None, :] * depths[None, :, None]
    world = (local - pose[:3, 3]) @ pose[:3, :3]
    total, squares = own[:, None, :].astype(np.float64), (own[:, None, :] ** 2).astype(np.float64)
    total, squares = (np.repeat(a, _DEPTHS, axis=1) for a in (total, squares))
    seen = np.ones((rays, _DEPTHS))
    for other in others:
        color, held = _sampled(cameras, photos, int(other), world)
        total += color
        squares += color**2
        seen += held
    spread = (squares / seen[..., None] - (total / seen[..., None]) ** 2).sum(-1)
    spread[seen < 3] = np.inf
    alike = spread <= spread.min(1, keepdims=True) + _ALIKE
    best = _DEPTHS - 1 - alike[:, ::-1].argmax(1)  # among equals the farthest, because it occludes nothing
    kept = np.isfinite(spread.min(1)) & (np.abs(own - background).max(1) > _NOTHING)
    return world[np.arange(rays), best][kept], own[kept].astype(np.float32)


def _sampled(
    cameras: Cameras, photos: list[NDArray[np.float32]], view: int, world: Float
) -> tuple[Float, NDArray[np.bool_]]:
    """Return the colours of world points in a photo, black outside of it, and whether they are inside."""
    photo, pose, K = photos[view], cameras.viewmats[view], cameras.Ks[view]
    local = world @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[..., 2] > 0
    depth = np.where(ahead, local[..., 2], 1.0)
    u = np.floor(K[0, 0] * local[..., 0] / depth + K[0, 2])
    v = np.floor(K[1, 1] * local[..., 1] / depth + K[1, 2])
    held = ahead & (u >= 0) & (v >= 0) & (u < photo.shape[1]) & (v < photo.shape[0])
    color = photo[np.where(held, v, 0).astype(int), np.where(held, u, 0).astype(int)]
    return np.where(held[..., None], color, 0.0), held
