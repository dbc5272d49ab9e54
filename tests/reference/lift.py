"""The lift, naively: brute-force neighbours, numpy's eigen-solver, float64 throughout."""

import numpy as np

LINE, FLAT, TURNED = 0.5, 0.25, np.cos(np.radians(30))


def discs(points, neighbors=10, normal_ratio=0.1, max_anisotropy=4.0, spread=0.94):
    """(normals (N, 3), scales (N, 3)) of centred points whose neighbourhoods all have an extent."""
    points = np.asarray(points, np.float64)
    sigmas, axes = _extents(points, neighbors, np.inf)
    normals, wide, narrow = axes[:, 2].copy(), sigmas[:, 0].copy(), sigmas[:, 1].copy()
    lines = np.flatnonzero(narrow < LINE * wide)
    open_, wide0 = set(lines), wide.copy()
    begin, end = (np.frexp(wide0[lines] * f)[1] - 1 for f in (0.5, 8))
    for level in range(min(begin, default=0), max(end, default=-1) + 1):
        active = [at for at, row in enumerate(lines) if row in open_ and begin[at] <= level <= end[at]]
        if not active:
            continue
        size = 2.0**level
        _, cell = np.unique(np.floor(points[lines] / size), axis=0, return_inverse=True)
        cell = cell.ravel()
        means = (
            np.stack([np.bincount(cell, points[lines, k]) for k in range(3)], 1) / np.bincount(cell)[:, None]
        )
        around, frames = _extents(means, 2 * neighbors, 5 * size)
        for at in active:
            row, (a, b, c), (t1, t2, n) = lines[at], around[cell[at]], frames[cell[at]]
            if b < LINE * a or c > LINE * b or a == 0:
                continue
            open_.discard(row)
            if narrow[row] >= FLAT * wide[row] and abs(n @ axes[row, 2]) > TURNED:
                continue
            along = axes[row, 0] - (axes[row, 0] @ n) * n
            across = np.cross(n, along / np.linalg.norm(along)) if np.linalg.norm(along) > 1e-6 else t1
            normals[row] = n
            narrow[row] = 0.8 * np.sqrt((a * (across @ t1)) ** 2 + (b * (across @ t2)) ** 2)
    wide, narrow = spread * np.maximum(wide, narrow), spread * np.minimum(wide, narrow)
    narrow = np.maximum(narrow, wide / max_anisotropy)
    return normals, np.stack([wide, narrow, normal_ratio * np.sqrt(wide * narrow)], 1)


def _extents(points, neighbors, reach):
    """Standard deviations (N, 3), descending, and axes (N, 3, 3) of points with neighbours within reach."""
    sigmas, axes = np.zeros_like(points), np.tile(np.eye(3), (len(points), 1, 1))
    for i, p in enumerate(points):
        d2 = ((points - p) ** 2).sum(1)
        order = np.lexsort((np.arange(len(points)), d2)) if len(points) < 500 else _first(d2, neighbors + 1)
        near = order[order != i][:neighbors]
        near = near[d2[near] <= reach**2]
        if reach < np.inf and len(near) < neighbors // 4:
            continue
        near = points[np.r_[i, near]] - p
        near = near - near.mean(0)
        values, vectors = np.linalg.eigh(near.T @ near / len(near))
        sigmas[i], axes[i] = np.sqrt(np.maximum(values[::-1], 0)), vectors.T[::-1]
    return sigmas, axes


def _first(d2, count):
    """The rows of the smallest values, by (value, row)."""
    rows = np.flatnonzero(d2 <= np.partition(d2, count - 1)[count - 1])
    return rows[np.lexsort((rows, d2[rows]))]
