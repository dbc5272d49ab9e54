"""Estimate of the up direction: the normal of the ground if there is one, otherwise a guess."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Mask
from g2ard.poses.matter import Matter
from g2ard.scene.reproducible import along, fibonacci, moments, quantile
from g2ard.scene.transform import unit_up

_FACING = np.cos(np.radians(20))
"""Least cosine between an axis and the normals that face it."""

_SLOPED = np.cos(np.radians(35))
"""The same on ground, which may have slopes."""

_SHEET = 0.08
"""Ratio of the scene's smallest variance over its middle one below which it is flat like terrain."""

_ROD = 3.0
"""Ratio of the scene's largest variance over its middle one above which it is long."""

_GROUND_GIVEN = 0.1
"""Share of all matter in a layer above which it is the ground, along a given axis."""

_GROUND = 0.12
"""The same along an estimated axis, where matter beyond the layer counts against it."""

_SLAB = 0.04
"""Half the thickness of a layer that counts as a plane, in scene sizes."""

_LAYERED = 1.8
"""Contrast above which the strongest layer is a floor or path with matter on both sides: its share over that
of any layer across it. Measured: a room 2.2, a path 4.4; objects 1.2 and 2.2, the latter along an unusual
axis."""

_UNSURE = 0.05
"""Lean of the matter, from −1 to 1, that does not tell which side is up."""

_SEARCHED = 20_000
"""Rows used to search over directions; the winner is refined on all rows."""


@dataclass(frozen=True, eq=False)
class Up:
    """Unit vector away from the ground, whether there is a ground, and the reason."""

    axis: Float
    grounded: bool
    why: str


def given_up(sample: Matter, direction: ArrayLike) -> Up:
    """Return the axis given by the user, and check only whether there is a ground.

    Raises:
        InputError: not three finite numbers, or all zero.
    """
    axis = unit_up(direction)
    return Up(axis, _is_flat(sample)[0] or _find_layer(sample, axis)[0] > _GROUND_GIVEN, "up as given")


def estimate_up(sample: Matter) -> Up:
    """Estimate the axis from planes or the scene's shape, and its sign from where the matter lies.

    The first of these that applies decides: a flat scene lies on its ground; the strongest plane at the edge
    of the matter is the ground; layers that are much stronger than those across them are floors; a long
    object stands on its end. Otherwise the axis is y, as in most capture software.
    """
    flat, thin, long = _is_flat(sample)
    if flat:
        return _choose_sign(
            sample, _mean_normal(sample, thin, facing(sample, thin)), True, "the scene is flat"
        )
    few = sample.first(_SEARCHED)
    directions = np.concatenate([np.eye(3), fibonacci(600)[:300]])
    shares, _, edges = np.array([_find_layer(few, axis) for axis in directions]).T
    axis = directions[int(np.argmax(edges * [_favour_habit(axis) for axis in directions]))]
    for _ in range(3):
        inside = np.abs(along(sample.points, axis) - _find_layer(sample, axis)[1]) < 2 * _SLAB
        axis = _mean_normal(sample, axis, inside & facing(sample, axis, _FACING))
    if _find_layer(sample, axis)[2] > _GROUND:
        return _choose_sign(sample, axis, True, "a ground plane")
    axis = directions[int(np.argmax(shares))]
    across = shares[np.abs(directions @ axis) < 0.5].max()
    axis = _mean_normal(sample, axis, facing(sample, axis, _FACING))
    if shares.max() > _LAYERED * across and _favour_habit(axis) > 1:
        return _choose_sign(sample, axis, True, "its layers face that way")
    if long is not None:
        usual = np.eye(3)[int(np.argmax(np.abs(long)))]  # long objects lean, files are upright
        axis = usual if abs(long @ usual) > np.cos(np.radians(15)) else long
        return _choose_sign(sample, axis, False, "no ground; the long axis")
    return _choose_sign(sample, np.array([0.0, -1.0, 0.0]), False, "no ground; a guess")


def facing(sample: Matter, axis: Float, least: float = _SLOPED) -> Mask:
    """Return (K,) whether normals face along an axis, by default as on sloped ground."""
    return np.abs(along(sample.normals, axis)) > least


def _is_flat(sample: Matter) -> tuple[bool, Float, Float | None]:
    """Return whether the scene is flat, its thinnest axis, and its longest axis if the scene is long."""
    w = sample.weights / sample.weights.sum()
    centred = sample.points - (w[:, None] * sample.points).sum(axis=0)
    values, vectors = np.linalg.eigh(moments(centred, w))
    long = vectors[:, 2] if values[2] > _ROD * values[1] else None
    return bool(values[0] < _SHEET * values[1]), vectors[:, 0], long


