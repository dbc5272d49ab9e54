"""What to say of a recovery that did not simply go well."""

from __future__ import annotations

from collections.abc import Sequence

from g2ard.stages.recover.report import RecoverReport

__all__ = ["outcome", "unregularized", "unregularized_rounds"]


def outcome(report: RecoverReport) -> str | None:
    """One line about a recovery that did not simply go well; None for one that did.

    >>> from dataclasses import replace
    >>> from g2ard.stages.recover.report import Gain, Look, Regularized
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
    """One line about weights that never acted, for there were fewer steps than one period; else None."""
    if not _idle(report):
        return None
    return (
        f"the regularisers never acted: they do every {report.regularizers.period} steps, and there were "
        f"{report.steps} (--set regularizers.period=…)"
    )


def unregularized_rounds(rounds: Sequence[Sequence[RecoverReport]]) -> str | None:
    """The same of all recoveries of a run, round by round: one line that names those; else None."""
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
