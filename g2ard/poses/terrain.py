"""Coarse height map of the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_BLOCKS = 24
"""Blocks along the longer side, each with one height."""

_LOW = 0.25
"""Quantile of the heights in a block that is its ground: plants stand on it, noise lies below."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights at the centres of square blocks, from the corner `low`."""

    low: Floats
    block: float
    heights: Floats

    @classmethod
    def of(cls, points: Floats, weights: Floats, box: Floats) -> Terrain:
        """Estimate the ground as a low quantile of the heights per block, with roofs and canopies cut off.

        Args:
            points: (M, 3) matter that faces up or down, z up.
            weights: (M,) its mass.
            box: (2, 3) the scene's extents.
        """
        sides = np.maximum(box[1, :2] - box[0, :2], 1e-6)
        block = float(sides.max()) / _BLOCKS
        shape = np.maximum(1, np.ceil(sides / block - 1e-9)).astype(int)
        place = np.floor((points[:, :2] - box[0, :2]) / block).astype(int)
        inside = ((place >= 0) & (place < shape)).all(axis=1)
        cell = place[inside, 0] * shape[1] + place[inside, 1]
        heights = _low(cell, points[inside, 2], weights[inside], int(np.prod(shape))).reshape(shape)
        return cls(box[0, :2], block, _opened(_filled(heights, box[0, 2])))

    def height(self, points: Floats) -> Floats:
        """Return (M,) ground heights under points: bilinear within the map, constant beyond its edge."""
        top = np.array(self.heights.shape) - 1
        place = np.clip((points[:, :2] - self.low) / self.block - 0.5, 0, top)
        base = np.minimum(np.floor(place).astype(int), np.maximum(top - 1, 0))
        share = place - base
        after = np.minimum(base + 1, top)
        near = self._row(base[:, 0], base[:, 1], after[:, 1], share[:, 1])
        far = self._row(after[:, 0], base[:, 1], after[:, 1], share[:, 1])
        return near + share[:, 0] * (far - near)

    def _row(
        self, x: NDArray[np.int64], y0: NDArray[np.int64], y1: NDArray[np.int64], share: Floats
    ) -> Floats:
        first = self.heights[x, y0]
        return first + share * (self.heights[x, y1] - first)


def _low(cell: NDArray[np.int64], heights: Floats, weights: Floats, count: int) -> Floats:
    """Return (count,) heights below which a quarter of each cell's weight lies; NaN in empty cells."""
    order = np.lexsort((heights, cell))
    cell, heights, weights = cell[order], heights[order], weights[order]
    total = np.bincount(cell, weights, count)
    passed = np.cumsum(weights)
    before = np.concatenate([[0.0], np.cumsum(total)[:-1]])
    found = np.full(count, np.nan)
    at = np.flatnonzero(passed - before[cell] >= _LOW * total[cell])
    found[cell[at[::-1]]] = heights[at[::-1]]  # the first of each cell is written last
    return found


def _filled(heights: Floats, default: float) -> Floats:
    """Fill gaps with the mean of their neighbours, ring by ring."""
    if np.isnan(heights).all():
        return np.full_like(heights, default)
    while (gaps := np.isnan(heights)).any():
        around = _around(heights, np.nan)
        known = ~np.isnan(around)
        count = known.sum(axis=0)
        mean = np.where(known, around, 0).sum(axis=0) / np.maximum(count, 1)
        heights = np.where(gaps & (count > 0), mean, heights)
    return heights


def _opened(heights: Floats) -> Floats:
    """Cut off bumps narrower than three blocks, then smooth."""
    lowest = _around(heights, np.inf).min(axis=0)
    opened = _around(lowest, -np.inf).max(axis=0)
    return _around(opened, None).mean(axis=0)


def _around(heights: Floats, outside: float | None) -> Floats:
    """Return (9, X, Y), each cell's neighbourhood, padded with `outside`; None repeats the edge."""
    if outside is None:
        wide = np.pad(heights, 1, mode="edge")
    else:
        wide = np.pad(heights, 1, constant_values=outside)
    x, y = heights.shape
    return np.stack([wide[a : a + x, b : b + y] for a in range(3) for b in range(3)])
