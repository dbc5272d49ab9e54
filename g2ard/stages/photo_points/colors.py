"""Colours for points from the photos that see them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from g2ard.io.photos import load_photo
from g2ard.io.types import Cloud, Points
from g2ard.progress import Progress, Say, plural, silent
from g2ard.scene.cameras import Cameras

_PHOTO_SIDE = 640
"""Longer side in pixels of the photos that colour points."""
_SEEN = 9
"""Photos of which a point takes the median."""
_CELL_POINTS = 4
"""Points per cell of the grid in which the nearest hide others."""
_DEPTH_SLACK = 0.05
"""Relative depth behind the nearest point of a cell within which points are seen."""


def colored(cloud: Cloud, train: Cameras, name: str, *, progress: Progress = silent, say: Say) -> Points:
    """Return a cloud's points, those without a colour with that of training photos, where any sees them."""
    points, bare = cloud.points, ~cloud.colored
    if not bare.any():
        return points
    cameras = train.fitted(_PHOTO_SIDE)
    rows = [row for row, path in enumerate(cameras.image_paths) if path is not None]
    found, seen = median_colors(points.positions, bare, cameras.take(rows), progress)
    colors = points.colors.copy()
    colors[np.flatnonzero(bare)[seen]] = found[seen]
    if seen.any() and not points.colors[bare].any():  # what no photo sees takes the usual colour
        colors[np.flatnonzero(bare)[~seen]] = np.median(found[seen], axis=0)
    if seen.any():
        shown = f"{int(seen.sum()):,} of {plural(len(seen), 'point')} without colours"
        say(f"{name}: {shown} take them from the photos that see them")
    return Points(points.positions, colors)


def median_colors(
    positions: NDArray[np.float64], wanted: NDArray[np.bool_], cameras: Cameras, progress: Progress = silent
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the (n, 3) median colours of the wanted points in photos that see them, and whether any does.

    Of each photo, all points are drawn into cells of a few; those behind the nearest of a cell are hidden.

    Args:
        positions: (N, 3) world coordinates.
        wanted: (N,), n of which are true.
    """
    own = np.flatnonzero(wanted)
    kept = np.zeros((len(own), _SEEN, 3), np.uint8)
    count = np.zeros(len(own), np.intp)
    for done, view in enumerate(np.random.default_rng(0).permutation(len(cameras)).tolist()):
        progress("colour points", done, len(cameras))
        pixels, visible = _seen(positions, cameras, view)
        rows = np.flatnonzero(visible[own] & (count < _SEEN))
        if not len(rows):
            continue
        image, mask = load_photo(cameras, view, None)
        sample = image[pixels[own[rows], 1], pixels[own[rows], 0]]
        if mask is not None:
            held = mask[pixels[own[rows], 1], pixels[own[rows], 0]]
            rows, sample = rows[held], sample[held]
        if image.shape[2] == 4:
            rows, sample = rows[sample[:, 3] > 0.5], sample[sample[:, 3] > 0.5]
            sample = sample[:, :3] / sample[:, 3:]
        kept[rows, count[rows]] = np.rint(255 * np.clip(sample, 0, 1))
        count[rows] += 1
    colors = np.zeros((len(own), 3), np.float32)
    for seen in range(1, _SEEN + 1):
        rows = np.flatnonzero(count == seen)
        colors[rows] = np.median(kept[rows, :seen], axis=1) / 255
    return colors, count > 0


def _seen(
    positions: NDArray[np.float64], cameras: Cameras, view: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return (N, 2) columns and rows of points in a view, and whether they are inside and not hidden."""
    width, height = int(cameras.widths[view]), int(cameras.heights[view])
    pose, K = cameras.viewmats[view].astype(np.float64), cameras.Ks[view]
    local = positions @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v = local[:, 0] / depth * K[0, 0] + K[0, 2], local[:, 1] / depth * K[1, 1] + K[1, 2]
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    pixels = np.where(inside[:, None], np.stack([u, v], axis=1), 0).astype(np.intp)
    side = max(1.0, np.sqrt(width * height * _CELL_POINTS / max(1, int(inside.sum()))))
    across = int(width / side) + 1
    cells = (pixels[:, 1] / side).astype(np.intp) * across + (pixels[:, 0] / side).astype(np.intp)
    nearest = np.full(across * (int(height / side) + 1), np.inf)
    np.minimum.at(nearest, cells[inside], depth[inside])
    return pixels, inside & (depth <= (1 + _DEPTH_SLACK) * nearest[cells])
