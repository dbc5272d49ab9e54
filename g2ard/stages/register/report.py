"""Reports of a registration: each photo, and accuracy against reference poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Keep
from g2ard.errors import require
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

RECALLS = ((0.05, 5.0), (0.10, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Limits in metres and degrees used in visual localisation."""


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
        start_error: error of the starting pose; None without a reference or a starting pose.
        error: error of the result; None without a reference or a result.
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
    matches: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Registered({len(self.cameras)} of {plural(len(self.report.photos), 'photo')})"


@dataclass(frozen=True)
class Recall(Report):
    """Share of photos whose error is within these limits."""

    metres: float
    degrees: float
    share: float


@dataclass(frozen=True)
class Accuracy(Report):
    """Accuracy against reference poses.

    Args:
        photos: number of photos with an estimated and a reference pose.
        median: median position and rotation errors, scene units and degrees.
        worst: largest position and rotation errors.
        recalls: shares of *all* photos with a reference pose; a photo without an estimate counts as missed.
            Empty if the scene's unit in metres is unknown.
    """

    photos: int
    median: PoseError | None
    worst: PoseError | None
    recalls: tuple[Recall, ...]


@dataclass(frozen=True)
class Summary(Report):
    """Summary of a registration.

    Args:
        registered, uncertain, refused: number of photos per status.
        true: number of photos with a reference pose.
        start: accuracy of the starting poses; None without references.
        found: accuracy of the kept poses; None without references.
    """

    photos: int
    registered: int
    uncertain: int
    refused: int
    true: int
    metres_per_unit: float | None
    start: Accuracy | None
    found: Accuracy | None


def summarize(
    rows: Sequence[PhotoReport],
    *,
    keep: Keep = "registered",
    true: int = 0,
    metres_per_unit: float | None = None,
) -> Summary:
    """Count photos by status and, if `true` photos have reference poses, score starting poses and results.

    Results are those that `keep` keeps. `metres_per_unit` is the scale of the scene, None if unknown.
    """
    if metres_per_unit is not None:
        fits = 0 < metres_per_unit < float("inf")
        require("metres_per_unit", metres_per_unit, fits, "a positive number")
    kept = KEPT[keep]
    counts = [sum(p.status == status for p in rows) for status in ("registered", "uncertain", "refused")]
    start = found = None
    if true:
        start = _accuracy([p.start_error for p in rows], true, metres_per_unit)
        found = _accuracy([p.error for p in rows if p.status in kept], true, metres_per_unit)
    return Summary(len(rows), counts[0], counts[1], counts[2], true, metres_per_unit, start, found)


def _accuracy(errors: Sequence[PoseError | None], true: int, metres: float | None) -> Accuracy:
    values = np.array([(e.position, e.rotation) for e in errors if e is not None]).reshape(-1, 2)
    recalls = []
    for limit, degrees in RECALLS if metres is not None else ():
        within = (values[:, 0] * metres <= limit) & (values[:, 1] <= degrees)
        recalls.append(Recall(limit, degrees, int(within.sum()) / true))
    median = worst = None
    if len(values):
        median, worst = (PoseError(*found.tolist()) for found in (np.median(values, 0), values.max(0)))
    return Accuracy(len(values), median, worst, tuple(recalls))
