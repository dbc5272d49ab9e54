"""What came of registration, photo by photo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Keep
from g2ard.report.base import Report
from g2ard.scene.cameras import Cameras

__all__ = ["KEPT", "PhotoReport", "PoseError", "RegisterReport", "Registered", "Status"]

Status = Literal["registered", "uncertain", "refused"]
KEPT: dict[Keep, tuple[Status, ...]] = {
    "registered": ("registered",),
    "uncertain": ("registered", "uncertain"),
    "all": ("registered", "uncertain", "refused"),
}
"""The photos whose poses are kept; with "all" one that has none keeps the pose it started from."""


@dataclass(frozen=True)
class PoseError(Report):
    """Distance of the camera's centre from the true one, scene units, and of the rotation, degrees."""

    position: float
    rotation: float


@dataclass(frozen=True)
class PhotoReport(Report):
    """One photo.

    Args:
        name: of the photo.
        status: "registered", "uncertain" or "refused".
        reason: why it is no better than that; None where it is registered.
        start: the name of the pose that was started from; None where there was none.
        rank: of that pose in the pool, from 1; None where a pose was given.
        matches: of photo and render, whose depth is known; 0 where direct alignment found the pose alone.
        inliers: of them, that the pose explains.
        spread: share of the photo's 4 × 4 cells that hold an inlier; None without features.
        reprojection: median distance of the inliers, pixels at `size`; None likewise.
        passes: of rendering, matching and solving.
        zncc: median local ZNCC of render and photo at the result, in [−1, 1].
        gain: photo's grey = gain·render + bias.
        bias: see `gain`.
        overlap: share of the pixels that are compared.
        covariance: (6, 6) of (v, ω) in the camera's axes: scene units, radians.
        sigma: root of the trace of the covariance of position, scene units, and of rotation, degrees.
        renders: of the scene, for this photo.
        seconds: for this photo.
        camera_from_world: (4, 4) found; None where nothing was.
        start_error: of the pose started from; None without a truth, or where there was no pose.
        error: of the pose found; None likewise.
    """

    name: str
    status: Status
    reason: str | None = None
    start: str | None = None
    rank: int | None = None
    matches: int = 0
    inliers: int = 0
    spread: float | None = None
    reprojection: float | None = None
    passes: int = 0
    zncc: float | None = None
    gain: float | None = None
    bias: float | None = None
    overlap: float | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    sigma: PoseError | None = None
    renders: int = 0
    seconds: float = 0.0
    camera_from_world: tuple[tuple[float, ...], ...] | None = None
    start_error: PoseError | None = None
    error: PoseError | None = None


@dataclass(frozen=True)
class RegisterReport(Report):
    """All photos, in their order."""

    photos: tuple[PhotoReport, ...]

    def count(self, status: Status) -> int:
        """Photos of a status."""
        return sum(photo.status == status for photo in self.photos)


@dataclass(frozen=True, eq=False)
class Registered:
    """The outcome of `register`.

    Args:
        cameras: the photos that are kept, with the poses found.
        report: about every photo, kept or not.
        matches: name → (M, 4) pixels (u, v) of the photo and of its last render that features matched and the
            pose explains, at `size`.
    """

    cameras: Cameras
    report: RegisterReport
    matches: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
