"""Coarse height map of the ground."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.numbers import quantile

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
        cell = np.where(inside, place[:, 0] * shape[1] + place[:, 1], -1)
        rows = np.argsort(cell, kind="stable")
        starts = np.searchsorted(cell[rows], np.arange(np.prod(shape) + 1))
        heights = np.full(int(np.prod(shape)), np.nan)
        for k, (start, stop) in enumerate(pairwise(starts)):
            if stop > start:
                some = rows[start:stop]
                heights[k] = quantile(points[some, 2], weights[some], _LOW)
        heights = _filled(heights.reshape(shape), box[0, 2])
        lowest = _around(heights, np.inf).min(axis=0)
        opened = _around(lowest, -np.inf).max(axis=0)  # without bumps narrower than three blocks
        padded = np.pad(opened, 1, mode="edge")
        return cls(box[0, :2], block, _around(padded, 0.0).mean(axis=0)[1:-1, 1:-1])

    def height(self, points: Floats) -> Floats:
        """Return (M,) ground heights under points: bilinear within the map, constant beyond its edge."""
        top = np.array(self.heights.shape) - 1
        place = np.clip((points[:, :2] - self.low) / self.block - 0.5, 0, top)
        base = np.floor(place).astype(int)
        share, total = place - base, np.zeros(len(points))
        for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
            x, y = np.minimum(base + step, top).T
            total += np.where(step, share, 1 - share).prod(axis=1) * self.heights[x, y]
        return total


def _filled(heights: Floats, default: float) -> Floats:
    """Fill gaps with the mean of their neighbours, ring by ring."""
    if np.isnan(heights).all():
        return np.full_like(heights, default)
    while (gaps := np.isnan(heights)).any():
        around = _around(heights, np.nan)
        count = (~np.isnan(around)).sum(axis=0)
        heights = np.where(gaps & (count > 0), np.nansum(around, axis=0) / np.maximum(count, 1), heights)
    return heights


def _around(heights: Floats, outside: float) -> Floats:
    """Return (9, X, Y), the neighbourhood of each cell, padded with `outside`."""
    wide = np.pad(heights, 1, constant_values=outside)
    x, y = heights.shape
    return np.stack([wide[a : a + x, b : b + y] for a in range(3) for b in range(3)])
