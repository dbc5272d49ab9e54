"""Reports of a registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from g2ard.arrays import Float
from g2ard.config.choices import Keep
from g2ard.io.reports import Report
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras

Status = Literal["registered", "uncertain", "refused"]
KEPT: dict[Keep, tuple[Status, ...]] = {
    "registered": ("registered",),
    "uncertain": ("registered", "uncertain"),
    "all": ("registered", "uncertain", "refused"),
}
"""Statuses whose poses are kept; with "all" a photo without a result keeps its starting pose."""


@dataclass(frozen=True)
class PoseError(Report):
    """Errors of a pose: distance of the camera centre, scene units, and rotation, degrees."""

    position: float
    rotation: float


@dataclass(frozen=True)
class PhotoReport(Report):
    """Report of one photo.

    Args:
        status: "registered", "uncertain" or "refused".
        reason: why it is not registered; None if it is.
        start: name of the starting pose; None if there was none.
        rank: its rank in the pool, from 1; None for a given pose.
        matches: matches of photo and render with known depth; 0 for direct alignment alone.
        inliers: matches that the pose explains.
        spread: share of the photo's 4 × 4 cells with an inlier; None without features.
        reprojection: median reprojection error of the inliers, pixels at `size`; None without features.
        passes: passes of rendering, matching and solving.
        zncc: median local ZNCC of render and photo at the result, in [−1, 1].
        gain: photo's grey = gain·render + bias.
        bias: see `gain`.
        overlap: share of the pixels compared.
        covariance: (6, 6) covariance of (v, ω) in the camera's axes: scene units, radians.
        focal: estimated focal length f_x, pixels.
        focal_sigma: σ of its logarithm.
        sigma: root of the covariance's trace for position, scene units, and rotation, degrees.
        camera_from_world: (4, 4) result; None if there is none.
        start_error: error of the starting pose; None without one, or without a true pose.
        error: error of the result, likewise.
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
    focal: float | None = None
    focal_sigma: float | None = None
    sigma: PoseError | None = None
    renders: int = 0
    seconds: float = 0.0
    camera_from_world: tuple[tuple[float, ...], ...] | None = None
    start_error: PoseError | None = None
    error: PoseError | None = None


@dataclass(frozen=True)
class RegisterReport(Report):
    """Report of all photos, in order."""

    photos: tuple[PhotoReport, ...]

    def count(self, status: Status) -> int:
        """Return the number of photos with a status."""
        return sum(photo.status == status for photo in self.photos)


@dataclass(frozen=True, eq=False)
class Registered:
    """Result of `register`.

    Args:
        cameras: the kept photos with their estimated poses.
        report: report of every photo, kept or not.
        matches: name → (M, 4) pixels (u, v) of the photo and (u, v) of its last render for the inliers, at
            `size`.
    """

    cameras: Cameras
    report: RegisterReport
    matches: Mapping[str, Float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Registered({len(self.cameras)} of {plural(len(self.report.photos), 'photo')})"
