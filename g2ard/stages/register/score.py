"""Found poses against true ones, over all photos, beside the same figures of the poses started from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from g2ard.config.choices import Keep
from g2ard.errors import require
from g2ard.report.base import Report
from g2ard.stages.register.outcome import KEPT, PhotoReport, PoseError

__all__ = ["RECALLS", "Accuracy", "Summary", "summarize"]

RECALLS = ((0.05, 5.0), (0.10, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Metres and degrees within which visual localisation counts a pose as found."""


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
