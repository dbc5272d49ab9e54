"""Report of a registration: each photo, and all of them against true poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import Keep
from g2ard.errors import require
from g2ard.report.base import Report
from g2ard.scene.cameras import Cameras

Status = Literal["registered", "uncertain", "refused"]
KEPT: dict[Keep, tuple[Status, ...]] = {
    "registered": ("registered",),
    "uncertain": ("registered", "uncertain"),
    "all": ("registered", "uncertain", "refused"),
}
"""The photos whose poses are kept; with "all" one that has none keeps the pose it started from."""

RECALLS = ((0.05, 5.0), (0.10, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Metres and degrees within which visual localisation counts a pose as found."""


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


@dataclass(frozen=True)
class Recall(Report):
    """The share of all photos whose pose is within so many metres and degrees."""

    metres: float
    degrees: float
    share: float


@dataclass(frozen=True)
class Accuracy(Report):
    """Poses against the true ones.

    Args:
        photos: that have a pose and a true one.
        median: of the errors of those, scene units and degrees, each by itself.
        worst: likewise.
        recalls: over *all* photos with a true pose: a photo without a pose counts as missed. Empty where the
            scene's unit is not known in metres.
    """

    photos: int
    median: PoseError | None
    worst: PoseError | None
    recalls: tuple[Recall, ...]


@dataclass(frozen=True)
class Summary(Report):
    """A registration in numbers.

    Args:
        photos: all.
        registered, uncertain, refused: of them.
        true: photos with a true pose.
        metres_per_unit: of the scene, if known.
        start: accuracy of the poses started from; None without a truth.
        found: accuracy of the poses that are kept; None likewise.
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
    photos: Sequence[PhotoReport],
    *,
    keep: Keep = "registered",
    true: int = 0,
    metres_per_unit: float | None = None,
) -> Summary:
    """Count photos and, given the truth, score starts and results alike.

    Args:
        photos: of a `RegisterReport`.
        keep: see `KEPT`.
        true: how many photos have a true pose.
        metres_per_unit: of the scene; None where it is not known.

    Raises:
        InputError: a scale that is not positive.

    >>> near = PhotoReport("a", "registered", start_error=PoseError(1, 3), error=PoseError(0.04, 0.1))
    >>> lost = PhotoReport("b", "refused", start_error=PoseError(2, 3))
    >>> found = summarize([near, lost], true=2, metres_per_unit=1).found
    >>> found.photos, found.median.position, found.recalls[0].share
    (1, 0.04, 0.5)
    """
    if metres_per_unit is not None:
        fits = 0 < metres_per_unit < float("inf")
        require("metres_per_unit", metres_per_unit, fits, "a positive number")
    kept = KEPT[keep]
    counts = [sum(p.status == status for p in photos) for status in ("registered", "uncertain", "refused")]
    start = found = None
    if true:
        start = _accuracy([p.start_error for p in photos], true, metres_per_unit)
        found = _accuracy([p.error for p in photos if p.status in kept], true, metres_per_unit)
    return Summary(len(photos), counts[0], counts[1], counts[2], true, metres_per_unit, start, found)


def _accuracy(errors: Sequence[PoseError | None], true: int, metres: float | None) -> Accuracy:
    values = np.array([(e.position, e.rotation) for e in errors if e is not None]).reshape(-1, 2)
    if not len(values):
        none = () if metres is None else tuple(Recall(m, d, 0.0) for m, d in RECALLS)
        return Accuracy(0, None, None, none)
    recalls = []
    for limit, degrees in RECALLS if metres is not None else ():
        within = (values[:, 0] * metres <= limit) & (values[:, 1] <= degrees)
        recalls.append(Recall(limit, degrees, int(within.sum()) / true))
    median, worst = np.median(values, 0).tolist(), values.max(0).tolist()
    return Accuracy(len(values), PoseError(*median), PoseError(*worst), tuple(recalls))
