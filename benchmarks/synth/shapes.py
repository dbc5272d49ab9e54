"""Convex primitives and their first hits.

A shape is a canonical convex body stretched to an axis-aligned box. A ray's entry and exit are computed in
the body's coordinates q = (p − centre)/half, which keep the ray parameter t.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

__all__ = ["Float", "Kind", "Shapes", "Spans", "cast"]

Float = NDArray[np.float64]

PACKET = 8192
"""Rays per packet: enough to hide NumPy's overhead, few enough for a narrow cone."""

_TINY = 1e-12


class Kind(IntEnum):
    """Canonical bodies in [−1, 1]³, z up."""

    BOX = 0
    ELLIPSOID = 1
    CYLINDER = 2
    CONE = 3  # apex at z = 1
    GABLE_X = 4  # a roof whose ridge runs along x at z = 1
    GABLE_Y = 5


@dataclass(frozen=True, eq=False)
class Shapes:
    """P primitives.

    Args:
        kinds: (P,) `Kind`.
        lo: (P, 3) float64, lower corner of each bounding box, metres.
        hi: (P, 3) float64, upper corner.
    """

    kinds: NDArray[np.int64]
    lo: Float
    hi: Float

    def __len__(self) -> int:
        return len(self.kinds)

    @cached_property
    def centers(self) -> Float:
        return (self.lo + self.hi) / 2

    @cached_property
    def halves(self) -> Float:
        return (self.hi - self.lo) / 2

    def normals(self, points: Float, primitives: NDArray[np.int64]) -> Float:
        """Return (3, n) outward unit normals at points (3, n) on the surfaces of primitives."""
        half = self.halves[primitives].T
        q = (points - self.centers[primitives].T) / half
        normal = np.zeros_like(q)
        kinds = self.kinds[primitives]
        for kind in np.unique(kinds):
            at = np.flatnonzero(kinds == kind)
            normal[:, at] = _NORMALS[kind](q[:, at])
        normal /= half
        return normal / np.linalg.norm(normal, axis=0)


Spans = tuple[Float, Float]
"""Entry and exit parameters of n rays; entry > exit for misses."""


def _quadratic(a: Float, b: Float, c: Float) -> Spans:
    """Return the span of a·t² + 2b·t + c ≤ 0 for a > 0."""
    disc = b * b - a * c
    root = np.sqrt(np.maximum(disc, 0.0))
    miss = disc < 0
    return np.where(miss, np.inf, (-b - root) / a), np.where(miss, -np.inf, (-b + root) / a)


def _slab(o: Float, d: Float) -> Spans:
    """Return the span of −1 ≤ o + t·d ≤ 1; d must not be zero."""
    m, r = -o / d, 1.0 / np.abs(d)
    return m - r, m + r


def _below(level: float, o: Float, d: Float) -> Spans:
    """Return the span of o + t·d ≤ level."""
    t = (level - o) / d
    return np.where(d > 0, -np.inf, t), np.where(d > 0, t, np.inf)


def _both(*spans: Spans) -> Spans:
    enter, leave = spans[0]
    for e, x in spans[1:]:
        enter, leave = np.maximum(enter, e), np.minimum(leave, x)
    return enter, leave


def _box(o: Float, d: Float) -> Spans:
    return _both(*(_slab(o[k], d[k]) for k in range(3)))


def _ellipsoid(o: Float, d: Float) -> Spans:
    return _quadratic((d * d).sum(0), (o * d).sum(0), (o * o).sum(0) - 1.0)


def _cylinder(o: Float, d: Float) -> Spans:
    side = _quadratic((d[:2] ** 2).sum(0), (o[:2] * d[:2]).sum(0), (o[:2] ** 2).sum(0) - 1.0)
    return _both(side, _slab(o[2], d[2]))


def _cone(o: Float, d: Float) -> Spans:
    """Return the span of x² + y² ≤ w², w = (1 − z)/2; steep rays are inside before or after both roots."""
    w, dw = (1.0 - o[2]) / 2, -d[2] / 2
    a = (d[:2] ** 2).sum(0) - dw * dw
    a = np.where(np.abs(a) < _TINY, _TINY, a)
    b = (o[:2] * d[:2]).sum(0) - w * dw
    c = (o[:2] ** 2).sum(0) - w * w
    steep = a < 0
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    t0, t1 = (-b - root) / a, (-b + root) / a
    t0, t1 = np.minimum(t0, t1), np.maximum(t0, t1)
    enter = np.where(steep, np.where(dw > 0, t1, -np.inf), t0)
    leave = np.where(steep, np.where(dw > 0, np.inf, t0), t1)
    miss = ~steep & (b * b < a * c)
    return _both((np.where(miss, np.inf, enter), leave), _slab(o[2], d[2]))


def _gable(o: Float, d: Float, ridge: int) -> Spans:
    across = 1 - ridge
    left = _below(0.5, o[across] + o[2] / 2, _nonzero(d[across] + d[2] / 2))
    right = _below(0.5, o[2] / 2 - o[across], _nonzero(d[2] / 2 - d[across]))
    return _both(left, right, _slab(o[ridge], d[ridge]), _below(1.0, -o[2], -d[2]))


def _nonzero(d: Float) -> Float:
    return np.where(np.abs(d) < _TINY, np.copysign(_TINY, d), d)


_BOX = int(Kind.BOX)
_SPANS: dict[int, Callable[[Float, Float], Spans]] = {
    Kind.BOX: _box,
    Kind.ELLIPSOID: _ellipsoid,
    Kind.CYLINDER: _cylinder,
    Kind.CONE: _cone,
    Kind.GABLE_X: lambda o, d: _gable(o, d, 0),
    Kind.GABLE_Y: lambda o, d: _gable(o, d, 1),
}


