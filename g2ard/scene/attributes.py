"""Attributes of Gaussians by name, as columns of a table."""

from collections.abc import Callable
from itertools import chain

import numpy as np

from g2ard.arrays import Float, Values
from g2ard.scene.shape import elongation
from g2ard.scene.splats import Splats

_TABLE: dict[tuple[str, ...], Callable[[Splats], Values]] = {
    ("x", "y", "z"): lambda splats: splats.positions,
    ("opacity",): lambda splats: splats.opacities[:, None],
    ("scale_x", "scale_y", "scale_z"): lambda splats: splats.scales,
    ("rot_w", "rot_x", "rot_y", "rot_z"): lambda splats: splats.quats,
    ("red", "green", "blue"): lambda splats: splats.colors,
}
_DERIVED: dict[tuple[str, ...], Callable[[Splats], Values]] = {
    ("smallest_scale",): lambda splats: splats.scales.min(axis=1, keepdims=True),
    ("largest_scale",): lambda splats: splats.scales.max(axis=1, keepdims=True),
    ("elongation",): lambda splats: elongation(splats.scales)[:, None],
}

ATTRIBUTES = tuple(chain(*_TABLE, *_DERIVED))
"""Names of attributes that conditions can use."""


def columns(splats: Splats) -> dict[str, Values]:
    """Return the columns of a table of attributes, each (N,), in order.

    World coordinates x, y, z; opacity in [0, 1]; scale_x, scale_y and scale_z, the standard deviations along
    the Gaussian's own axes in scene units; the quaternion rot_w, rot_x, rot_y, rot_z; the base colour red,
    green, blue, usually in [0, 1]; and the coefficients of further harmonics, red_1, green_1, blue_1 onwards.

    >>> list(columns(Splats.create([[1, 2, 3]], scales=[[1, 1, 1]])))[:5]
    ['x', 'y', 'z', 'opacity', 'scale_x']
    """
    found: dict[str, Values] = {}
    for names, read in _TABLE.items():
        found |= zip(names, read(splats).T, strict=True)
    for k in range(splats.shN.shape[1]):
        for channel, color in enumerate(("red", "green", "blue")):
            found[f"{color}_{k + 1}"] = splats.shN[:, k, channel]
    return found


def attribute(splats: Splats, name: str) -> Float:
    """Return the (N,) column of an attribute."""
    for names, read in (_TABLE | _DERIVED).items():
        if name in names:
            return read(splats)[:, names.index(name)].astype(np.float64)
    raise KeyError(name)
