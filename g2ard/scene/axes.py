"""Axes by name: three letters for the directions of x, y and z, such as RDF for right, down, forward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import AXES
from g2ard.errors import require
from g2ard.scene.splats import Splats
from g2ard.scene.transform import transform

_DIRECTIONS = {
    **{"R": (1, 0, 0), "U": (0, 1, 0), "B": (0, 0, 1)},
    **{"L": (-1, 0, 0), "D": (0, -1, 0), "F": (0, 0, -1)},
}
_PARITY = np.repeat(np.array([-1, 1, -1], np.float32), (3, 5, 7))
"""Sign of each harmonic of bands 1–3 under x ↦ −x."""


def change_of_axes(source: str, target: str) -> NDArray[np.float64]:
    """Return the (3, 3) matrix from coordinates in one system to those in another; it may mirror.

    >>> change_of_axes("RUB", "RFU") @ [1, 2, 3]
    array([ 1., -3.,  2.])
    """
    for name in (source, target):
        require("axes", repr(name), name in AXES, f"one of {', '.join(AXES)}")
    there, here = (np.array([_DIRECTIONS[letter] for letter in name], float) for name in (target, source))
    return there @ here.T


def with_axes(splats: Splats, matrix: NDArray[np.float64]) -> Splats:
    """Return a scene in other axes: means, rotations and harmonics by `change_of_axes`.

    A mirror is a rotation followed by x ↦ −x, which leaves the shape of a Gaussian as it is.
    """
    sign = np.sign(np.linalg.det(matrix))
    rotation = np.eye(4)
    rotation[:3, :3] = sign * matrix
    turned = transform(splats, rotation)
    if sign > 0:
        return turned
    odd = _PARITY[: splats.shN.shape[1], None]
    return replace(turned, means=-turned.means, offset=-turned.offset, shN=turned.shN * odd)
