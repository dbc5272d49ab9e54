"""An upright scene with the properties that planners need: extents, ground, free space, rooms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Mask
from g2ard.poses.matter import Grid, Matter
from g2ard.poses.up import Up, estimate_up, facing, given_up
from g2ard.scene.reproducible import (
    along,
    between,
    fibonacci,
    halton,
    middle,
    moments,
    norms,
    quantile,
    quantiles,
    turned,
)
from g2ard.scene.splats import Splats
from g2ard.system.cached import cached_property

_EXTENT = (0.01, 0.99)
"""Quantiles of the matter along each axis that bound the scene: floaters lie outside."""

_BODY = 1.5
"""Least half side of the box, in standard deviations of a typical Gaussian: some scenes are only one."""

_MARGIN_SHARE = 0.1
"""Margin of the grid around the box, as a share of its sides."""

_MARGIN = 0.02
"""Addition to this margin, in scene sizes."""

_BELOW_SKY = 0.9
"""Share of the distance to a sky within which poses stand."""

_TALL = 0.98
"""Quantile of the heights above the ground that is the height of what stands there."""

_LONG = 1.5
"""Ratio of the variances along and across above which a scene has a direction of its own."""

_FLAT = 0.25
"""Height over width below which a scene with a ground is a landscape."""

_BLOCKS = 24
"""Blocks of ground along the longer side, each with one height."""

_LOW = 0.25
"""Quantile of the heights in a block that is its height: plants stand on the ground, noise lies below."""

_TRIES = 4096
"""Places tried in search of rooms."""

_DIRECTIONS = 64
"""Rays cast from each of these places."""

_ENCLOSED = 0.7
"""Least share of the sphere around a place within a room that is matter; a path under open sky has half. With
0.55 or 0.35, the showroom loses .2 and .4 dB, because some places at the edges of rooms lie behind walls."""

_SHARP = 0.05
"""Radians: within a room, most of the matter seen has a smaller standard deviation. Measured .013–.026; in
the hollow of an object .13 and more."""

_MOSTLY = 0.75
"""Share of the matter seen that this least asks of."""

_ROOM_SHARES = (0.005, 0.025)
"""Share of the box that lies within rooms: below the first no pose stands inside, from the second on all do,
or `_SHELL` of them in a scene without ground. Measured: showroom .026–.079, objects and open scenes 0.000."""

_SHELL = 0.5
"""Share of the poses that stand inside a scene with rooms but without ground."""


@dataclass(frozen=True, eq=False)
class Inside:
    """Places within the rooms of a scene.

    Args:
        places: (K, 3) places, those with most clearance first.
        share: share of the scene's box that lies within rooms.
        weight: share of a pool that stands within: up to 1, or ½ without a ground (a shell may be an object).
    """

    places: Float
    share: float
    weight: float


@dataclass(frozen=True, eq=False)
class Site:
    """A scene in upright coordinates (z up) of unit size: world = origin + size · axesᵀ · here.

    Args:
        points: (K, 3) a sample of the matter.
        weights: (K,) weights of the points.
        box: (2, 3) low and high corner of the robust extents.
        body: how far views must see around each point: more than 0 if the scene is no larger than one of its
            Gaussians along any axis.
        terrain: height of the ground; None without a ground.
        grid: opaque cells of the box and a margin around it.
        axes: (3, 3) rows are this frame's axes in world coordinates.
        origin: (3,) in world coordinates.
        size: scene units per unit here.
        vertical: the up direction, and the reason for it.
        beyond: (F, 3) a sample of what is not near: sky, surroundings, floaters.
        beyond_share: share of the visible Gaussians that are not near.
        centre: (3,) the middle of the places from which people looked at the scene.
        horizon: distance from `centre` at which a sky begins; inf without one.
    """

    points: Float
    weights: Float
    box: Float
    body: float
    terrain: Terrain | None
    grid: Grid
    axes: Float
    origin: Float
    size: float
    vertical: Up
    beyond: Float
    beyond_share: float
    centre: Float
    horizon: float

    @classmethod
    def of(
        cls,
        splats: Splats,
        axis: ArrayLike | None = None,
        rows: int | None = None,
        represents: float = 1.0,
    ) -> Site:
        """Turn a scene upright, using at most `rows` of its Gaussians, each representing `represents`.

        Raises:
            InputError: nothing is visible, or `axis` is not a direction.
        """
        matter = Matter.of(splats, rows, represents)
        some = matter.first()
        if axis is None:
            axis = splats.up
        if axis is None:
            vertical = estimate_up(some)
        else:
            vertical = given_up(some, axis)
        axes = _choose_axes(some, vertical.axis)
        points = turned(some.points, axes)
        box = quantiles(points, some.weights, _EXTENT).T
        half_sides = (box[1] - box[0]) / 2
        missing = np.maximum(0, _BODY * middle(matter.scales[:, 2]) - half_sides)
        box += missing * np.array([[-1.0], [1.0]])
        margin = _MARGIN_SHARE * (box[1] - box[0]) + _MARGIN
        terrain = None
        if vertical.grounded:
            ground = facing(some, vertical.axis)
            terrain = Terrain.of(
                points[ground],
                some.weights[ground],
                box,
            )
        return cls(
            points=points,
            weights=some.weights,
            box=box,
            body=2
            * float(missing.min()),  # a Gaussian is drawn as far as three standard deviations
            terrain=terrain,
            grid=Grid.of(
                box[0] - margin,
                box[1] + margin,
                matter,
                axes,
            ),
            axes=axes,
            origin=splats.offset + matter.origin,
            size=matter.size,
            vertical=vertical,
            beyond=turned(matter.beyond, axes),
            beyond_share=matter.beyond_share,
            centre=turned(matter.centre[None], axes)[0],
            horizon=matter.horizon,
        )

    @property
    def sides(self) -> Float:
        """(3,) lengths of the box."""
        return self.box[1] - self.box[0]

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal."""
        return float(norms(self.box[1:] - self.box[:1])[0])

    def encloses(self, points: Float) -> Mask:
        """Return (M,) whether points lie in the box."""
        return ((points > self.box[0]) & (points < self.box[1])).all(axis=1)

    def place_at(self, shares: Float, heights: Float) -> Float:
        """Return (M, 3) places at (M, 3) shares of the box, and at heights above the ground."""
        places = between(self.box, shares)
        places[:, 2] = self.ground(places) + heights
        return places

    def localize(self, points: Float) -> Float:
        """Return (M, 3) world points in the site's coordinates."""
        return (points - self.origin) @ self.axes.T / self.size

    def globalize(self, points: Float) -> Float:
        """Return (M, 3) points in world coordinates."""
        return self.origin + self.size * (points @ self.axes)

    def ground(self, points: Float) -> Float:
        """Return (M,) heights of the ground under points, or of the box's bottom without a ground."""
        if self.terrain is None:
            return np.full(len(points), self.box[0, 2])
        return self.terrain.height(points)

    def above_ground(self, points: Float) -> Float:
        """Return (M,) heights above the ground, infinite without a ground."""
        if self.terrain:
            return points[:, 2] - self.ground(points)
        return np.full(len(points), np.inf)

    def is_free(
        self,
        points: Float,
        cells: float,
        above: float = -np.inf,
    ) -> Mask:
        """Return whether points are over `cells` cells from matter, `above` the ground and below a sky."""
        free = self.grid.distance(points) > cells * self.grid.cell
        free &= self.above_ground(points) > above
        free &= norms(points - self.centre) < _BELOW_SKY * self.horizon
        return free

    @cached_property
    def tallness(self) -> float:
        """Height of what stands on the ground: the `_TALL` quantile of the matter's height above it."""
        heights = self.points[:, 2] - self.ground(self.points)
        return max(float(quantile(heights, self.weights, _TALL)), 0.0)

    @cached_property
    def is_landscape(self) -> bool:
        """Whether the scene has a ground and is much wider than high."""
        wide, deep, tall = self.sides
        return self.terrain is not None and bool(tall < _FLAT * np.sqrt(wide * deep))

    def met(self, points: Float, ways: Float) -> Float:
        """Return (M, D) distances from each point to matter in each of D directions; inf without any."""
        eyes = np.repeat(points, len(ways), axis=0)
        directions = np.tile(ways, (len(points), 1))
        return self.grid.cast(eyes, directions).reshape(len(points), len(ways))

    def inside(self, seed: int) -> Inside:
        """Find free places around which matter covers most of the sphere and looks sharp."""
        places = between(self.box, halton(0, _TRIES, 3, seed))
        places = places[self.is_free(places, 2)]
        ways = fibonacci(_DIRECTIONS)
        distances = self.met(places, ways)  # (places, ways)
        at, way = np.nonzero(np.isfinite(distances))
        met = distances[at, way]
        just_within = met + 0.5 * self.grid.cell
        scales = self.grid.scale_at(places[at] + just_within[:, None] * ways[way])
        is_sharp = scales < _SHARP * met
        enclosed = np.bincount(at, minlength=len(places)) / _DIRECTIONS
        sharp = np.bincount(at[is_sharp], minlength=len(places)) / _DIRECTIONS
        in_room = enclosed > _ENCLOSED
        in_room &= sharp > _MOSTLY * enclosed
        places = places[in_room]
        clearance = self.grid.distance(places)
        places = places[np.argsort(-clearance, kind="stable")]
        share = len(places) / _TRIES
        most = _SHELL
        if self.vertical.grounded:
            most = 1.0
        weight = np.interp(share, _ROOM_SHARES, (0.0, most))
        return Inside(places, share, float(weight))


