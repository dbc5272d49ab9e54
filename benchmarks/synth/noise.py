"""Patterns averaged over a pixel's footprint: periodic bands in closed form, and fading value noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Noise", "band", "hash01", "ramp"]

Array = NDArray[Any]

_SIDE = 256


def hash01(*keys: Array | int) -> Array:
    """Hash tuples of integers to [0, 1), equally on every machine.

    >>> hash01(np.array([1, 2]), 7).round(3).tolist()
    [0.647..., 0.486...]
    """
    h: Array = np.asarray(0x9E3779B9, np.uint32)
    with np.errstate(over="ignore"):
        for key in keys:
            h = (np.asarray(key).astype(np.int64).astype(np.uint32) ^ h) * np.uint32(0x85EBCA6B)
            h = (h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
            h = h ^ (h >> np.uint32(16))
    return np.multiply(h >> np.uint32(8), np.float32(2**-24), dtype=np.float32)


def band(
    x: Array, lo: Array | float, hi: Array | float, width: Array, period: float = 1.0
) -> Array:
    """Return the share of [x − width/2, x + width/2] in [lo, hi), repeated every `period`."""

    def integral(at: Array) -> Array:
        whole = np.floor(at / period)
        return whole * (hi - lo) + np.clip(at - whole * period - lo, 0.0, hi - lo)

    half = np.maximum(width, 1e-3) / 2
    return np.clip((integral(x + half) - integral(x - half)) / (2 * half), 0.0, 1.0)


def ramp(x: Array, edge: Array | float, width: Array) -> Array:
    """Return the share of [x − width/2, x + width/2] above `edge`."""
    return np.clip((x - edge) / np.maximum(width, 1e-3) + 0.5, 0.0, 1.0)


class Noise:
    """Tiling 2D value noise with a table per seed."""

    def __init__(self, seed: int) -> None:
        cell = np.arange(_SIDE)
        self._table = (hash01(cell[:, None], cell[None], seed) * 2 - 1).astype(np.float32).ravel()

    def __call__(self, u: Array, v: Array, wavelength: float, width: Array) -> Array:
        """Return (n,) noise in [−1, 1] of mean 0 and a `wavelength` in metres, fading for larger `width`."""
        x, y = u * np.float32(1 / wavelength), v * np.float32(1 / wavelength)
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = x - x0, y - y0
        column, row = x0.astype(np.int32) & (_SIDE - 1), (y0.astype(np.int32) & (_SIDE - 1)) * _SIDE
        right, below = (column + 1) & (_SIDE - 1), (row + _SIDE) & (_SIDE * _SIDE - 1)
        table = self._table
        top = table[row + column] * (1 - fx) + table[row + right] * fx
        bottom = table[below + column] * (1 - fx) + table[below + right] * fx
        fade = 1 / (1 + (width * np.float32(0.7 / wavelength)) ** 4)
        return (top * (1 - fy) + bottom * fy) * fade
