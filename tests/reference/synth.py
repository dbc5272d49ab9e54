"""A naive ray caster, one face at a time, float64: no intervals, no packets, no bounding boxes."""

import numpy as np

from benchmarks.synth.shapes import Kind, Shapes


def first_hits(
    shapes: Shapes, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return t (n,) and primitive (n,) of the first hits of rays (n, 3); inf and −1 without a hit."""
    best, hit = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for p in range(len(shapes)):
        for t in _crossings(Kind(shapes.kinds[p]), shapes.lo[p], shapes.hi[p], origins, directions):
            nearer = np.isfinite(t) & (t > 0) & (t < best)
            best[nearer], hit[nearer] = t[nearer], p
    return best, hit


def surface_distance(kind: Kind, lo: np.ndarray, hi: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) metres from points (n, 3) to a primitive's surface, to first order for curved ones."""
    center, half = (lo + hi) / 2, (hi - lo) / 2
    local = points - center
    if kind == Kind.BOX:
        q = np.abs(local) - half
        return np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0))
    q = local / half
    r = np.maximum(np.hypot(q[:, 0], q[:, 1]), 1e-9)
    if kind == Kind.ELLIPSOID:
        norm = np.linalg.norm(q, axis=1)
        return np.abs(norm - 1) / np.linalg.norm(q / half / norm[:, None], axis=1)
    if kind == Kind.CYLINDER:
        faces = [(r - 1) * half[0], (np.abs(q[:, 2]) - 1) * half[2]]
    elif kind == Kind.CONE:
        slope = np.hypot(1 / half[0], 0.5 / half[2])
        faces = [(r - (1 - q[:, 2]) / 2) / slope, (-1 - q[:, 2]) * half[2]]
    else:
        ridge = 0 if kind == Kind.GABLE_X else 1
        slope = np.hypot(1 / half[1 - ridge], 0.5 / half[2])
        faces = [
            (np.abs(q[:, 1 - ridge]) + q[:, 2] / 2 - 0.5) / slope,
            (np.abs(q[:, ridge]) - 1) * half[ridge],
            (-1 - q[:, 2]) * half[2],
        ]
    return np.abs(np.max(faces, axis=0))


def _crossings(kind, lo, hi, o, d):
    """Every t at which each ray crosses the surface, NaN where it does not."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if kind == Kind.BOX:
            return _box(lo, hi, o, d)
        if kind in (Kind.GABLE_X, Kind.GABLE_Y):
            return [
                _triangle(*corners, o, d)
                for corners in _roof(lo, hi, 0 if kind == Kind.GABLE_X else 1)
            ]
        return _round(kind, (lo + hi) / 2, (hi - lo) / 2, o, d)


def _box(lo, hi, o, d):
    out = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for level in (lo[axis], hi[axis]):
            t = (level - o[:, axis]) / d[:, axis]
            p = o + t[:, None] * d
            on = (p[:, u] >= lo[u]) & (p[:, u] <= hi[u]) & (p[:, v] >= lo[v]) & (p[:, v] <= hi[v])
            out.append(np.where(on, t, np.nan))
    return out


def _round(kind, center, half, o, d):
    o, d = (o - center) / half, d / half
    if kind == Kind.ELLIPSOID:
        terms = [(1, 0)] * 3
    else:
        terms = [(1, 0)] * 2
    a = sum(d[:, k] ** 2 for k in range(len(terms)))
    b = sum(2 * o[:, k] * d[:, k] for k in range(len(terms)))
    c = sum(o[:, k] ** 2 for k in range(len(terms)))
    if kind == Kind.CONE:  # radius (1 − z)/2
        w, dw = (1 - o[:, 2]) / 2, -d[:, 2] / 2
        a, b, c = a - dw**2, b - 2 * w * dw, c - w**2
    else:
        c = c - 1
    root = np.sqrt(b * b - 4 * a * c)
    out = []
    for t in ((-b - root) / (2 * a), (-b + root) / (2 * a)):
        z = o[:, 2] + t * d[:, 2]
        out.append(t if kind == Kind.ELLIPSOID else np.where(np.abs(z) <= 1, t, np.nan))
    if kind != Kind.ELLIPSOID:
        for level in (-1.0, 1.0) if kind == Kind.CYLINDER else (-1.0,):
            t = (level - o[:, 2]) / d[:, 2]
            p = o + t[:, None] * d
            out.append(np.where(p[:, 0] ** 2 + p[:, 1] ** 2 <= 1, t, np.nan))
    return out


def _roof(lo, hi, ridge):
    """The eight triangles of a gable roof."""
    across = 1 - ridge
    middle = (lo[across] + hi[across]) / 2

    def corner(along, side, height):
        p = np.zeros(3)
        p[ridge], p[across], p[2] = along, side, height
        return p

    a, b = (
        [corner(e, s, z) for s, z in ((lo[across], lo[2]), (hi[across], lo[2]), (middle, hi[2]))]
        for e in (lo[ridge], hi[ridge])
    )
    quads = [(a[0], a[2], b[2], b[0]), (a[1], a[2], b[2], b[1]), (a[0], a[1], b[1], b[0])]
    yield from ((a[0], a[1], a[2]), (b[0], b[1], b[2]))
    for p, q, r, s in quads:
        yield from ((p, q, r), (p, r, s))


def _triangle(a, b, c, o, d):
    e, f = b - a, c - a
    h = np.cross(d, f)
    scale = 1 / (h @ e)
    s = o - a
    u = scale * (s * h).sum(1)
    q = np.cross(s, e)
    v = scale * (d * q).sum(1)
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1), scale * (q @ f), np.nan)
