"""Estimate of the up direction: the normal of the ground if there is one, otherwise a guess."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Mask, Values
from g2ard.poses.matter import Matter
from g2ard.scene.reproducible import along, fibonacci, moments, positive, quantile
from g2ard.scene.transform import unit_up

_FACING = np.cos(np.radians(20))
"""Least cosine between an axis and the normals that face it."""

_SLOPED = np.cos(np.radians(35))
"""The same on ground, which may have slopes."""

_UPRIGHT = np.cos(np.radians(15))
"""Least cosine between an axis and a coordinate axis that it is taken for."""

_USUAL_SIGNS = (1.0, -1.0, 1.0)
"""Signs of up along x, y and z in most files: y is down, z is up."""

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
    grounded = _find_shape(sample).is_flat or _find_layer(sample, axis).share > _GROUND_GIVEN
    return Up(axis, grounded, "up as given")


def estimate_up(sample: Matter) -> Up:
    """Estimate the axis from planes or the scene's shape, and its sign from where the matter lies.

    The first of these that applies decides: a flat scene lies on its ground; the strongest plane at the edge
    of the matter is the ground; layers that are much stronger than those across them are floors; a long
    object stands on its end. Otherwise the axis is y, as in most capture software.
    """
    shape = _find_shape(sample)
    if shape.is_flat:
        axis = shape.thinnest
        axis = _mean_normal(sample, axis, facing(sample, axis))
        return _choose_sign(sample, axis, True, "the scene is flat")
    few = sample.first(_SEARCHED)
    directions = np.concatenate([np.eye(3), fibonacci(600)[:300]])
    layers = [_find_layer(few, axis) for axis in directions]
    edges = np.array([layer.edge for layer in layers])
    shares = np.array([layer.share for layer in layers])
    favours = [_favour_habit(axis) for axis in directions]
    axis = directions[np.argmax(edges * favours)]
    for _ in range(3):
        heights = along(sample.points, axis) - _find_layer(sample, axis).height
        ground = facing(sample, axis, _FACING)
        ground &= np.abs(heights) < 2 * _SLAB
        axis = _mean_normal(sample, axis, ground)
    if _find_layer(sample, axis).edge > _GROUND:
        return _choose_sign(sample, axis, True, "a ground plane")
    axis = directions[np.argmax(shares)]
    is_across = np.abs(directions @ axis) < 0.5
    strongest_across = shares[is_across].max()
    axis = _mean_normal(sample, axis, facing(sample, axis, _FACING))
    if shares.max() > _LAYERED * strongest_across and _favour_habit(axis) > 1:
        return _choose_sign(sample, axis, True, "its layers face that way")
    axis = np.array([0.0, -1.0, 0.0])
    if shape.longest is None:
        return _choose_sign(sample, axis, False, "no ground; a guess")
    # long objects lean, files are upright
    axis = np.eye(3)[np.argmax(np.abs(shape.longest))]
    if not abs(shape.longest @ axis) > _UPRIGHT:
        axis = shape.longest
    return _choose_sign(sample, axis, False, "no ground; the long axis")


def facing(sample: Matter, axis: Float, least: float = _SLOPED) -> Mask:
    """Return (K,) whether normals face along an axis, by default as on sloped ground."""
    return np.abs(along(sample.normals, axis)) > least


class _Shape(NamedTuple):
    """Whether a scene is flat, its thinnest axis, and its longest axis if the scene is long."""

    is_flat: bool
    thinnest: Float
    longest: Float | None


def _find_shape(sample: Matter) -> _Shape:
    weights = sample.weights / sample.weights.sum()
    centred = sample.points - (weights[:, None] * sample.points).sum(axis=0)
    variances, vectors = np.linalg.eigh(moments(centred, weights))  # ascending
    is_long = variances[2] > _ROD * variances[1]
    return _Shape(
        is_flat=bool(variances[0] < _SHEET * variances[1]),
        thinnest=vectors[:, 0],
        longest=vectors[:, 2] if is_long else None,
    )


class _Layer(NamedTuple):
    """A layer of matter that faces an axis.

    Args:
        share: its share of all matter.
        height: along the axis.
        edge: the share, reduced by matter on both sides: ground and walls have it on one side.
    """

    share: float
    height: float
    edge: float


def _find_layer(sample: Matter, axis: Float) -> _Layer:
    """Return the strongest layer that faces `axis`."""
    rows = facing(sample, axis, _FACING)
    if not rows.any():
        return _Layer(0.0, 0.0, 0.0)
    heights = along(sample.points, axis)
    total = sample.weights.sum()
    bins = np.floor(heights[rows] / _SLAB).astype(int)
    low = bins.min()
    mass = np.bincount(bins - low, sample.faces[rows])
    pairs = mass + np.append(mass[1:], 0.0)  # a layer may lie across two bins
    best = int(np.argmax(pairs))
    share = pairs[best] / total
    height = (low + best + 1) * _SLAB
    distances = heights - height
    above = sample.weights[distances > 2 * _SLAB].sum()
    below = sample.weights[distances < -2 * _SLAB].sum()
    both_sides = 2 * min(above, below)
    both_sides /= max(above + below, 0.05 * total)
    return _Layer(
        share=float(share),
        height=float(height),
        edge=float(share * (1 - both_sides)),
    )


def _favour_habit(axis: Float) -> float:
    """Return a factor that favours y and z, the up axes of nearly every file, over other directions."""
    if np.abs(axis[1:]).max() > _UPRIGHT:
        return 1.2
    return 1.0


def _mean_normal(sample: Matter, axis: Float, rows: Mask) -> Float:
    """Return the mean normal of some rows, whose signs are arbitrary, on the side of `axis`."""
    weights = sample.faces[rows]
    if not weights.sum() > 0:
        return axis
    _, vectors = np.linalg.eigh(moments(sample.normals[rows], weights))
    mean: Float = vectors[:, 2]
    return mean * np.copysign(1.0, mean @ axis)


def _choose_sign(sample: Matter, axis: Float, grounded: bool, why: str) -> Up:
    """Turn the axis to where the matter is on its ground, or away from an object's heavier end."""
    heights = along(sample.points, axis)
    if grounded:
        lean = _measure_lean(sample, axis, heights)
        side = "most of the scene lies above it"
    else:
        low, high = quantile(heights, sample.weights, [0.01, 0.99])
        lean = _measure_lowness(heights, sample.weights, low, high)
        side = "its heavier end is down"
    if abs(lean) > _UNSURE:
        return Up(
            axis * np.copysign(1.0, lean),
            grounded,
            f"{why}, {side}",
        )
    largest = np.argmax(np.abs(axis))
    sign = np.copysign(1.0, _USUAL_SIGNS[largest] * axis[largest])
    return Up(axis * sign, grounded, f"{why}, its sign by custom")


