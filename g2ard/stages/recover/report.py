"""Recovery report, and messages about recoveries that did not simply go well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from g2ard.report.base import LEFT_OUT, Report


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


def outcome(report: RecoverReport) -> str | None:
    """Return one line about a recovery that did not simply go well, otherwise None.

    >>> from dataclasses import replace
    >>> rest = [(), Regularized(1, 0.0, 100), (), None, 1.0, False, None, {}]
    >>> well = RecoverReport(90, 1.0, [], Gain(32.9, 33.4), 1.0, None, 0.0, (), 0.0, 0.0, *rest)
    >>> outcome(well) is None
    True
    >>> outcome(replace(well, backed_off=(Look(30, 23.35),)))
    'recovery fell to 23.35 dB (start 32.90) at step 30: it went on from the best with a third of the rates'
    """
    start = f"(start {report.psnr.before:.2f})"
    lines = [f"{found.psnr:.2f} dB {start} at step {found.step}" for found in report.backed_off]
    if report.kept_start:
        why = "every step only made the training views worse"
        looks = report.validation.looks if report.validation else ()
        if len(looks) > 2 and looks[-1].psnr == looks[0].psnr:
            first, worst = looks[0].psnr, looks[-2].psnr
            why = f"views of another kind only lost by the steps ({first:.2f} → {worst:.2f} dB)"
        if lines:
            why = f"recovery fell to {', '.join(lines)}, and slower rates gained nothing"
        given_up = "" if report.stopped is None else f"; given up at step {report.stopped}"
        return f"kept the simplified scene: {why}{given_up}"
    if lines:
        thirds = "a third" if len(lines) == 1 else f"1/{3 ** len(lines)}"
        return f"recovery fell to {', '.join(lines)}: it went on from the best with {thirds} of the rates"
    if report.blend < 1:
        return (
            "recovery ended below its start in the training views: the scene goes"
            f" {report.blend:.0%} of the way to where it ended, which is above both"
        )
    return None


def unregularized(report: RecoverReport) -> str | None:
    """Return one line about regularisers that never acted for want of steps, otherwise None."""
    if not _idle(report):
        return None
    return (
        f"the regularisers never acted: they do every {report.regularizers.period} steps, and there were "
        f"{report.steps} (--set regularizers.period=…)"
    )


def unregularized_rounds(rounds: Sequence[Sequence[RecoverReport]]) -> str | None:
    """Return the same line for all recoveries of a run, naming the rounds."""
    if sum(map(len, rounds)) == 1:
        return next(unregularized(done) for entry in rounds for done in entry)
    idle = {
        f"round {number}" if k == 0 else f"the last recovery of round {number}": done
        for number, entry in enumerate(rounds, 1)
        for k, done in enumerate(entry)
        if _idle(done)
    }
    if not idle:
        return None
    period = next(iter(idle.values())).regularizers.period
    steps = sorted({done.steps for done in idle.values()})
    least = f"{steps[0]}" if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    return (
        f"the regularisers never acted in {', '.join(idle)}: they do every {period} steps, and there were "
        f"{least} (--set regularizers.period=…)"
    )


def _idle(report: RecoverReport) -> bool:
    held = report.regularizers
    return not report.kept_start and not held.steps and bool(held.period) and bool(report.steps)
