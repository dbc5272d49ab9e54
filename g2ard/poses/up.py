"""Estimate of the up direction: the normal of the ground if there is one, otherwise a guess."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.poses.lattice import fibonacci
from g2ard.poses.numbers import along, moments, quantile
from g2ard.poses.volume import Sample
from g2ard.scene.transform import unit_up

Floats = NDArray[np.float64]

_FACING = np.cos(np.radians(20))
"""Least cosine between an axis and the normals that face it."""

_TILTED = np.cos(np.radians(35))
"""The same for the ground of a flat scene, which may have slopes."""

_SHEET = 0.08
"""Smallest over middle eigenvalue of the scene's covariance, below which it is flat like terrain."""

_ROD = 3
"""Largest over middle eigenvalue, above which a scene is long."""

_GROUND_GIVEN, _GROUND = 0.1, 0.12
"""Share of all matter in a layer above which it is the ground: along a given axis, and along an estimated
one, where matter beyond the layer counts against it (`_edge`)."""

_SLAB = 0.04
"""Half the thickness of a layer that counts as a plane, in scene sizes."""

_LAYERED = 1.8
"""Contrast above which the strongest layer is a floor or path with matter on both sides: its share over that
of any layer across it. Measured: a room 2.2, a path 4.4; objects 1.2 and 2.2, the latter along an unusual
axis."""

_SEARCHED = 20_000
"""Rows used to search over directions; the winner is refined on all rows."""


@dataclass(frozen=True, eq=False)
class Up:
    """Unit vector away from the ground, whether there is a ground, and the reason."""

    axis: Floats
    grounded: bool
    why: str


def given_up(sample: Sample, up: ArrayLike) -> Up:
    """Return the axis given by the user, and check only whether there is a ground.

    Raises:
        InputError: not three finite numbers, or all zero.
    """
    axis = unit_up(up)
    layer, _ = _layer(sample, axis)
    return Up(axis, _is_flat(sample)[0] or layer > _GROUND_GIVEN, "up as given")


def estimate_up(sample: Sample) -> Up:
    """Estimate the axis from planes or the scene's shape, and its sign from where the matter lies.

    The first of these that applies decides: a flat scene lies on its ground; the strongest plane at the edge
    of the matter is the ground; layers that are much stronger than those across them are floors; a long
    object stands on its end. Otherwise the axis is y, as in most capture software.
    """
    flat, thin, long = _is_flat(sample)
    if flat:
        axis = _mean_normal(sample, thin, np.abs(along(sample.normals, thin)) > _TILTED)
        return _signed(sample, axis, True, "the scene is flat")
    few = sample.take(slice(_SEARCHED))
    directions = np.concatenate([np.eye(3), fibonacci(600)[:300]])
    layers = [_layer(few, axis) for axis in directions]
    axis, strength = _best_plane(sample, few, directions, layers)
    if strength > _GROUND:
        return _signed(sample, axis, True, "a ground plane")
    axis, contrast = _layered(sample, directions, np.array([share for share, _ in layers]))
    if contrast > _LAYERED and _habit(axis) > 1:
        return _signed(sample, axis, True, "its layers face that way")
    if long is not None:
        return _signed(sample, _snapped(long), False, "no ground; the long axis")
    return _signed(sample, np.array([0.0, -1.0, 0.0]), False, "no ground; a guess")


def _is_flat(sample: Sample) -> tuple[bool, Floats, Floats | None]:
    """Return whether the scene is flat, its thinnest axis, and its longest axis if the scene is long."""
    w = sample.weights / sample.weights.sum()
    centred = sample.points - (w[:, None] * sample.points).sum(axis=0)
    values, vectors = np.linalg.eigh(moments(centred, w))
    long = vectors[:, 2] if values[2] > _ROD * values[1] else None
    return bool(values[0] < _SHEET * values[1]), vectors[:, 0], long


def _layer(sample: Sample, axis: Floats) -> tuple[float, float]:
    """Return the share of all matter in the strongest layer that faces `axis`, and the layer's height."""
    facing = np.abs(along(sample.normals, axis)) > _FACING
    if not facing.any():
        return 0.0, 0.0
    heights = along(sample.points[facing], axis)
    bins = np.floor(heights / _SLAB).astype(int)
    low = bins.min()
    mass = np.bincount(bins - low, (sample.weights * sample.flatness)[facing])
    pairs = mass + np.append(mass[1:], 0.0)
    best = int(np.argmax(pairs))
    return float(pairs[best] / sample.weights.sum()), float((low + best + 1) * _SLAB)


def _best_plane(
    sample: Sample, few: Sample, directions: Floats, layers: list[tuple[float, float]]
) -> tuple[Floats, float]:
    """Find and refine the direction whose strongest layer is largest, with matter on one side only.

    `layers` are the strongest layers of `few` along `directions`.
    """
    scores = [
        _edge(few, axis, *layer) * _habit(axis) if layer[0] else 0.0
        for axis, layer in zip(directions, layers, strict=True)
    ]
    axis = directions[int(np.argmax(scores))]
    for _ in range(3):
        _, height = _layer(sample, axis)
        inside = np.abs(along(sample.points, axis) - height) < 2 * _SLAB
        axis = _mean_normal(sample, axis, inside & (np.abs(along(sample.normals, axis)) > _FACING))
    return axis, _edge(sample, axis, *_layer(sample, axis))


