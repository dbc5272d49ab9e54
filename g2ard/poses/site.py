"""A scene stood upright, with what planners ask of it: extents, ground, free space, sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.poses.grid import Grid
from g2ard.poses.matter import Matter, along, quantile
from g2ard.poses.terrain import Terrain
from g2ard.poses.up import Up, estimate_up, given_up
from g2ard.splats import Splats

__all__ = ["Site"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Site:
    """Coordinates here are upright (z up) and of unit size: world = origin + size · axesᵀ · here.

    Args:
        points: (K, 3) a sample of the matter, and `weights` (K,).
        box: (2, 3) low and high corner of the robust extents.
        terrain: height of the ground; None where there is none.
        grid: opaque cells of the box and some room around it.
        axes: (3, 3) rows are this frame's axes in the world.
        origin: (3,) world.
        size: scene units per unit here.
        up: what was found, and why.
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
    def of(cls, splats: Splats, up: ArrayLike | None = None) -> Site:
        """Stand a scene upright.

        Raises:
            InputError: nothing visible, or an `up` that is no direction.
        """
        matter = Matter.of(splats)
        found = estimate_up(matter) if up is None else given_up(matter, up)
        axes = _axes(matter, found.axis)
        points = _turned(matter.points, axes)
        some = matter.sample()
        k = len(some.points)
        box = np.array([quantile(points[:k, a], some.weights, [0.01, 0.99]) for a in range(3)]).T
        room = 0.1 * (box[1] - box[0]) + 0.02
        spans = _turned(matter.spans.reshape(-1, 3), axes).reshape(-1, 2, 3)
        grid = Grid.of(box[0] - room, box[1] + room, points, spans, matter.opacities)
        facing = np.abs(along(some.normals, found.axis)) > np.cos(np.radians(35))
        terrain = Terrain.of(points[:k][facing], some.weights[facing], box) if found.grounded else None
        origin = splats.offset + matter.origin
        return cls(points[:k], some.weights, box, terrain, grid, axes, origin, matter.size, found)

    def above_ground(self, points: Floats) -> Floats:
        """(M,) heights over the ground; over −∞ where there is none."""
        if self.terrain is None:
            return np.full(len(points), np.inf)
        return points[:, 2] - self.terrain.height(points)


def _axes(matter: Matter, up: Floats) -> Floats:
    """Rows: along the scene if it is long, else along the first coordinate axis; to its left; up."""
    some = matter.sample()
    ahead = np.eye(3)[int(np.argmin(np.round(np.abs(up), 3)))]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    left = np.cross(up, ahead)
    w = some.weights / some.weights.sum()
    x, y = along(some.points, ahead), along(some.points, left)
    x, y = x - (w * x).sum(), y - (w * y).sum()
    values, vectors = np.linalg.eigh(
        np.array([[(w * x * x).sum(), (w * x * y).sum()], [(w * x * y).sum(), (w * y * y).sum()]])
    )
    if values[1] > 1.5 * values[0]:
        along_it = vectors[:, 1] * np.copysign(1.0, vectors[int(np.argmax(np.abs(vectors[:, 1]))), 1])
        ahead = along_it[0] * ahead + along_it[1] * left
        left = np.cross(up, ahead)
    return np.stack([ahead, left, up])


def _turned(vectors: Floats, axes: Floats) -> Floats:
    return np.stack([along(vectors, axis) for axis in axes], axis=1)
