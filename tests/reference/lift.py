"""The lift, naively: brute-force neighbours, numpy's eigen-solver, float64 throughout."""

import numpy as np


def discs(points, neighbors=10, normal_ratio=0.1, max_anisotropy=4.0, spread=0.94):
    """(normals (N, 3), scales (N, 3)) of points whose neighbourhoods all have an extent."""
    points = np.asarray(points, np.float64)
    normals, scales = np.empty_like(points), np.empty_like(points)
    for i, p in enumerate(points):
        d2 = ((points - p) ** 2).sum(1)
        order = np.lexsort((np.arange(len(points)), d2))
        near = points[np.r_[i, order[order != i][:neighbors]]] - p
        near = near - near.mean(0)
        values, vectors = np.linalg.eigh(near.T @ near / len(near))
        wide, narrow = spread * np.sqrt(np.maximum(values[[2, 1]], 0))
        narrow = max(narrow, wide / max_anisotropy)
        normals[i] = vectors[:, 0]
        scales[i] = wide, narrow, normal_ratio * np.sqrt(wide * narrow)
    return normals, scales
