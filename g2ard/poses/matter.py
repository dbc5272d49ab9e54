"""Opaque matter of a scene, free of outliers, in units of the scene's own size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.poses.numbers import canonical_order, middle, norms, quantile
from g2ard.scene.splats import Splats
from g2ard.scene.transform import rotation_matrices

Floats = NDArray[np.float64]

_FAR = 7.0
"""Distance of floaters and sky from the centre, as a multiple of the radius of two thirds of the opacity."""

_WIDEST = 16.0
"""Largest area that counts, in median areas; otherwise a sky of a few hundred rows outweighs the rest."""

_SAMPLE = 200_000
"""Rows used for statistics; the occupancy grid uses all."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A fair sample of the matter, at most 200,000 rows.

    Args:
        points: (K, 3) means.
        weights: (K,) mass.
        normals: (K, 3) unit axes of the smallest scales, sign arbitrary.
        faces: (K,) mass × flatness, where flatness is 1 − smallest / middle scale.
    """

    points: Floats
    weights: Floats
    normals: Floats
    faces: Floats

    def take(self, rows: Any) -> Sample:
        """Return the rows that a mask, a slice or indices select."""
        return Sample(self.points[rows], self.weights[rows], self.normals[rows], self.faces[rows])


@dataclass(frozen=True, eq=False)
class Matter:
    """Opaque Gaussians of a scene: scene = origin + size·points.

    The order of the rows depends on their values alone, and each prefix is a fair sample.

    Args:
        points: (M, 3) means.
        weights: (M,) mass: opacity × area of the two largest scales, capped; the median area counts as 1.
        scales: (M, 3) standard deviations, ascending.
        quats: (M, 4) rotations.
        order: (M, 3) the axis of the rotation that each scale belongs to.
        opacities: (M,) in (0, 1].
        origin: (3,) relative to the scene's offset.
        size: scene units per unit here: half the diagonal of the box that holds 98 % along each axis.
        represents: Gaussians per row, more than 1 in a sample.
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
    def of(cls, splats: Splats, limit: int | None = None, represents: float = 1.0) -> Matter:
        """Weigh a scene's rows, drop invisible and distant ones, and normalise the rest.

        Args:
            splats: the scene, or a fair sample of it.
            limit: largest number of rows, taken as a fair sample; None means all.
            represents: Gaussians per row of `splats`.

        Raises:
            InputError: nothing is visible.
        """
        rows = np.flatnonzero(splats.opacities > 1 / 255)
        visible = len(rows)
        rows = rows[canonical_order(splats, rows)[:limit]]
        represents *= visible / max(1, len(rows))
        if len(rows):
            rows = rows[splats.take(rows).finite_rows()]
        opacities = splats.opacities[rows].astype(np.float64)
        means = splats.means[rows].astype(np.float64)
        scales = np.abs(splats.scales[rows])
        order = np.argsort(scales, axis=1, kind="stable")
        scales = np.take_along_axis(scales, order, axis=1).astype(np.float64)
        areas = scales[:, 1] * scales[:, 2]
        if not (areas > 0).any():
            raise InputError(
                "the scene has no visible Gaussian with a surface, so no poses can be planned; give views"
            )
        weights = opacities * np.minimum(areas / middle(areas[areas > 0]), _WIDEST)
        near = _near(means, opacities)
        some = np.flatnonzero(near)[:_SAMPLE]
        box = np.array([quantile(means[some, a], weights[some], [0.01, 0.99]) for a in range(3)])
        size = float(norms((box[:, 1] - box[:, 0])[None])[0]) / 2
        size = max(size, 2 * middle(scales[some, 2]))  # a single Gaussian also needs a size
        origin = box.mean(axis=1)
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
        """Return the first rows with their normals."""
        some = slice(_SAMPLE)
        thick = np.maximum(self.scales[some, 1], np.finfo(float).tiny)
        faces = self.weights[some] * (1 - self.scales[some, 0] / thick)
        return Sample(self.points[some], self.weights[some], self.axes(some)[:, 0], faces)

    def axes(self, rows: Any) -> Floats:
        """Return (m, 3, 3) the unit axes of some rows, by ascending scale."""
        axes = rotation_matrices(self.quats[rows]).swapaxes(1, 2)
        return np.take_along_axis(axes, self.order[rows][:, :, None], axis=1)


def _near(means: Floats, weights: Floats) -> NDArray[np.bool_]:
    """Return the rows within `_FAR` typical distances of the centre, repeated after dropping the farthest.

    Rows are weighed by opacity alone, because a sky has few rows and much area.
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
