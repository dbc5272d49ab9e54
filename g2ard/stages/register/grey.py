"""Grey images, their gradients and similarity measures."""

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Mask, Values

_LUMA = np.array([0.299, 0.587, 0.114])

_BAND_WINDOW = 9
"""Side in pixels of the window whose mean `band_passed` subtracts."""


def grey_of(image: Values) -> Float:
    """Return the (H, W) float64 luma of an (H, W, 3) image, .299 R + .587 G + .114 B."""
    rgb = np.asarray(image, np.float64)
    red, green, blue = _LUMA
    return rgb[..., 0] * red + rgb[..., 1] * green + rgb[..., 2] * blue


def blurred(image: Float) -> Float:
    """Blur by the binomial (1, 4, 6, 4, 1)/16 along both axes (σ = 1 pixel), repeating edges."""
    for axis in (0, 1):
        width = [(0, 0), (0, 0)]
        width[axis] = (2, 2)
        pad = np.pad(image, width, mode="edge")
        n = image.shape[axis]
        a, b, c, d, e = (pad.take(np.arange(k, k + n), axis) for k in range(5))
        image = ((a + e) + 4 * (b + d) + 6 * c) / 16
    return image


def gradient(image: Float) -> tuple[Float, Float]:
    """Return ∂/∂u (right) and ∂/∂v (down), (H, W) each: central differences, one-sided at edges."""
    return np.asarray(np.gradient(image, axis=1)), np.asarray(np.gradient(image, axis=0))


def box_mean(image: Float, side: int) -> Float:
    """Return means over the `side`×`side` windows inside an (H, W) image, as (H−side+1, W−side+1)."""
    sums = np.cumsum(np.cumsum(image, 0), 1)
    sums = np.pad(sums, ((1, 0), (1, 0)))
    whole = sums[side:, side:] - sums[:-side, side:]
    whole -= sums[side:, :-side]
    whole += sums[:-side, :-side]
    return whole / (side * side)


def band_passed(image: Float) -> Float:
    """Return the (H, W) blurred image minus its local mean, which suppresses lighting and noise."""
    padded = np.pad(image, _BAND_WINDOW // 2, mode="edge")
    return blurred(image) - box_mean(padded, _BAND_WINDOW)


def zncc(a: Float, b: Float, mask: Mask) -> float:
    """Return the zero-mean normalised cross-correlation of two (H, W) images over a mask, in [−1, 1].

    It is 0 if either image is flat or the mask is empty.
    """
    if not mask.any():
        return 0.0
    x = a[mask]
    y = b[mask]
    x = x - x.mean()
    y = y - y.mean()
    scale = np.sqrt((x * x).sum() * (y * y).sum())
    if scale > 1e-12:
        return float((x * y).sum() / scale)
    return 0.0


def shift_between(a: Float, b: Float) -> tuple[int, int, float]:
    """Return the shift in pixels (right, down) that best moves `a` onto `b`, and their likeness.

    The likeness is Σ a(x − s)·b(x) / √(Σa²·Σb²): pixels shifted out count as 0. Shifts are at most half an
    image; ties go to the first in row order.

    Both are (H, W), with mean near 0, and 0 where invalid.
    """
    height, width = a.shape
    scale = np.sqrt((a * a).sum() * (b * b).sum())
    if not scale > 1e-12:
        return 0, 0, 0.0
    padded = (2 * height, 2 * width)
    spectrum = np.fft.rfft2(b, padded) * np.conj(np.fft.rfft2(a, padded))
    product = np.fft.irfft2(spectrum, padded)
    down = np.arange(-(height // 2), height // 2 + 1)
    right = np.arange(-(width // 2), width // 2 + 1)
    near = product[np.ix_(down, right)]
    row, column = np.unravel_index(int(np.argmax(near)), near.shape)
    likeness = near[row, column] / scale
    return int(right[column]), int(down[row]), float(likeness)


def local_zncc(a: Float, b: Float, mask: Mask, side: int) -> float:
    """Return the median ZNCC of a grey render and photo, (H, W), over valid windows where the photo has
    contrast; 0 without one.

    Local windows, of an odd `side` in pixels, tolerate uneven lighting. A window counts as 0 if only the
    render is flat there.
    """
    if min(a.shape) < side:
        return zncc(a, b, mask)
    a = np.ascontiguousarray(a)
    b = np.ascontiguousarray(b)
    return _core.local_zncc(a, b, np.ascontiguousarray(mask), side)
