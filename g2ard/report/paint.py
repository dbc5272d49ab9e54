"""Scenes painted by what was found about each Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from g2ard.errors import require
from g2ard.scene.splats import SH_C0, Splats

_LUMA = np.array([0.2126, 0.7152, 0.0722])
_SCENE_BRIGHTNESS_SHARE = 0.45
"""Share of the brightness taken from the scene, so that its shape stays visible."""


def painted(splats: Splats, colors: ArrayLike) -> Splats:
    """Recolour a scene, view-independently, shaded by the luma of its own colours.

    Args:
        colors: (N, 3) in [0, 1].

    Returns:
        The same geometry and opacities, SH degree 0.

    >>> scene = Splats.create(np.zeros((2, 3)), scales=np.ones((2, 3)), sh0=np.full((2, 1, 3), 9.0))
    >>> painted(scene, [[1, 0, 0], [0, 0, 1]]).colors.round(3).tolist() == [[1, 0, 0], [0, 0, 1]]
    True
    """
    paint = np.asarray(colors, np.float64)
    require("colors", paint.shape, paint.shape == (len(splats), 3), f"shape ({len(splats)}, 3)")
    luma = np.clip(splats.colors.astype(np.float64) @ _LUMA, 0, 1)
    shaded = paint * (1 - _SCENE_BRIGHTNESS_SHARE + _SCENE_BRIGHTNESS_SHARE * luma[:, None])
    sh0 = np.ascontiguousarray(((shaded - 0.5) / SH_C0)[:, None], np.float32)
    return replace(splats, sh0=sh0, shN=np.zeros((len(splats), 0, 3), np.float32))