def _find_layer(sample: Matter, axis: Float) -> tuple[float, float, float]:
    """Return the strongest layer that faces `axis`: its share of all matter, its height, and its edge.

    The edge is the share, reduced by matter on both sides: ground and walls have it on one side.
    """
    rows = facing(sample, axis, _FACING)
    if not rows.any():
        return 0.0, 0.0, 0.0
    heights = along(sample.points, axis)
    total = sample.weights.sum()
    bins = np.floor(heights[rows] / _SLAB).astype(int)
    low = bins.min()
    mass = np.bincount(bins - low, sample.faces[rows])
    pairs = mass + np.append(mass[1:], 0.0)
    best = int(np.argmax(pairs))
    share = pairs[best] / total
    height = (low + best + 1) * _SLAB
    above = sample.weights[heights - height > 2 * _SLAB].sum()
    below = sample.weights[heights - height < -2 * _SLAB].sum()
    edge = share * (1 - 2 * min(above, below) / max(above + below, 0.05 * total))
    return float(share), float(height), float(edge)


def _favour_habit(axis: Float) -> float:
    """Return a factor that favours y and z, the up axes of nearly every file, over other directions."""
    return 1.2 if np.abs(axis[1:]).max() > np.cos(np.radians(15)) else 1.0


def _mean_normal(sample: Matter, axis: Float, rows: Mask) -> Float:
    weights = sample.faces[rows]
    if not weights.sum() > 0:
        return axis
    mean: Float = np.linalg.eigh(moments(sample.normals[rows], weights))[1][:, 2]
    return mean * np.copysign(1.0, mean @ axis)


def _choose_sign(sample: Matter, axis: Float, grounded: bool, why: str) -> Up:
    """Turn the axis to where the matter is on its ground, or away from an object's heavier end."""
    heights = along(sample.points, axis)
    ends = quantile(heights, sample.weights, [0.01, 0.99])
    lean = (
        _measure_lean(sample, axis, heights) if grounded else _measure_lowness(heights, sample.weights, *ends)
    )
    if abs(lean) > _UNSURE:
        side = "most of the scene lies above it" if grounded else "its heavier end is down"
        return Up(axis * np.copysign(1.0, lean), grounded, f"{why}, {side}")
    largest = int(np.argmax(np.abs(axis)))
    sign = np.copysign(1.0, (1.0, -1.0, 1.0)[largest] * axis[largest])
    return Up(axis * sign, grounded, f"{why}, its sign by custom")


def _measure_lowness(heights: Float, weights: Float, low: float, high: float) -> float:
    """Return how low the mean height lies from `high`, −1, to `low`, 1."""
    mean = (weights * heights).sum() / weights.sum()
    return float(1 - 2 * (mean - low) / max(high - low, np.finfo(float).tiny))


def _measure_lean(sample: Matter, axis: Float, heights: Float) -> float:
    """Return how far the matter stands on the side of `axis`, from −1 to 1, relative to what faces it.

    Between a floor and a ceiling, the matter in between decides: furniture stands on floors. Otherwise
    heights are relative to the median of the facing matter in each of 6×6 columns, so that slopes do not
    count.
    """
    weights = sample.weights
    flat = facing(sample, axis, _FACING)
    faces = sample.faces[flat]
    if faces.sum() > 0:
        low, high = quantile(heights[flat], faces, [0.05, 0.95])
        layers = [faces[np.abs(heights[flat] - end) < 2 * _SLAB].sum() for end in (low, high)]
        if high - low >= 6 * _SLAB and min(layers) > 0.25 * faces.sum():
            between = (heights > low + 2 * _SLAB) & (heights < high - 2 * _SLAB)
            empty = not weights[between].sum() > 0
            if empty:
                return 0.0
            return _measure_lowness(heights[between], weights[between], low, high)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    sides = [np.floor(3 + 3 * along(sample.points, a)) for a in (first, np.cross(axis, first))]
    column = (6, 1) @ np.clip(sides, 0, 5)
    above = np.zeros(len(heights))
    for cell in np.unique(column):
        rows = column == cell
        ground = rows & flat if (rows & flat).any() else rows
        above[rows] = heights[rows] - quantile(heights[ground], weights[ground], 0.5)
    return float((weights * above).sum() / max((weights * np.abs(above)).sum(), np.finfo(float).tiny))