def _choose_axes(some: Matter, axis: Float) -> Float:
    """Return rows: along the scene if it is long, otherwise along a coordinate axis; to its left; up."""
    flattest = np.argmin(np.round(np.abs(axis), 3))
    ahead = np.eye(3)[flattest]
    ahead = ahead - (ahead @ axis) * axis
    ahead /= np.linalg.norm(ahead)
    left = np.cross(axis, ahead)
    weights = some.weights / some.weights.sum()
    flat = np.stack(
        [
            along(some.points, ahead),
            along(some.points, left),
        ],
        axis=1,
    )
    flat -= (weights[:, None] * flat).sum(axis=0)
    variances, vectors = np.linalg.eigh(moments(flat, weights))
    if variances[1] > _LONG * variances[0]:
        longest = vectors[:, 1]
        # solvers return either direction
        largest = longest[np.argmax(np.abs(longest))]
        x, y = longest * np.copysign(1.0, largest)
        ahead = x * ahead + y * left
    return np.stack([ahead, np.cross(axis, ahead), axis])


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights of the ground at the centres of square blocks, from the corner `low`."""

    low: Float
    block: float
    heights: Float

    @classmethod
    def of(cls, points: Float, weights: Float, box: Float) -> Terrain:
        """Estimate the ground as a low quantile of the heights per block, with roofs and canopies cut off.

        Points, (M, 3) with mass (M,), are the matter that faces up or down; the box is the scene's.
        """
        low = box[0, :2]
        sides = np.maximum(box[1, :2] - low, 1e-6)
        block = float(sides.max()) / _BLOCKS
        shape = np.maximum(1, np.ceil(sides / block - 1e-9)).astype(int)
        place = np.floor((points[:, :2] - low) / block).astype(int)
        inside = ((place >= 0) & (place < shape)).all(axis=1)
        block_of = np.where(
            inside,
            place[:, 0] * shape[1] + place[:, 1],
            -1,
        )
        heights = np.full(int(np.prod(shape)), np.nan)
        order = np.argsort(block_of, kind="stable")
        found, firsts = np.unique(block_of[order], return_index=True)
        for number, rows in zip(found, np.split(order, firsts[1:]), strict=False):
            if number >= 0:
                heights[number] = quantile(
                    points[rows, 2],
                    weights[rows],
                    _LOW,
                )
        heights = _fill(heights.reshape(shape), box[0, 2])
        # A morphological opening removes bumps narrower than three blocks; then blocks are smoothed.
        lowest = _stack_neighbours(heights, np.inf).min(axis=0)
        opened = _stack_neighbours(lowest, -np.inf).max(axis=0)
        padded = np.pad(opened, 1, mode="edge")
        smooth = _stack_neighbours(padded, 0.0).mean(axis=0)[1:-1, 1:-1]
        return cls(low, block, smooth)

    def height(self, points: Float) -> Float:
        """Return (M,) ground heights under points: bilinear within the map, constant beyond its edge."""
        top = np.array(self.heights.shape) - 1
        place = (points[:, :2] - self.low) / self.block - 0.5
        place = np.clip(place, 0, top)
        base = np.floor(place).astype(int)
        share = place - base
        total = np.zeros(len(points))
        for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
            x, y = np.minimum(base + step, top).T
            weights = np.where(step, share, 1 - share).prod(axis=1)
            total += weights * self.heights[x, y]
        return total


def _fill(heights: Float, default: float) -> Float:
    """Fill gaps with the mean of their neighbours, ring by ring."""
    if np.isnan(heights).all():
        return np.full_like(heights, default)
    while np.isnan(heights).any():
        around = _stack_neighbours(heights, np.nan)
        count = (~np.isnan(around)).sum(axis=0)
        means = np.nansum(around, axis=0) / np.maximum(count, 1)
        heights = np.where(np.isnan(heights) & (count > 0), means, heights)
    return heights


def _stack_neighbours(heights: Float, outside: float) -> Float:
    """Return (9, X, Y), the neighbourhood of each cell, padded with `outside`."""
    wide = np.pad(heights, 1, constant_values=outside)
    windows = np.lib.stride_tricks.sliding_window_view(wide, heights.shape)
    return windows.reshape(9, *heights.shape)
