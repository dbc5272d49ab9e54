"""An upright scene with the properties that planners need: extents, ground, free space, sight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.poses.grid import Grid
from g2ard.poses.matter import Matter, Sample
from g2ard.poses.numbers import along, middle, moments, quantile, turned
from g2ard.poses.terrain import Terrain
from g2ard.poses.up import Up, estimate_up, facing, given_up
from g2ard.scene.splats import Splats

Floats = NDArray[np.float64]

_EXTENT = (0.01, 0.99)
"""Quantiles of the matter along each axis that bound the scene: floaters lie outside."""

_BODY = 1.5
"""Least half side of the box, in standard deviations of a typical Gaussian: some scenes are only one."""

_ROOM = (0.1, 0.02)
"""Margin of the grid around the box: a share of its sides, plus a length in scene sizes."""

_TALL = 0.98
"""Quantile of the heights above the ground that is the height of what stands there."""

_LONG = 1.5
"""Ratio of the variances along and across, above which a scene has a direction of its own."""


@dataclass(frozen=True, eq=False)
class Site:
    """A scene in upright coordinates (z up) of unit size: world = origin + size · axesᵀ · here.

    Args:
        points: (K, 3) a sample of the matter.
        weights: (K,) weights of the points.
        box: (2, 3) low and high corner of the robust extents.
        terrain: height of the ground; None without a ground.
        grid: opaque cells of the box and a margin around it.
        axes: (3, 3) rows are this frame's axes in world coordinates.
        origin: (3,) in world coordinates.
        size: scene units per unit here.
        up: the up direction, and the reason for it.
    """

    points: Floats
    weights: Floats
    box: Floats
    terrain: Terrain | None
    grid: Grid
    axes: Floats
    origin: Floats
    size: float
    up: Up

    @classmethod
    def of(
        cls, splats: Splats, up: ArrayLike | None = None, rows: int | None = None, represents: float = 1.0
    ) -> Site:
        """Turn a scene upright, using at most `rows` of its Gaussians, each representing `represents`.

        Raises:
            InputError: nothing is visible, or `up` is not a direction.
        """
        matter = Matter.of(splats, rows, represents)
        some = matter.sample()
        found = estimate_up(some) if up is None else given_up(some, up)
        axes = _axes(some, found.axis)
        points = turned(some.points, axes)
        box = np.array([quantile(points[:, a], some.weights, _EXTENT) for a in range(3)]).T
        body = _BODY * middle(matter.scales[:, 2])  # for a scene no larger than its Gaussians
        box += np.maximum(0, body - (box[1] - box[0]) / 2) * np.array([[-1.0], [1.0]])
        room = _ROOM[0] * (box[1] - box[0]) + _ROOM[1]
        grid = Grid.of(box[0] - room, box[1] + room, matter, axes)
        ground = facing(some, found.axis)
        terrain = Terrain.of(points[ground], some.weights[ground], box) if found.grounded else None
        origin = splats.offset + matter.origin
        return cls(points, some.weights, box, terrain, grid, axes, origin, matter.size, found)

    def ground(self, points: Floats) -> Floats:
        """Return (M,) heights of the ground under points, or of the box's bottom without a ground."""
        if self.terrain is None:
            return np.full(len(points), self.box[0, 2])
        return self.terrain.height(points)

    def above_ground(self, points: Floats) -> Floats:
        """Return (M,) heights above the ground, infinite without a ground."""
        return points[:, 2] - self.ground(points) if self.terrain else np.full(len(points), np.inf)

    @cached_property
    def tallness(self) -> float:
        """Height of what stands on the ground: the `_TALL` quantile of the matter's height above it."""
        return max(float(quantile(self.points[:, 2] - self.ground(self.points), self.weights, _TALL)), 0.0)


def _axes(some: Sample, up: Floats) -> Floats:
    """Return rows: along the scene if it is long, otherwise along a coordinate axis; to its left; up."""
    ahead = np.eye(3)[int(np.argmin(np.round(np.abs(up), 3)))]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    left = np.cross(up, ahead)
    weights = some.weights / some.weights.sum()
    flat = np.stack([along(some.points, ahead), along(some.points, left)], axis=1)
    flat -= (weights[:, None] * flat).sum(axis=0)
    values, vectors = np.linalg.eigh(moments(flat, weights))
    if values[1] > _LONG * values[0]:
        x, y = vectors[:, 1] * np.copysign(1.0, vectors[np.argmax(np.abs(vectors[:, 1])), 1])
        ahead = x * ahead + y * left
    return np.stack([ahead, np.cross(up, ahead), up])