def _layered(sample: Sample, directions: Floats, shares: Floats) -> tuple[Floats, float]:
    """Refine the direction with the strongest layer, and return it with its contrast.

    The contrast is the layer's share over that of the strongest layer at 60° or more to it. It is high for a
    floor under noise or a path among reeds.
    """
    axis = directions[int(np.argmax(shares))]
    across = np.abs(directions @ axis) < 0.5
    contrast = shares.max() / max(shares[across].max(), np.finfo(float).tiny)
    facing = np.abs(along(sample.normals, axis)) > _FACING
    return _mean_normal(sample, axis, facing), float(contrast)


def _edge(sample: Sample, axis: Floats, share: float, height: float) -> float:
    """Return the layer's share, reduced by matter on both sides: ground and walls have it on one side."""
    beside = along(sample.points, axis) - height
    above = sample.weights[beside > 2 * _SLAB].sum()
    below = sample.weights[beside < -2 * _SLAB].sum()
    return share * (1 - 2 * min(above, below) / max(above + below, 0.05 * sample.weights.sum()))


def _habit(axis: Floats) -> float:
    """Return a factor that favours y and z, the up axes of nearly every file, over other directions."""
    return 1.2 if np.abs(axis[1:]).max() > np.cos(np.radians(15)) else 1.0


def _mean_normal(sample: Sample, axis: Floats, rows: NDArray[np.bool_]) -> Floats:
    weights = (sample.weights * sample.flatness)[rows]
    if not weights.sum() > 0:
        return axis
    mean = np.linalg.eigh(moments(sample.normals[rows], weights))[1][:, 2]
    return mean * np.copysign(1.0, mean @ axis)


def _snapped(axis: Floats) -> Floats:
    """Return the coordinate axis within 15°, otherwise `axis`: long objects lean, files are upright."""
    best = int(np.argmax(np.abs(axis)))
    return np.eye(3)[best] if abs(axis[best]) > np.cos(np.radians(15)) else axis


def _signed(sample: Sample, axis: Floats, grounded: bool, why: str) -> Up:
    lean = _lean(sample, axis) if grounded else -_balance(sample, axis)
    if abs(lean) > 0.05:
        side = "most of the scene lies above it" if grounded else "its heavier end is down"
        return Up(axis * np.copysign(1.0, lean), grounded, f"{why}, {side}")
    usual = (1.0, -1.0, 1.0)[int(np.argmax(np.abs(axis)))]
    sign = np.copysign(1.0, usual * axis[int(np.argmax(np.abs(axis)))])
    return Up(axis * sign, grounded, f"{why}, its sign by custom")


def _lean(sample: Sample, axis: Floats) -> float:
    """Return how far the matter stands on the side of `axis`, from −1 to 1, relative to what faces it.

    Heights are relative to the median of the facing matter in each of 6×6 columns, so that slopes do not
    count. Between a floor and a ceiling, the matter in between decides: furniture stands on floors.
    """
    heights = along(sample.points, axis)
    facing = np.abs(along(sample.normals, axis)) > _FACING
    ends = _two_layers(sample, heights, facing)
    if ends is not None:
        low, high = ends
        between = (heights > low + 2 * _SLAB) & (heights < high - 2 * _SLAB)
        weights = sample.weights[between]
        if not weights.sum() > 0:
            return 0.0
        mean = (weights * heights[between]).sum() / weights.sum()
        return float(1 - 2 * (mean - low) / (high - low))
    column = _columns(sample, axis)
    above = np.zeros(len(heights))
    for cell in np.unique(column):
        rows = column == cell
        ground = rows & facing if (rows & facing).any() else rows
        above[rows] = heights[rows] - quantile(heights[ground], sample.weights[ground], 0.5)
    total = (sample.weights * np.abs(above)).sum()
    return float((sample.weights * above).sum() / max(total, np.finfo(float).tiny))


def _columns(sample: Sample, axis: Floats) -> NDArray[Any]:
    across = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, across)
    first /= np.linalg.norm(first)
    sides = [np.floor(3 + 3 * along(sample.points, a)) for a in (first, np.cross(axis, first))]
    row, column = (np.clip(side, 0, 5).astype(int) for side in sides)
    return row * 6 + column


def _two_layers(sample: Sample, heights: Floats, facing: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Return the heights of a floor and a ceiling if both ends of the facing matter are strong layers."""
    if not facing.any():
        return None
    weights = (sample.weights * sample.flatness)[facing]
    low, high = quantile(heights[facing], weights, [0.05, 0.95])
    if high - low < 6 * _SLAB:
        return None
    total = weights.sum()
    shares = [weights[np.abs(heights[facing] - end) < 2 * _SLAB].sum() / total for end in (low, high)]
    return (float(low), float(high)) if min(shares) > 0.25 else None


def _balance(sample: Sample, axis: Floats) -> float:
    """Return the half of its height to which an object's matter leans, from −1 to 1."""
    heights = along(sample.points, axis)
    low, high = quantile(heights, sample.weights, [0.01, 0.99])
    mean = (sample.weights * heights).sum() / sample.weights.sum()
    return float(2 * (mean - low) / max(high - low, np.finfo(float).tiny) - 1)
