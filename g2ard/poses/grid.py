"""Occupancy grid of a box: opaque cells, distances to the nearest one, and ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.poses.matter import Matter
from g2ard.poses.numbers import norms, turned

Floats = NDArray[np.float64]

_CELLS = (2_000_000, 6_000_000)
"""Least and most cells, with one per Gaussian in between: larger scenes get finer grids."""

_CELLS_A_ROW = 5
"""Cells per row if the rows are a sample of a larger scene."""

_OPAQUE = 0.3
"""Opacity × area per face of a cell, summed: above it, hardly any light passes."""

_MURKY = 0.04
"""The same sum above which a cell holds leaves, glass or haze, and no camera may stand."""

_LEAST_SIDE = 1 / 256
"""Least side of the box as a share of its longest side, so that a flat scene has a thickness."""

_HALF_WIDTH = 1.6
"""Standard deviations from its centre within which a Gaussian fills cells, 89 % of it."""

_PARTS = 9
"""Most sample points along an axis for a Gaussian wider than a cell."""

_REACH = 12
"""Largest distance stored, in cells: enough for rays to stride through free space."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Axis-aligned cells from `low`, each of side `cell`.

    Args:
        low: (3,) corner.
        cell: side.
        opaque: (X, Y, Z) int8 king's moves to the nearest cell that stops light, at most `_REACH`.
        murky: the same, to the nearest cell that is not almost empty.
        scale: (X, Y, Z) float32, geometric mean of the two longer standard deviations of the Gaussians in a
            cell; 0 in empty cells.
    """

    low: Floats
    cell: float
    opaque: NDArray[np.int8]
    murky: NDArray[np.int8]
    scale: NDArray[np.float32]

    @classmethod
    def of(cls, low: Floats, high: Floats, matter: Matter, axes: Floats, *, cells: int = 0) -> Grid:
        """Fill the box from `low` to `high`, along the rows of `axes`; `cells` of 0 follows the rows."""
        if matter.represents > 1:
            cells = cells or _CELLS_A_ROW * len(matter.points)
        cells = cells or int(np.clip(len(matter.points), *_CELLS))
        sides = np.maximum(high - low, np.max(high - low) * _LEAST_SIDE)
        cell = float(np.cbrt(np.prod(sides) / cells))
        shape = np.maximum(1, np.ceil(sides / cell)).astype(int)
        points = turned(matter.points, axes)
        filled, logs = np.zeros(int(np.prod(shape))), np.zeros(int(np.prod(shape)))
        sizes = 0.5 * np.log(np.maximum(matter.scales[:, 1] * matter.scales[:, 2], np.finfo(float).tiny))
        faces = 2 * np.pi * matter.scales[:, 1] * matter.scales[:, 2] / cell**2
        optical = matter.represents * matter.opacities * faces
        parts = np.clip(np.ceil(_HALF_WIDTH * matter.scales[:, 2] / cell), 1, _PARTS).astype(np.int8)
        for count in np.unique(parts):
            rows, spans = np.flatnonzero(parts == count), np.zeros((1, 2, 3))
            if count > 1:
                spans = matter.axes(rows)[:, 1:] * matter.scales[rows, 1:, None]
                spans = turned(spans.reshape(-1, 3), axes).reshape(-1, 2, 3)
            for a, b in _lattice(int(count)):
                index, inside = _index(points[rows] + a * spans[:, 0] + b * spans[:, 1], low, cell, shape)
                share, size = optical[rows[inside]] / count**2, sizes[rows[inside]]
                np.add.at(filled, index[inside], share)
                np.add.at(logs, index[inside], share * size)
        scale = np.where(filled > 0, np.exp(logs / np.where(filled > 0, filled, 1)), 0).astype(np.float32)
        opaque, murky = (_steps((filled > limit).reshape(shape)) for limit in (_OPAQUE, _MURKY))
        return cls(low, cell, opaque, murky, scale.reshape(shape))

    def distance(self, points: Floats) -> Floats:
        """Return (M,) distances to the nearest murky cell, or to the box if that is farther.

        Distances within the box are at most `_REACH` − 1 cells.
        """
        index, inside = _index(points, self.low, self.cell, np.array(self.murky.shape))
        found = np.maximum(self.murky.ravel()[index].astype(np.float64) - 1, 0) * self.cell
        high = self.low + self.cell * np.array(self.murky.shape)
        outside = norms(np.maximum(0, np.maximum(self.low - points, points - high)))
        return np.where(inside, found, np.maximum(outside, found))

    def scale_at(self, points: Floats) -> Floats:
        """Return (M,) values of `scale` in the cells of points, 0 outside the box."""
        index, inside = _index(points, self.low, self.cell, np.array(self.murky.shape))
        return np.where(inside, self.scale.ravel()[index], 0.0)

    def cast(self, eyes: Floats, directions: Floats, *, murky: bool = False) -> Floats:
        """Return (M,) distances at which unit rays meet an opaque or a murky cell; inf without one."""
        steps = self.murky if murky else self.opaque
        return _core.cast_rays(
            steps.ravel(),
            list(steps.shape),
            self.low.tolist(),
            self.cell,
            np.ascontiguousarray(eyes, np.float64),
            np.ascontiguousarray(directions, np.float64),
        )


def _lattice(count: int) -> Floats:
    """Return (count², 2) offsets, in standard deviations, that sample a Gaussian wider than a cell."""
    line = _HALF_WIDTH * ((np.arange(count) + 0.5) / count * 2 - 1)
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)


def _index(points: Floats, low: Floats, cell: float, shape: NDArray[Any]) -> tuple[Any, NDArray[np.bool_]]:
    """Return flat cell indices, clamped into the box, and whether each point was in it."""
    flat, inside = np.zeros(len(points), np.int64), np.ones(len(points), bool)
    for axis in range(3):
        place = np.floor((points[:, axis] - low[axis]) / cell)
        inside &= (place >= 0) & (place < shape[axis])
        flat = flat * shape[axis] + np.clip(place, 0, shape[axis] - 1).astype(np.int64)
    return flat, inside


def _steps(filled: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Return king's moves to the nearest filled cell, at most `_REACH`."""
    steps = np.where(filled, 0, _REACH).astype(np.int8)
    for reach in range(1, _REACH):
        for axis in range(3):
            wider = filled.copy()
            after, before = (np.moveaxis(cells, axis, 0) for cells in (wider, filled))
            after[1:] |= before[:-1]
            after[:-1] |= before[1:]
            filled = wider
        steps[filled & (steps == _REACH)] = reach
    return steps
