"""Recovery report, and messages about unusual outcomes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from g2ard.io.reports import LEFT_OUT, Report
from g2ard.progress import plural
from g2ard.rendering.exposure import Exposure
from g2ard.scene.cameras import USUAL

_LEAST_PACE = 0.05
"""Gain in dB per 100 steps that is worth more time."""


@dataclass(frozen=True)
class Gain(Report):
    """PSNR before and after, on a sample of the training views, dB; `views` describes the sample."""

    before: float
    after: float
    views: str | None = field(default=None, metadata=LEFT_OUT)

    def __str__(self) -> str:
        if self.views:
            where = f" in {self.views}"
        else:
            where = ""
        return f"PSNR {self.before:.2f} → {self.after:.2f} dB{where}"


@dataclass(frozen=True)
class Trial(Report):
    """A trial multiplier of the rates, and the PSNR after a few steps, dB."""

    multiplier: float
    psnr: float


@dataclass(frozen=True)
class Look(Report):
    """PSNR at a step, dB: a number, or the numbers by kind of validation view."""

    step: int
    psnr: Any


@dataclass(frozen=True)
class Geometry(Report):
    """Drift95 and the share of needles at a step."""

    step: int
    drift95: float
    needle: float


@dataclass(frozen=True)
class Regularized(Report):
    """Number of regularised steps, their share of the time beyond plain steps, and their period (0 if
    inactive)."""

    steps: int
    share: float
    period: int


@dataclass(frozen=True)
class Validation(Report):
    """Validation on views of other kinds.

    Args:
        looks: PSNR by kind at some steps; the last is the result's.
        prior_views: k of the shrinkage towards the student: a Gaussian seen by v views keeps v/(v + k) of its
            change; None if all keep the same share, or none.
    """

    looks: tuple[Look, ...]
    prior_views: float | None


@dataclass(frozen=True)
class RecoverReport(Report):
    """Figures of a recovery.

    Args:
        seconds: time, including trials.
        loss: means over each 1 % of the steps.
        psnr: PSNR before and after on a sample of the training views.
        multiplier: factor on the schedule's rates.
        reach: size in a view above which a Gaussian hardly moves; None means no limit.
        extent: extent of the cameras, scene units.
        trials: trials that chose the multiplier.
        drift95: Drift95 of the result.
        needle: share of needles of the result.
        geometry: Drift95 and Needle at ten evenly spaced steps.
        regularizers: their steps and cost.
        backed_off: losses after which recovery continued from the best scene with a third of the rates.
        stopped: step at which it was given up, or None.
        blend: weight of the last step's scene in the result, interpolated with the student: 1 unless the
            steps lost quality.
        kept_start: whether the result is the student, because all steps made it worse.
        skipped: `non_finite`: single-Gaussian steps whose gradient was not finite.
        exposure: what was estimated of the photos' exposures; None if they agree.
        resumed: part of `seconds` before this call resumed; None if it did not resume.
        planned: steps that the schedule takes without a time limit; None without a limit.
        pace: gain at the end of a limited recovery, dB per 100 steps.
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
    exposure: Exposure | None = field(default=None, metadata=LEFT_OUT)
    resumed: float | None = field(default=None, metadata=LEFT_OUT)
    planned: int | None = field(default=None, metadata=LEFT_OUT)
    pace: float | None = field(default=None, metadata=LEFT_OUT)

    def __repr__(self) -> str:
        return f"RecoverReport({plural(self.steps, 'step')} in {self.seconds:.1f} s, {self.psnr})"


