"""What to say of a recovery that did not simply go well."""

from __future__ import annotations

from g2ard.stages.recover.report import RecoverReport

__all__ = ["outcome", "unregularized"]


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
    if report.way < 1:
        return (
            "recovery ended below its start in the training views: the scene goes"
            f" {report.way:.0%} of the way to where it ended, which is above both"
        )
    return None


def unregularized(report: RecoverReport) -> str | None:
    """One line about weights that never acted, for there were fewer steps than one period; else None."""
    held = report.regularizers
    if report.kept_start or held.steps or not held.period or not report.steps:
        return None
    return (
        f"the regularisers never acted: they do every {held.period} steps, and there were {report.steps} "
        "(--set regularizers.period=…)"
    )
