"""Visual hull: what remains of a box when every voxel that photos show to be empty is carved away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g2ard.arrays import Float, Mask
from g2ard.scene.cameras import Cameras, within_frame

_COARSE_VOXELS = 64
"""Voxels per side of the grid that finds the object's box."""
_FINE_VOXELS = 128
"""Voxels per side of the grid within that box."""
_EMPTY_VIEWS_SHARE = 0.02
"""Share of the views that may see a voxel as empty, because single outlines have errors."""
_SEEING_VIEWS_SHARE = 0.25
"""Least share of the views that must contain a voxel."""


@dataclass(frozen=True, eq=False)
class VisualHull:
    """A grid of voxels.

    Args:
        low: (3,) corner of the grid, world units.
        side: (3,) sides of a voxel.
        filled: (X, Y, Z), whether a voxel may be occupied.
    """

    low: Float
    side: Float
    filled: Mask

    def holds(self, points: Float) -> Mask:
        """Return whether (…, 3) world points lie in filled voxels."""
        at = np.floor((points - self.low) / self.side).astype(np.int64)
        inside: Mask = np.all((at >= 0) & (at < self.filled.shape), axis=-1)
        at = np.where(inside[..., None], at, 0)
        x, y, z = np.moveaxis(at, -1, 0)
        inside &= self.filled[x, y, z]
        return inside

    def depths(self, cameras: Cameras, view: int, count: int) -> Float:
        """Return (count,) depths that cover the grid's box in a view, evenly spaced."""
        unit_corners = np.indices((2, 2, 2)).reshape(3, 8).T
        corners = self.low + unit_corners * self.side * self.filled.shape
        row = cameras.viewmats[view, 2]
        depth = corners @ row[:3] + row[3]
        farthest = depth.max()
        return np.linspace(max(depth.min(), 1e-3 * farthest), farthest, count)


def visual_hull(
    cameras: Cameras, outlines: Sequence[Mask | None], middle: Float
) -> VisualHull | None:
    """Carve away every voxel that photos show to be empty.

    Args:
        outlines: (H, W) pixels that show the object, per view; None for a view that does not say.
        middle: (3,) a point that the cameras look at.

    Returns None if nothing remains, or the object is not outlined in enough views.
    """
    told = [
        v for v, outline in enumerate(outlines) if outline is not None and not bool(outline.all())
    ]
    if len(told) < max(3, _SEEING_VIEWS_SHARE * len(cameras)):
        return None
    half = float(np.median(np.linalg.norm(cameras.positions - middle, axis=1)))
    told = np.random.default_rng(0).permutation(told).tolist()  # other directions carve sooner
    low = middle - half
    size = np.full(3, 2 * half)
    for count in (_COARSE_VOXELS, _FINE_VOXELS):
        side = size / count
        middle = low + size / 2
        views = [_outline_view(cameras, view, outlines[view], middle, side) for view in told]
        filled = _carve(views, low, side, count)
        if not filled.any():
            return None
        occupied = np.argwhere(filled)
        hull = VisualHull(low, side, filled)
        low = low + (occupied.min(0) - 1) * side
        size = (np.ptp(occupied, 0) + 3) * side
    return hull


def _outline_view(
    cameras: Cameras,
    view: int,
    outline: Mask | None,
    middle: Float,
    side: Float,
) -> tuple[Float, Mask]:
    """Return a view's (3, 4) projection to pixels, and the pixels that a voxel touching the object may have:
    the outline, grown by half the diagonal of a voxel."""
    assert outline is not None
    projection = cameras.Ks[view] @ cameras.viewmats[view, :3]
    depth = float(projection[2, :3] @ middle + projection[2, 3])
    radius = 0.5 * float(np.linalg.norm(side)) * cameras.Ks[view, 0, 0] / max(depth, side.max())
    return projection, grown(outline, int(np.ceil(radius)))


def _carve(
    views: Sequence[tuple[Float, Mask]],
    low: Float,
    side: Float,
    count: int,
) -> Mask:
    """Return the (count, count, count) voxels that are in sight and within the outlines."""
    steps = np.arange(count) + 0.5
    most_empty = _EMPTY_VIEWS_SHARE * len(views)
    least_seen = _SEEING_VIEWS_SHARE * len(views)
    filled = np.zeros((count, count * count), bool)
    y_and_z = np.meshgrid(steps, steps, indexing="ij")
    plane = np.stack(y_and_z, -1).reshape(-1, 2)
    plane = plane * side[1:] + low[1:]  # centres of a slab's voxels
    for slab, x in enumerate(low[0] + steps * side[0]):
        points = plane
        left = np.arange(len(plane))  # voxels that are not carved away
        empty = np.zeros(len(plane), np.int16)
        seen = np.zeros(len(plane), np.int16)
        for P, shown in views:
            height, width = shown.shape
            ahead = points @ P[:, 1:3].T + (P[:, 0] * x + P[:, 3])
            depth = np.maximum(ahead[:, 2], 1e-9)
            u, v = (ahead[:, :2] / depth[:, None]).T
            inside = within_frame(u, v, width, height)
            inside &= ahead[:, 2] > 0
            rows = np.where(inside, v, 0).astype(np.intp)
            columns = np.where(inside, u, 0).astype(np.intp)
            seen += inside
            empty += inside & ~shown[rows, columns]
            kept = empty <= most_empty
            if kept.all():
                continue
            points = points[kept]
            left = left[kept]
            empty = empty[kept]
            seen = seen[kept]
        filled[slab, left] = seen >= least_seen
    return filled.reshape(count, count, count)


def grown(mask: Mask, radius: int) -> Mask:
    """Return the pixels within `radius` of a mask's, along both axes.

    >>> grown(np.eye(4, dtype=bool)[:2], 1).astype(int).tolist()
    [[1, 1, 1, 0], [1, 1, 1, 0]]
    """
    span = 2 * radius + 1
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (radius + 1, radius)
        sums = np.cumsum(np.pad(mask, pad).astype(np.int32), axis=axis)
        first = np.arange(mask.shape[axis])
        mask = sums.take(first + span, axis) > sums.take(first, axis)  # any within the span
    return mask