def _faces(
    q: Float, residuals: Sequence[Float], normals: Sequence[Sequence[Float | float]]
) -> Float:
    """The normal of the face whose residual is largest, that is: which the point lies on."""
    face = np.argmax(np.stack(residuals), axis=0)
    out = np.zeros_like(q)
    for i, normal in enumerate(normals):
        on = face == i
        for k in range(3):
            out[k, on] = np.broadcast_to(normal[k], on.shape)[on]
    return out


def _box_normal(q: Float) -> Float:
    out = np.zeros_like(q)
    axis = np.argmax(np.abs(q), axis=0)
    column = np.arange(q.shape[1])
    out[axis, column] = np.sign(q[axis, column])
    return out


def _cylinder_normal(q: Float) -> Float:
    mantle = np.hypot(q[0], q[1])
    return _faces(q, [mantle, np.abs(q[2])], [(q[0], q[1], 0.0), (0.0, 0.0, np.sign(q[2]))])


def _cone_normal(q: Float) -> Float:
    w = (1 - q[2]) / 2
    return _faces(q, [np.hypot(q[0], q[1]) - w, -1 - q[2]], [(q[0], q[1], w / 2), (0.0, 0.0, -1.0)])


def _gable_normal(q: Float, ridge: int) -> Float:
    side = np.sign(q[1 - ridge])
    slope: list[Float | float] = [0.0, 0.0, 0.5]
    slope[1 - ridge] = side
    end: list[Float | float] = [0.0, 0.0, 0.0]
    end[ridge] = np.sign(q[ridge])
    residuals = [np.abs(q[1 - ridge]) + q[2] / 2 - 0.5, np.abs(q[ridge]) - 1, -1 - q[2]]
    return _faces(q, residuals, [slope, end, (0.0, 0.0, -1.0)])


_NORMALS: dict[int, Callable[[Float], Float]] = {
    Kind.BOX: _box_normal,
    Kind.ELLIPSOID: lambda q: q,
    Kind.CYLINDER: _cylinder_normal,
    Kind.CONE: _cone_normal,
    Kind.GABLE_X: lambda q: _gable_normal(q, 0),
    Kind.GABLE_Y: lambda q: _gable_normal(q, 1),
}


def _candidates(shapes: Shapes, o: Float, d: Float, far: float) -> tuple[NDArray[np.int64], Float]:
    """Primitives that some ray of the packet may hit within `far`, nearest first, with the least t of each.

    Per axis t·[d_min, d_max] must meet [lo − o_max, hi − o_min]: four linear bounds on t, never too tight.
    """
    enter, leave = np.zeros(len(shapes)), np.full(len(shapes), far)
    for k in range(3):
        near, beyond = shapes.lo[:, k] - o[k].max(), shapes.hi[:, k] - o[k].min()
        for slope, level in ((d[k].max(), near), (-d[k].min(), -beyond)):  # slope·t ≥ level
            if slope > 0:
                np.maximum(enter, level / slope, out=enter)
            elif slope < 0:
                np.minimum(leave, level / slope, out=leave)
            else:
                leave[level > 0] = -1.0
    found = np.flatnonzero(enter <= leave)
    found = found[np.argsort(enter[found], kind="stable")]
    return found, enter[found]


def _cast_packet(shapes: Shapes, o: Float, d: Float, far: float) -> tuple[Float, NDArray[np.int64]]:
    best, hit = np.full(d.shape[1], far), np.full(d.shape[1], -1, np.int64)
    d = _nonzero(d)
    inverse = 1.0 / d
    size = np.abs(inverse)
    kinds, centers, halves = shapes.kinds, shapes.centers[:, :, None], shapes.halves[:, :, None]
    reach = far
    for p, least in zip(*_candidates(shapes, o, d, far), strict=True):
        if least > reach:
            break
        center, half = centers[p], halves[p]
        kind = kinds[p]
        if kind == _BOX:  # most primitives: as `_box`, without a division per ray
            middle, span = (center - o) * inverse, half * size
            enter, leave = (middle - span).max(0), (middle + span).min(0)
        else:
            enter, leave = _SPANS[kind]((o - center) / half, d / half)
        # Where a ray may start within, it meets the exit.
        t = enter if least > 0 else np.where(enter > 0, enter, leave)
        nearer = np.flatnonzero((enter <= leave) & (t > 0) & (t < best))
        if len(nearer):
            best[nearer] = t[nearer]
            hit[nearer] = p
            reach = best.max()
    best[hit < 0] = np.inf
    return best, hit


def cast(
    shapes: Shapes, origins: Float, directions: Float, *, far: float = np.inf, packet: int = PACKET
) -> tuple[Float, NDArray[np.int64]]:
    """First hits. Rays that follow one another should be alike: each packet tests what its bounds may meet.

    Args:
        shapes: the primitives.
        origins: (3, n) or (3, 1) float64.
        directions: (3, n) float64; t is in units of their length.
        far: hits beyond this t do not count.
        packet: rays tested together.

    Returns:
        t (n,) float64, inf for a miss; primitive (n,), −1 for a miss. From within a body, t is the exit.
    """
    n = directions.shape[1]
    t, hit = np.empty(n), np.empty(n, np.int64)
    for i in range(0, n, packet):
        part = slice(i, i + packet)
        o = origins if origins.shape[1] == 1 else origins[:, part]
        t[part], hit[part] = _cast_packet(shapes, o, directions[:, part], far)
    return t, hit
