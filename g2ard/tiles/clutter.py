"""Clutter of a scene in tiles: each tile is judged amid what surrounds it."""

from __future__ import annotations

import numpy as np

from g2ard.rendering.renderer import settings_for
from g2ard.rendering.visibility import visibility
from g2ard.stages.clean import compare_depths, find_clutter
from g2ard.tiles.tasks import (
    Arrays,
    Given,
    cameras_of,
    cropped,
    telling,
    tile_of,
    with_surroundings,
)


def clutter(given: Given) -> Arrays:
    """Find the clutter of a tile, see `g2ard.stages.clean`.

    Invisible Gaussians may change the pixels around the tile by the light that it has of them, and a floater
    is smaller than a thousandth of the tile with its surroundings.

    Args:
        given: `tile`, `own`, `coarse`, `levels`, `cameras`, as for `g2ard.tiles.simplify`; `extent`, the
            scene's `extent_of`.

    Returns:
        `kind`, (N,) int8, see `Cleaning`; `light`, (2,) that of all Gaussians, and of the clutter.
    """
    own = tile_of(given)
    amid = with_surroundings(own, given)
    settings = settings_for(own.means, antialiased=own.antialiased)
    cameras = cropped(cameras_of(given["cameras"]).recentred(own.offset), own, settings)
    pixels = cameras.widths.astype(int) * cameras.heights
    cameras = cameras.take(np.flatnonzero(pixels > 1)).recentred(-own.offset)
    seen = visibility(amid, cameras, telling)
    count = len(own)
    light = seen.weight[:count]
    share = light.sum() / max(seen.weight.sum(), 1e-30)
    unoccluded, _ = compare_depths(amid, cameras, floating=False)
    mine = int(share * pixels.sum())
    kind = find_clutter(amid, seen, unoccluded, mine, extent=given["extent"]).kind[:count]
    return {"kind": kind, "light": np.array([light.sum(), light[kind >= 0].sum()])}
