"""What poses are planned on: where a scene's opaque matter is, free of outliers, in units of its own size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.splats import Splats

__all__ = ["Matter", "along", "moments", "quantile"]

Floats = NDArray[np.float64]

_FAR = 8.0
"""Floaters and sky: farther from the middle than this many median distances."""

_WIDEST = 16.0
"""No Gaussian weighs more than this many median ones, or a sky of a few hundred would outweigh the rest."""

_SAMPLE = 300_000
"""Rows that statistics look at; the occupancy grid takes all."""


@dataclass(frozen=True, eq=False)
class Matter:
    """Opaque Gaussians in scene units about `origin`: scene = origin + size·points.

    The rows stand in an order that depends on their values alone, and each prefix is a fair sample.

    Args:
        points: (M, 3) means.
        weights: (M,) opacity × area of the two largest scales, capped; the median area counts as 1.
        normals: (M, 3) unit axes of the smallest scales, sign arbitrary.
        flatness: (M,) 1 − smallest / middle scale.
        spans: (M, 2, 3) the two largest axes times their scales.
        opacities: (M,) in (0, 1].
        origin: (3,) relative to the scene's offset.
        size: scene units per unit here: half the diagonal of the box that holds 98 % along each axis.
    """

    points: Floats
    weights: Floats
    normals: Floats
    flatness: Floats
    spans: Floats
    opacities: Floats
    origin: Floats
    size: float

    @classmethod
    def of(cls, splats: Splats) -> Matter:
        """Weigh a scene's rows, leave out what is invisible or far off, and normalise the rest.

        Raises:
            InputError: nothing is visible, or all of it lies in one point.
        """
        rows = np.flatnonzero(splats.finite_rows() & (splats.opacities > 1 / 255))
        rows = rows[_order(splats, rows)]
        means = splats.means[rows].astype(np.float64)
        scales = np.abs(splats.scales[rows].astype(np.float64))
        opacities = splats.opacities[rows].astype(np.float64)
        areas = np.prod(np.sort(scales, axis=1)[:, 1:], axis=1)
        if not (areas > 0).any():
            raise InputError("the scene has nothing visible to look at: no opaque Gaussian with a surface")
        typical = _middle(areas[areas > 0])
        weights = opacities * np.minimum(areas / typical, _WIDEST)
        near = _near(means, weights)
        means, weights, scales = means[near], weights[near], scales[near]
        origin, size = _frame(means, weights, scales)
        axes, order = _axes(splats.quats[rows[near]]), np.argsort(scales, axis=1, kind="stable")
        axes = np.take_along_axis(axes, order[:, None, :], axis=2)
        scales = np.take_along_axis(scales, order, axis=1)
        middle = np.maximum(scales[:, 1], np.finfo(float).tiny)
        return cls(
            points=(means - origin) / size,
            weights=weights,
            normals=np.ascontiguousarray(axes[:, :, 0]),
            flatness=1 - scales[:, 0] / middle,
            spans=np.swapaxes(axes[:, :, 1:] * (scales[:, None, 1:] / size), 1, 2),
            opacities=opacities[near],
            origin=origin,
            size=size,
        )

    def sample(self) -> Matter:
        """At most 300,000 rows, enough for statistics."""
        if len(self.points) <= _SAMPLE:
            return self
        part: dict[str, Any] = {
            name: getattr(self, name)[:_SAMPLE]
            for name in ("points", "weights", "normals", "flatness", "spans", "opacities")
        }
        return Matter(**part, origin=self.origin, size=self.size)


def quantile(values: Floats, weights: Floats, shares: Any) -> Floats:
    """The values below which the given shares of the weight lie.

    >>> quantile(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 2.0]), [0.2, 0.5, 1.0]).tolist()
    [1.0, 2.0, 3.0]
    """
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    at = np.searchsorted(total, np.asarray(shares) * total[-1])
    return values[order][np.minimum(at, len(order) - 1)]


def along(vectors: Floats, axis: Floats) -> Floats:
    """(M,) dot products, the same bits whatever the threads of the linear algebra library do."""
    return vectors[:, 0] * axis[0] + vectors[:, 1] * axis[1] + vectors[:, 2] * axis[2]


def moments(vectors: Floats, weights: Floats) -> Floats:
    """(3, 3) weighted sum of outer products, likewise."""
    return np.array([[(weights * a * b).sum() for b in vectors.T] for a in vectors.T])


def _order(splats: Splats, rows: NDArray[Any]) -> NDArray[Any]:
    """By a hash of what moving and scaling a scene leaves alone; then by place and size.

    Sums run in this order, so the order of the file's rows does not show in the last bit of any pose.
    """
    columns = [splats.logit_opacities[rows], *splats.quats[rows].T, *splats.sh0[rows, 0].T]
    key = np.zeros(len(rows), np.uint64)
    for column in columns:
        bits = (np.ascontiguousarray(column, np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64)
        key = (key ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    order = np.argsort(key, kind="stable")
    if not (np.diff(key[order]) == 0).any():
        return order
    last = [*splats.scales[rows].T, *splats.means[rows].T[::-1]]
    return np.lexsort([*last, key])


def _middle(values: Floats) -> float:
    rank = (len(values) - 1) // 2
    return float(np.partition(values, rank)[rank])


def _near(means: Floats, weights: Floats) -> NDArray[np.bool_]:
    """Rows within `_FAR` median distances of the middle, found again once the farthest are out."""
    near = np.ones(len(means), bool)
    for _ in range(3):
        some = np.flatnonzero(near)[:_SAMPLE]
        centre = np.array([quantile(means[some, a], weights[some], 0.5) for a in range(3)])
        distances = np.linalg.norm(means - centre, axis=1)
        half = float(quantile(distances[some], weights[some], 0.5))
        within = distances <= _FAR * half
        if (within == near).all():
            break
        near = within
    return near


def _frame(means: Floats, weights: Floats, scales: Floats) -> tuple[Floats, float]:
    some = slice(_SAMPLE)
    box = np.array([quantile(means[some, a], weights[some], [0.01, 0.99]) for a in range(3)])
    size = float(np.linalg.norm(box[:, 1] - box[:, 0])) / 2
    size = max(size, 2 * _middle(scales.max(axis=1)))  # a single Gaussian is as large as its body
    return box.mean(axis=1), size


def _axes(quats: NDArray[np.float32]) -> Floats:
    """(M, 3, 3) rotation matrices; columns are the Gaussians' axes."""
    q = quats.astype(np.float64)
    length = np.linalg.norm(q, axis=1)
    q[length == 0] = (1, 0, 0, 0)
    w, x, y, z = (q / np.where(length == 0, 1, length)[:, None]).T
    R = np.empty((len(q), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R
