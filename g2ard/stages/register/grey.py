"""Grey images, their gradients, and how alike two of them are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["band_passed", "blurred", "box_mean", "gradient", "grey_of", "local_zncc", "shift_between", "zncc"]

Float = NDArray[np.float64]

_LUMA = np.array([0.299, 0.587, 0.114])
_FLAT = 1e-4
"""Variance of grey in a window, in [0, 1]², below which there is nothing to compare: 1 % of contrast."""


def grey_of(image: NDArray[Any]) -> Float:
    """(H, W) float64 luma of an (H, W, 3) image, .299 R + .587 G + .114 B."""
    rgb = np.asarray(image, np.float64)
    return rgb[..., 0] * _LUMA[0] + rgb[..., 1] * _LUMA[1] + rgb[..., 2] * _LUMA[2]


def blurred(image: Float) -> Float:
    """Both axes by the binomial (1, 4, 6, 4, 1)/16, σ = 1 pixel; edges are repeated."""
    for axis in (0, 1):
        pad = np.pad(image, [(2, 2) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        n = image.shape[axis]
        a, b, c, d, e = (pad.take(np.arange(k, k + n), axis) for k in range(5))
        image = ((a + e) + 4 * (b + d) + 6 * c) / 16
    return image


def gradient(image: Float) -> tuple[Float, Float]:
    """∂/∂u (right) and ∂/∂v (down) by central differences, one-sided at the edges; each (H, W)."""
    return np.asarray(np.gradient(image, axis=1)), np.asarray(np.gradient(image, axis=0))


def box_mean(image: Float, side: int) -> Float:
    """Mean over the `side`×`side` windows that lie within an (H, W) image, as (H−side+1, W−side+1)."""
    sums = np.pad(np.cumsum(np.cumsum(image, 0), 1), ((1, 0), (1, 0)))
    whole = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return whole / (side * side)


def band_passed(image: Float, side: int = 9) -> Float:
    """Blurred a little less its mean over a window: what neither light nor noise decides; (H, W)."""
    half = side // 2
    return blurred(image) - box_mean(np.pad(image, half, mode="edge"), side)


def zncc(a: Float, b: Float, mask: NDArray[np.bool_]) -> float:
    """Zero-mean normalised cross-correlation of two (H, W) images over a mask, in [−1, 1]; 0 where either
    is flat or the mask is empty."""
    if not mask.any():
        return 0.0
    x, y = a[mask], b[mask]
    x, y = x - x.mean(), y - y.mean()
    scale = np.sqrt((x * x).sum() * (y * y).sum())
    return float((x * y).sum() / scale) if scale > 1e-12 else 0.0


def shift_between(a: Float, b: Float) -> tuple[int, int, float]:
    """By how many pixels `a` is best moved, right and down, to lie on `b`; and how alike they are then.

    The likeness is Σ a(x − s)·b(x) / √(Σa²·Σb²): what is moved out of sight counts 0. Moves are at most half
    an image; of equals the first in order of rows wins.

    Args:
        a: (H, W), of mean 0 about, 0 where it does not count.
        b: (H, W), likewise.

    >>> a = np.zeros((8, 8)); a[2, 3] = 1
    >>> shift_between(a, np.roll(a, (1, -2), (0, 1)))[:2]
    (-2, 1)
    """
    height, width = a.shape
    scale = np.sqrt((a * a).sum() * (b * b).sum())
    if not scale > 1e-12:
        return 0, 0, 0.0
    shape = (2 * height, 2 * width)
    product = np.fft.irfft2(np.fft.rfft2(b, shape) * np.conj(np.fft.rfft2(a, shape)), shape)
    down, right = np.arange(-(height // 2), height // 2 + 1), np.arange(-(width // 2), width // 2 + 1)
    near = product[np.ix_(down, right)]
    at = np.unravel_index(int(np.argmax(near)), near.shape)
    return int(right[at[1]]), int(down[at[0]]), float(near[at] / scale)


def local_zncc(a: Float, b: Float, mask: NDArray[np.bool_], side: int) -> float:
    """Median ZNCC over windows all of whose pixels count and in which `b` has contrast.

    Local, for light that differs across an image is no error of a pose; where `a` is flat and `b` is not, a
    window counts 0.

    Args:
        a: (H, W) render, grey.
        b: (H, W) photo, grey.
        mask: (H, W) pixels that count.
        side: of a window, pixels, odd.

    Returns:
        In [−1, 1]; 0 where no window tells.
    """
    if min(a.shape) < side:
        return zncc(a, b, mask)
    # sums of squares about the images' middles: less is lost to rounding than about 0
    a, b = a - a.mean(), b - b.mean()
    mean_a, mean_b = box_mean(a, side), box_mean(b, side)
    var_a = np.maximum(box_mean(a * a, side) - mean_a**2, 0)
    var_b = np.maximum(box_mean(b * b, side) - mean_b**2, 0)
    both = box_mean(a * b, side) - mean_a * mean_b
    tells = (box_mean(mask.astype(np.float64), side) > 1 - 1e-9) & (var_b > _FLAT)
    if not tells.any():
        return 0.0
    scale = np.sqrt(var_a * var_b)
    values = np.where(scale > 1e-9, both / np.maximum(scale, 1e-9), 0.0)[tells]
    return float(np.median(np.clip(values, -1, 1)))
