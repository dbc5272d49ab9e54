"""Cameras built from eyes and gazes, and statistics of what each sees of a site."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.poses.site import Site
from g2ard.scene.cameras import Cameras

Floats = NDArray[np.float64]

_RAYS = (24, 18)
"""Columns and rows of the rays that represent a frame."""

_RAISED = 0.1
"""Share of `Site.tallness`: matter higher above the ground stands on it."""

_BATCH = 16
"""Poses whose rays are cast together."""


@dataclass(frozen=True)
class Lens:
    """Image size in pixels and horizontal field of view in degrees."""

    size: tuple[int, int] = (800, 600)
    fov: float = 50.0

    @property
    def tangents(self) -> tuple[float, float]:
        """Half width and half height of the frame at distance 1."""
        half = float(np.tan(np.radians(self.fov) / 2))
        return half, half * self.size[1] / self.size[0]

    @property
    def matrix(self) -> Floats:
        """(3, 3) pinhole intrinsics in pixels."""
        width, height = self.size
        focal = width / 2 / self.tangents[0]
        return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Poses:
    """Eyes (P, 3) and unit gazes (P, 3), upright in a site's coordinates."""

    eyes: Floats
    gazes: Floats

    def __len__(self) -> int:
        return len(self.eyes)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice) -> Poses:
        """Return the poses that `index` selects, in its order."""
        return Poses(self.eyes[index], self.gazes[index])

    @classmethod
    def joined(cls, parts: list[Poses]) -> Poses:
        """Concatenate the poses of all parts, in order."""
        return cls(np.concatenate([p.eyes for p in parts]), np.concatenate([p.gazes for p in parts]))

    def frames(self) -> Floats:
        """Return (P, 3, 3) rotations whose rows are right, down and ahead, in the site's coordinates."""
        level = np.cross(self.gazes, [0.0, 0.0, 1.0])
        steep = np.linalg.norm(level, axis=1) < 1e-6  # straight down: the top of the image is the site's y
        level[steep] = (1.0, 0.0, 0.0)
        right = level / np.linalg.norm(level, axis=1, keepdims=True)
        return np.stack([right, np.cross(self.gazes, right), self.gazes], axis=1)

    def cameras(self, site: Site, lens: Lens) -> Cameras:
        """Return cameras in world coordinates, named in order."""
        digits = max(4, len(str(len(self) - 1)))
        turned = self.frames() @ site.axes
        eyes = site.origin + site.size * (self.eyes @ site.axes)
        viewmats = np.tile(np.eye(4), (len(self), 1, 1))
        viewmats[:, :3, :3] = turned
        viewmats[:, :3, 3] = -np.einsum("pij,pj->pi", turned, eyes)
        return Cameras.from_lists(
            list(viewmats),
            [lens.matrix] * len(self),
            [lens.size] * len(self),
            [f"pose_{i:0{digits}d}" for i in range(len(self))],
        )


@dataclass(frozen=True, eq=False)
class ViewStatistics:
    """Share of the frame that meets matter and how far the view is open, per pose (P,).

    Args:
        covered: share of the rays that opaque matter stops.
        standing: share of the rays stopped by matter that stands on the ground; all of it without a ground.
        close: distance at which a tenth of the rays have met something, even if only leaves or haze.
        median: median distance of the rays that meet anything; inf if none does.
    """

    covered: Floats
    standing: Floats
    close: Floats
    median: Floats


def view_statistics(
    site: Site, poses: Poses, lens: Lens, wanted: NDArray[np.bool_] | None = None
) -> ViewStatistics:
    """Cast a coarse frame of rays from each pose into the site's grid; zeros for poses not in `wanted`."""
    covered, standing, close, median = (np.zeros(len(poses)) for _ in range(4))
    asked = np.arange(len(poses)) if wanted is None else np.flatnonzero(wanted)
    for some, eyes, directions in _frames_of_rays(poses, lens, asked):
        stopped = site.grid.cast(eyes, directions)
        hit = np.isfinite(stopped)
        covered[some] = hit.reshape(len(some), -1).mean(axis=1)
        hit[hit] = (
            site.above_ground(eyes[hit] + stopped[hit, None] * directions[hit]) > _RAISED * site.tallness
        )
        standing[some] = hit.reshape(len(some), -1).mean(axis=1)
        met = np.sort(site.grid.cast(eyes, directions, murky=True).reshape(len(some), -1), axis=1)
        halfway = np.isfinite(met).sum(axis=1) // 2
        close[some], median[some] = met[:, met.shape[1] // 10], met[np.arange(len(some)), halfway]
    return ViewStatistics(covered, standing, close, median)


def clearance(site: Site, poses: Poses, lens: Lens) -> Floats:
    """Return (P,) `ViewStatistics.close` alone, casting half as many rays."""
    close = np.zeros(len(poses))
    for some, eyes, directions in _frames_of_rays(poses, lens, np.arange(len(poses))):
        met = site.grid.cast(eyes, directions, murky=True).reshape(len(some), -1)
        rank = met.shape[1] // 10
        close[some] = np.partition(met, rank, axis=1)[:, rank]
    return close


def _frames_of_rays(
    poses: Poses, lens: Lens, asked: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], Floats, Floats]]:
    """Yield batches of poses with the origins and unit directions of their rays."""
    if not len(asked):
        return
    columns, rows = _RAYS
    x = lens.tangents[0] * ((np.arange(columns) + 0.5) / columns * 2 - 1)
    y = lens.tangents[1] * ((np.arange(rows) + 0.5) / rows * 2 - 1)
    rays = np.stack([np.tile(x, rows), np.repeat(y, columns), np.ones(columns * rows)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    frames = poses.frames()
    for some in np.array_split(asked, -(-len(asked) // _BATCH)):
        directions = np.einsum("ri,pij->prj", rays, frames[some]).reshape(-1, 3)
        yield some, np.repeat(poses.eyes[some], len(rays), axis=0), directions
