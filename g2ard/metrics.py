"""Image metrics: PSNR and SSIM of float images in [0, 1]."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core

__all__ = ["psnr", "ssim"]

_Image = NDArray[np.floating[Any]]


def psnr(image: _Image, target: _Image) -> float:
    """−10·log10 of the mean squared difference, peak 1; at most 100 dB, which identical images reach.

    Args:
        image: (H, W, C) in [0, 1].
        target: of the same shape.

    Returns:
        dB.

    Raises:
        InputError: shapes that differ.

    >>> round(psnr(np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.6)), 4)
    20.0
    """
    return min(100.0, _core.psnr(_float32(image), _float32(target)))


def ssim(image: _Image, target: _Image) -> float:
    """Mean structural similarity: 11×11 Gaussian window, σ 1.5, zero-padded, range 0–1 (INRIA's).

    Args:
        image: (H, W, C) in [0, 1].
        target: of the same shape.

    Returns:
        Mean over pixels and channels, at most 1.

    Raises:
        InputError: shapes that differ.

    >>> round(ssim(np.eye(16)[:, :, None], np.eye(16)[:, :, None]), 6)
    1.0
    """
    return _core.ssim(_float32(image), _float32(target))


def _float32(image: _Image) -> NDArray[np.float32]:
    return np.ascontiguousarray(image, dtype=np.float32)
