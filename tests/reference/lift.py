"""The lift, naively: brute-force neighbours, numpy's eigen-solver, float64 throughout."""

import numpy as np

LINE, FLAT, TURNED, SLOPE = 0.5, 0.25, np.cos(np.radians(30)), 0.25
ACROSS = 0.4
ALONG = np.sqrt(12) / (4 * np.pi) / ACROSS


def discs(points, neighbors=10, normal_ratio=0.1, max_anisotropy=4.0, spread=0.94):
    """(normals (N, 3), scales (N, 3)) of centred points whose neighbourhoods all have an extent."""
    points = np.asarray(points, np.float64)
    sigmas, axes, near = _extents(points, neighbors, np.inf)
    normals, wide, narrow = axes[:, 2].copy(), sigmas[:, 0].copy(), sigmas[:, 1].copy()
    thin = narrow < LINE * wide

    def parallel(row, others):
        return np.abs(axes[others, 0] @ axes[row, 0]) > TURNED

    most = [
        row
        for row in np.flatnonzero(thin)
        if (thin[near[row]] & parallel(row, near[row])).mean() > 0.5
    ]
    lines = np.array(most, int)
    begin, end = (np.frexp(wide[lines] * f)[1] - 1 for f in (0.5, 16))
    inner, edges = set(), {}

    def turn(row, n, gap):
        if sigmas[row, 1] >= FLAT * sigmas[row, 0] and abs(n @ axes[row, 2]) > TURNED:
            return
        along = axes[row, 0] - (axes[row, 0] @ n) * n
        axes[row, 0] = along / np.linalg.norm(along)
        normals[row], narrow[row], full = n, ALONG * sigmas[row, 0], ACROSS * gap
        wide[row] = full
        for _ in range(4):
            overlap = max(wide[row] / max_anisotropy / narrow[row], 1)
            wide[row] = full / np.sqrt(1 + np.log(overlap))

    for level in range(min(begin, default=0), max(end, default=-1) + 1):
        active = [
            at
            for at in range(len(lines))
            if lines[at] not in inner and begin[at] <= level <= end[at]
        ]
        if not active:
            continue
        size = 2.0**level
        _, first, cell = np.unique(
            np.floor(points[lines] / size), axis=0, return_index=True, return_inverse=True
        )
        cell = cell.ravel()
        means = (
            np.stack([np.bincount(cell, points[lines, k]) for k in range(3)], 1)
            / np.bincount(cell)[:, None]
        )
        around, frames, beside = _extents(means, 2 * neighbors, 5 * size)
        found = []
        for at in active:
            row, (a, b, c), n = lines[at], around[cell[at]], frames[cell[at]][2]
            if b < LINE * a or c > LINE * b or a == 0:
                continue
            along = axes[row, 0] - (axes[row, 0] @ n) * n
            if np.linalg.norm(along) <= FLAT:
                continue
            across = np.cross(n, along / np.linalg.norm(along))
            offsets = means[beside[cell[at]]] - points[row]
            sides = []
            for side in (-1, 1):
                away = side * (offsets @ across)
                for i in np.flatnonzero(away > size / 2)[:1]:
                    other = lines[first[beside[cell[at]][i]]]
                    if parallel(row, other) and abs(offsets[i] @ n) <= SLOPE * away[i]:
                        sides.append((away[i], offsets[i], other))
            if len(sides) == 2:
                found.append((row, n, np.mean([s[0] for s in sides])))
            elif sides and row not in edges:
                end[at] = min(end[at], level + 1)
                edges[row] = n, *sides[0]
        for row, n, gap in found:
            inner.add(row)
            turn(row, n, gap)
    for row, (n, gap, offset, other) in edges.items():
        if row not in inner and other in inner:
            own = normals[other]
            if abs(n @ own) > TURNED and abs(offset @ own) <= SLOPE * gap:
                turn(row, n, gap)
    wide, narrow = spread * np.maximum(wide, narrow), spread * np.minimum(wide, narrow)
    narrow = np.maximum(narrow, wide / max_anisotropy)
    return normals, np.stack([wide, narrow, normal_ratio * np.sqrt(wide * narrow)], 1)


def _extents(points, neighbors, reach):
    """Standard deviations (N, 3), descending, axes (N, 3, 3), and rows of neighbours, nearest first."""
    sigmas, axes = np.zeros_like(points), np.tile(np.eye(3), (len(points), 1, 1))
    rows = [np.zeros(0, int)] * len(points)
    for i, p in enumerate(points):
        d2 = ((points - p) ** 2).sum(1)
        order = (
            np.lexsort((np.arange(len(points)), d2))
            if len(points) < 500
            else _first(d2, neighbors + 1)
        )
        near = order[order != i][:neighbors]
        near = near[d2[near] <= reach**2]
        if reach < np.inf and len(near) < neighbors // 4:
            continue
        rows[i] = near
        near = points[np.r_[i, near]] - p
        near = near - near.mean(0)
        values, vectors = np.linalg.eigh(near.T @ near / len(near))
        sigmas[i], axes[i] = np.sqrt(np.maximum(values[::-1], 0)), vectors.T[::-1]
    return sigmas, axes, rows


def _first(d2, count):
    """The rows of the smallest values, by (value, row)."""
    rows = np.flatnonzero(d2 <= np.partition(d2, count - 1)[count - 1])
    return rows[np.lexsort((rows, d2[rows]))]