def describe_outcome(report: RecoverReport) -> str | None:
    """Return a message about an unusual recovery, or None.

    >>> from dataclasses import replace
    >>> rest = [(), Regularized(1, 0.0, 100), (), None, 1.0, False, None, {}]
    >>> well = RecoverReport(90, 1.0, [], Gain(32.9, 33.4), 1.0, None, 0.0, (), 0.0, 0.0, *rest)
    >>> describe_outcome(well) is None
    True
    >>> describe_outcome(replace(well, backed_off=(Look(30, 23.35),)))
    'recovery fell to 23.35 dB (start 32.90) at step 30: continued from the best scene with a third of the
    rates'
    """
    start = f"(start {report.psnr.before:.2f})"
    if not report.steps:
        return "recovery skipped: the scene already renders as its targets"
    lines = [f"{found.psnr:.2f} dB {start} at step {found.step}" for found in report.backed_off]
    if report.kept_start:
        why = "every step made the training views worse"
        if report.validation:
            looks = report.validation.looks
        else:
            looks = ()
        if len(looks) > 2 and looks[-1].psnr == looks[0].psnr:
            first = looks[0].psnr
            end = looks[-2].psnr
            kind = min(first, key=lambda kind: end[kind] - first[kind])
            if kind == USUAL:
                name = ""
            else:
                name = f" of kind {kind}"
            change = f"{first[kind]:.2f} → {end[kind]:.2f} dB"
            why = f"every step made validation views{name} worse ({change}; scores are of other views)"
        if lines:
            why = f"recovery fell to {', '.join(lines)}, and slower rates gained nothing"
        if report.stopped is None:
            given_up = ""
        else:
            given_up = f"; given up at step {report.stopped}"
        return f"kept the start: {why}{given_up}"
    if lines:
        if len(lines) == 1:
            thirds = "a third"
        else:
            thirds = f"1/{3 ** len(lines)}"
        return f"recovery fell to {', '.join(lines)}: continued from the best scene with {thirds} of the rates"
    if report.blend < 1:
        return (
            f"recovery lost PSNR in the training views; the result mixes {report.blend:.0%} of it with "
            f"{1 - report.blend:.0%} of the start, which scores more than either"
        )
    return None


def describe_time_limit(report: RecoverReport) -> str | None:
    """Return a message if time ended a recovery before its usual steps, and whether it still gained.

    >>> from dataclasses import replace
    >>> rest = [(), Regularized(1, 0.0, 100), (), None, 1.0, False, None, {}]
    >>> full = RecoverReport(827, 1.0, [], Gain(20, 28), 1.0, None, 0.0, (), 0.0, 0.0, *rest)
    >>> describe_time_limit(replace(full, planned=2100, pace=0.41))
    'time ended recovery at step 827 of 2,100; it was still gaining 0.4 dB per 100 steps'
    >>> describe_time_limit(full) is describe_time_limit(replace(full, planned=800)) is None
    True
    """
    if (
        report.planned is None
        or report.steps >= report.planned
        or report.kept_start
        or report.stopped
    ):
        return None
    text = f"time ended recovery at step {report.steps:,} of {report.planned:,}"
    if report.pace is None:
        return text
    if report.pace < _LEAST_PACE:
        return f"{text}; it gained under {_LEAST_PACE:g} dB per 100 steps"
    return f"{text}; it was still gaining {report.pace:.1f} dB per 100 steps"


def describe_idle_regularizers(rounds: Sequence[Sequence[RecoverReport]]) -> str | None:
    """Return a message if regularisers never acted because there were too few steps, or None.

    Args:
        rounds: the recoveries of each round of a run; the message names rounds if there are several
            recoveries.
    """
    idle: dict[str, RecoverReport] = {}
    for number, entry in enumerate(rounds, 1):
        for k, done in enumerate(entry):
            regularized = done.regularizers
            if done.kept_start or regularized.steps or not regularized.period or not done.steps:
                continue
            where = f"round {number}"
            idle[f"the last recovery of {where}" if k else where] = done
    if not idle:
        return None
    period = next(iter(idle.values())).regularizers.period
    steps = sorted({done.steps for done in idle.values()})
    if len(steps) == 1:
        least = f"{steps[0]}"
    else:
        least = f"{steps[0]} to {steps[-1]}"
    if sum(map(len, rounds)) > 1:
        where = f" in {', '.join(idle)}"
    else:
        where = ""
    return (
        f"the regularisers never acted{where}: they act every {period} steps, and there were {least} "
        "(--set regularizers.period=…)"
    )
