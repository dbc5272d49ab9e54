"""What recovery tells of its work."""

from __future__ import annotations

from dataclasses import dataclass, field

from g2ard.report.base import LEFT_OUT, Report

__all__ = ["Gain", "Geometry", "Look", "RecoverReport", "Regularized", "Trial", "Validation"]


@dataclass(frozen=True)
class Gain(Report):
    """PSNR over a sample of the training views, dB."""

    before: float
    after: float


@dataclass(frozen=True)
class Trial(Report):
    """A multiplier of the rates that was tried on a few steps, and the PSNR they led to, dB."""

    multiplier: float
    psnr: float


@dataclass(frozen=True)
class Look(Report):
    """PSNR at a step, dB."""

    step: int
    psnr: float


@dataclass(frozen=True)
class Geometry(Report):
    """Drift95 and the share of needles at a step."""

    step: int
    drift95: float
    needle: float


@dataclass(frozen=True)
class Regularized(Report):
    """Steps that were regularised, which share of the time that cost above plain ones, and how many lie from
    one to the next, 0 where no term has weight."""

    steps: int
    share: float
    period: int


@dataclass(frozen=True)
class Validation(Report):
    """What views of another kind had to say.

    Args:
        looks: at some steps, the last of the result.
        prior_views: k of the shrinkage towards the student: a Gaussian that v views touched keeps v/(v + k)
            of its change; None where all keep the same part, or none.
    """

    looks: tuple[Look, ...]
    prior_views: float | None


@dataclass(frozen=True)
class RecoverReport(Report):
    """A recovery in numbers.

    Args:
        steps: taken.
        seconds: for them, trials included.
        loss: one mean for each 1 % of the horizon.
        psnr: of a sample of the training views.
        multiplier: of the schedule's rates.
        reach: how large a Gaussian may be in a view before it stands still; None is no limit.
        extent: of the cameras, scene units.
        trials: those that chose the multiplier.
        drift95: of the result.
        needle: of the result.
        geometry: at ten steps, evenly spaced.
        regularizers: how much they cost.
        backed_off: where so much was lost that recovery went on from the best scene with a third of the
            rates.
        stopped: the step at which it was given up, else None.
        blend: weight of where the steps ended in the result, which is interpolated between the student (0)
            and that (1): 1 but where that lost.
        kept_start: the student was better than all that came of it, and is the result.
        validation: None without such views.
        skipped: `non_finite`: steps of single Gaussians whose gradient was not finite.
        resumed: of `seconds`, those before this call, which went on from a checkpoint; None where it did not.
    """

    steps: int
    seconds: float
    loss: list[float]
    psnr: Gain
    multiplier: float
    reach: float | None
    extent: float
    trials: tuple[Trial, ...]
    drift95: float
    needle: float
    geometry: tuple[Geometry, ...]
    regularizers: Regularized
    backed_off: tuple[Look, ...]
    stopped: int | None
    blend: float
    kept_start: bool
    validation: Validation | None
    skipped: dict[str, int]
    resumed: float | None = field(default=None, metadata=LEFT_OUT)
