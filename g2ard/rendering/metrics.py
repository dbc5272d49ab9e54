"""PSNR, PSNR of gradients and SSIM of float images in [0, 1]; all take the arguments of `psnr`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.errors import InputError

_Image = NDArray[np.floating[Any]]


def psnr(image: _Image, target: _Image, mask: NDArray[np.bool_] | None = None) -> float:
    """Return the PSNR, −10·log₁₀ MSE for a peak of 1, at most 100 dB (identical images); NaN for NaN pixels.

    Args:
        image: (H, W, C) in [0, 1].
        target: of the same shape.
        mask: (H, W), True for pixels that count; None means all.

    Raises:
        InputError: shapes that differ.

    >>> round(psnr(np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.6)), 4)
    20.0
    """
    if mask is not None:
        image, target = image[mask][:, None], target[mask][:, None]
    return float(np.minimum(100.0, _core.psnr(_float32(image), _float32(target))))


def edge_psnr(image: _Image, target: _Image, mask: NDArray[np.bool_] | None = None) -> float:
    """Return the PSNR of the images' gradients: how well edges, wires and text are kept.

    It is −10·log₁₀ of the mean squared error of the differences between neighbouring pixels, along rows and
    columns, for a peak of 1, at most 100 dB, also if none counts. A smooth error of colour hardly counts, a
    lost line does. With a mask, a difference counts if both its pixels do.

    >>> flat, shifted = np.full((4, 4, 3), 0.4), np.full((4, 4, 3), 0.6)
    >>> line = flat.copy()
    >>> line[:, 2] = 0.6
    >>> edge_psnr(flat, shifted), round(edge_psnr(flat, line), 2)
    (100.0, 18.75)
    """
    if image.shape != target.shape:
        raise InputError(f"expected the image's shape {image.shape}, got {target.shape}", parameter="target")
    error = _float32(image) - _float32(target)
    total, count = 0.0, 0
    for near, far in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        steps = error[far] - error[near]
        if mask is not None:
            steps = steps[mask[far] & mask[near]]
        total += float(np.square(steps).sum(dtype=np.float64))
        count += steps.size
    if total == 0 or not count:
        return 100.0
    return float(np.minimum(100.0, -10 * np.log10(total / count)))


def ssim(image: _Image, target: _Image, mask: NDArray[np.bool_] | None = None) -> float:
    """Return the mean structural similarity: 11×11 Gaussian window, σ 1.5, values in 0–1, as INRIA's.

    Without a mask, pixels beyond the image's edge are black. With one, they have no part, like all pixels
    outside it, so that even a mask of the whole image changes the score near the edge.

    The result is the mean over pixels and channels that count, in [−1, 1]; 1 if none does. Each window's
    weights are multiplied by the mask and divided by their sum.

    >>> black, white, mask = np.zeros((16, 16, 1)), np.ones((16, 16, 1)), np.zeros((16, 16), bool)
    >>> mask[:4, 12:] = True
    >>> round(ssim(black, white, mask), 4)
    0.0001
    >>> round(ssim(np.eye(16)[:, :, None], np.eye(16)[:, :, None]), 6)
    1.0
    """
    counts = None if mask is None else np.ascontiguousarray(mask)
    return _core.ssim(_float32(image), _float32(target), counts)


def _float32(image: _Image) -> NDArray[np.float32]:
    return np.ascontiguousarray(image, dtype=np.float32)