def _measure_lowness(
    heights: Float,
    weights: Float,
    low: float,
    high: float,
) -> float:
    """Return how low the mean height lies from `high`, −1, to `low`, 1."""
    mean = (weights * heights).sum() / weights.sum()
    share = (mean - low) / positive(high - low)
    return float(1 - 2 * share)


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
        flat_heights = heights[flat]
        low, high = quantile(flat_heights, faces, [0.05, 0.95])
        floor = faces[np.abs(flat_heights - low) < 2 * _SLAB].sum()
        ceiling = faces[np.abs(flat_heights - high) < 2 * _SLAB].sum()
        if high - low >= 6 * _SLAB and min(floor, ceiling) > 0.25 * faces.sum():
            between = heights > low + 2 * _SLAB
            between &= heights < high - 2 * _SLAB
            if not weights[between].sum() > 0:
                return 0.0
            return _measure_lowness(heights[between], weights[between], low, high)
    column = _number_columns(sample.points, axis)
    above = np.zeros(len(heights))
    for number in np.unique(column):
        rows = column == number
        ground = rows & flat
        if not ground.any():
            ground = rows
        ground_height = quantile(heights[ground], weights[ground], 0.5)
        above[rows] = heights[rows] - ground_height
    moment = (weights * above).sum()
    return float(moment / positive((weights * np.abs(above)).sum()))


def _number_columns(points: Float, axis: Float) -> Values:
    """Return (M,) numbers of 6×6 columns along an axis that points lie in."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    numbers = [np.floor(3 + 3 * along(points, side)) for side in (first, second)]
    return (6, 1) @ np.clip(numbers, 0, 5)
