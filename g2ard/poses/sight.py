"""Cameras made of eyes and gazes, what each sees of a site, and which are worth keeping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.cameras import Cameras
from g2ard.poses.site import Site

__all__ = ["Lens", "Poses", "Seen", "look"]

Floats = NDArray[np.float64]

_RAYS = (24, 18)
"""Columns and rows of rays that stand for a frame."""


@dataclass(frozen=True)
class Lens:
    """Image size in pixels, horizontal field of view in degrees."""

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
        """The poses `index` selects, in its order."""
        return Poses(self.eyes[index], self.gazes[index])

    @classmethod
    def joined(cls, parts: list[Poses]) -> Poses:
        """All poses of the parts, one part after the other."""
        return cls(np.concatenate([p.eyes for p in parts]), np.concatenate([p.gazes for p in parts]))

    def frames(self) -> Floats:
        """(P, 3, 3) rows are right, down and ahead, in the site's coordinates."""
        level = np.cross(self.gazes, [0.0, 0.0, 1.0])
        steep = np.linalg.norm(level, axis=1) < 1e-6  # straight down: the top of the image is the site's y
        level[steep] = (1.0, 0.0, 0.0)
        right = level / np.linalg.norm(level, axis=1, keepdims=True)
        return np.stack([right, np.cross(self.gazes, right), self.gazes], axis=1)

    def cameras(self, site: Site, lens: Lens) -> Cameras:
        """World cameras named in order."""
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
class Seen:
    """Per pose (P,): the share of the frame that meets matter, and at which distances.

    Args:
        covered: share of the rays that hit.
        close: the distance at which a tenth of the rays have met something, if only leaves or haze.
        median: of the hits' distances; inf where nothing is hit.
    """

    covered: Floats
    close: Floats
    median: Floats


def look(site: Site, poses: Poses, lens: Lens, wanted: NDArray[np.bool_] | None = None) -> Seen:
    """Cast a coarse frame of rays from each pose into the site's opaque cells; nothing where not wanted."""
    columns, rows = _RAYS
    x = lens.tangents[0] * ((np.arange(columns) + 0.5) / columns * 2 - 1)
    y = lens.tangents[1] * ((np.arange(rows) + 0.5) / rows * 2 - 1)
    rays = np.stack([np.tile(x, rows), np.repeat(y, columns), np.ones(columns * rows)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    covered, close, median = (np.zeros(len(poses)) for _ in range(3))
    frames = poses.frames()
    for i in range(len(poses)) if wanted is None else np.flatnonzero(wanted):
        directions = np.einsum("ri,ij->rj", rays, frames[i])
        eyes = np.broadcast_to(poses.eyes[i], directions.shape)
        hits = np.sort(site.grid.cast(eyes, directions))
        tenth = len(rays) // 10
        close[i] = np.partition(site.grid.cast(eyes, directions, murky=True), tenth)[tenth]
        count = int(np.isfinite(hits).sum())
        covered[i] = count / len(hits)
        median[i] = hits[count // 2] if count else np.inf
    return Seen(covered, close, median)
