"""The sky behind lifts of point clouds in pictures, as on pages (`viewer/page.css`)."""

from __future__ import annotations

import numpy as np

from g2ard.arrays import Float32
from g2ard.rendering.renderer import Rendered

TOP = (0x7D, 0x93, 0xA8)
"""Colour of the sky at the upper edge, 8 bits per channel."""

BOTTOM = (0xC6, 0xCE, 0xD2)
"""Colour of the sky at the lower edge."""


def over_sky(image: Float32, light: Float32) -> Float32:
    """Return an image on black in front of the sky.

    Args:
        image: (H, W, 3).
        light: (H, W) share of the background that shows.

    >>> over_sky(np.zeros((2, 1, 3), np.float32), np.ones((2, 1), np.float32))[1, 0].max().round(3)
    np.float32(0.824)
    """
    down = np.linspace(0, 1, len(image), dtype=np.float32)[:, None, None]
    top, bottom = (np.array(color, np.float32) / 255 for color in (TOP, BOTTOM))
    sky = top + down * (bottom - top)
    return np.asarray(image + light[..., None] * sky, np.float32)


def seen_on_sky(drawn: Rendered) -> Float32:
    """Return the image of a view on black in front of the sky, (H, W, 3), clipped to [0, 1]."""
    return np.clip(over_sky(drawn.image, 1 - drawn.alpha), 0, 1)
