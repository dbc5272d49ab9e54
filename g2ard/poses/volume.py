"""What poses are planned on: where a scene's opaque matter is, free of outliers, in units of its own size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.poses.numbers import canonical_order, middle, norms, quantile
from g2ard.scene.splats import Splats

Floats = NDArray[np.float64]

_FAR = 7.0
"""Floaters and sky: farther from the middle than this many times the radius of two thirds of the rows."""

_WIDEST = 16.0
"""No Gaussian weighs more than this many median ones, or a sky of a few hundred would outweigh the rest."""

_SAMPLE = 200_000
"""Rows that statistics look at; the occupancy grid takes all."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A fair sample of the matter, at most 200,000 rows.

    Args:
        points: (K, 3) means.
        weights: (K,) mass.
        normals: (K, 3) unit axes of the smallest scales, sign arbitrary.
        flatness: (K,) 1 − smallest / middle scale.
    """

    points: Floats
    weights: Floats
    normals: Floats
    flatness: Floats

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: Any) -> Sample:
        """The rows that a mask, a slice or indices select."""
        return Sample(self.points[rows], self.weights[rows], self.normals[rows], self.flatness[rows])


@dataclass(frozen=True, eq=False)
class OccupiedVolume:
    """Opaque Gaussians: scene = origin + size·points.

    The rows stand in an order that depends on their values alone, and each prefix is a fair sample.

    Args:
        points: (M, 3) means.
        weights: (M,) mass: opacity × area of the two largest scales, capped; the median area counts as 1.
        scales: (M, 3) standard deviations, ascending.
        quats: (M, 4) and `order`, (M, 3), which axis of the rotation each scale belongs to.
        opacities: (M,) in (0, 1].
        origin: (3,) relative to the scene's offset.
        size: scene units per unit here: half the diagonal of the box that holds 98 % along each axis.
        represents: how many Gaussians each row stands for: more than 1 in a sample.
    """

    points: Floats
    weights: Floats
    scales: Floats
    quats: NDArray[np.float32]
    order: NDArray[Any]
    opacities: Floats
    origin: Floats
    size: float
    represents: float = 1.0

    @classmethod
    def of(cls, splats: Splats, limit: int | None = None, represents: float = 1.0) -> OccupiedVolume:
        """Weigh a scene's rows, leave out what is invisible or far off, and normalise the rest.

        Of more than `limit` rows only a fair sample is looked at; the scene itself may be one, of which every
        row represents so many.

        Raises:
            InputError: nothing is visible.
        """
        opacities = splats.opacities.astype(np.float64)
        rows = np.flatnonzero(opacities > 1 / 255)
        visible = len(rows)
        rows = rows[canonical_order(splats, rows)[:limit]]
        represents *= visible / max(1, len(rows))
        if len(rows):
            rows = rows[splats.take(rows).finite_rows()]
        opacities = opacities[rows]
        means = splats.means[rows].astype(np.float64)
        scales = np.abs(splats.scales[rows])
        order = np.argsort(scales, axis=1, kind="stable")
        scales = np.take_along_axis(scales, order, axis=1).astype(np.float64)
        areas = scales[:, 1] * scales[:, 2]
        if not (areas > 0).any():
            raise InputError(
                "the scene has nothing to look at: no visible Gaussian with a surface; give views of it"
            )
        weights = opacities * np.minimum(areas / middle(areas[areas > 0]), _WIDEST)
        near = _near(means, opacities)
        origin, size = _frame(means[near][:_SAMPLE], weights[near][:_SAMPLE], scales[near][:_SAMPLE])
        return cls(
            points=(means[near] - origin) / size,
            weights=weights[near],
            scales=scales[near] / size,
            quats=splats.quats[rows[near]],
            order=order[near],
            opacities=opacities[near],
            origin=origin,
            size=size,
            represents=represents,
        )

    def sample(self) -> Sample:
        """The first rows, with their normals."""
        some = slice(_SAMPLE)
        thick = np.maximum(self.scales[some, 1], np.finfo(float).tiny)
        normals = self._axis(some, 0)
        return Sample(self.points[some], self.weights[some], normals, 1 - self.scales[some, 0] / thick)

    def spans(self, rows: Any) -> Floats:
        """(m, 2, 3) the two largest axes of some rows, times their scales."""
        return np.stack([self._axis(rows, k) * self.scales[rows, k, None] for k in (1, 2)], axis=1)

    def _axis(self, rows: Any, rank: int) -> Floats:
        """Unit axes of the `rank`-th scales: columns of the rotations."""
        q, column = self.quats[rows].astype(np.float64), self.order[rows, rank]
        length = norms(q)
        q[length == 0] = (1, 0, 0, 0)
        w, x, y, z = (q / np.where(length == 0, 1, length)[:, None]).T
        axes = np.empty((len(q), 3))
        for k, (a, b, c) in enumerate(
            [
                (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
                (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
                (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
            ]
        ):
            mine = column == k
            axes[mine] = np.stack([a[mine], b[mine], c[mine]], axis=1)
        return axes


def _near(means: Floats, weights: Floats) -> NDArray[np.bool_]:
    """Rows within `_FAR` usual distances of the middle, found again once the farthest are out.

    Weighed by opacity alone: a sky is few rows and much area.
    """
    near = np.ones(len(means), bool)
    for _ in range(4):
        some = np.flatnonzero(near)[:_SAMPLE]
        centre = np.array([quantile(means[some, a], weights[some], 0.5) for a in range(3)])
        distances = norms(means - centre)
        within = distances <= _FAR * float(quantile(distances[some], weights[some], 2 / 3))
        if (within == near).all():
            break
        near = within
    return near


def _frame(means: Floats, weights: Floats, scales: Floats) -> tuple[Floats, float]:
    box = np.array([quantile(means[:, a], weights, [0.01, 0.99]) for a in range(3)])
    size = float(norms((box[:, 1] - box[:, 0])[None])[0]) / 2
    return box.mean(axis=1), max(size, 2 * middle(scales[:, 2]))  # one Gaussian is as large as its body
