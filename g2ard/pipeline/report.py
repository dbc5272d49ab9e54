"""What the pipeline tells of its work: views, rounds, seconds."""

from __future__ import annotations

from dataclasses import dataclass, field

from g2ard.report.base import LEFT_OUT, Report
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.simplify.report import SimplifyReport


@dataclass(frozen=True)
class ViewsReport(Report):
    """What was made of the candidate views.

    Args:
        policy: how they were chosen.
        candidates: how many there were.
        chosen: names, best first.
        weighted: whether they were drawn by weight.
        refused: names of those that see nothing of the scene, or stand within it.
        left_out: what the views not chosen would have added to the policy's objective, as a share of the
            whole pool's.
    """

    policy: str
    candidates: int
    chosen: list[str]
    weighted: bool
    refused: list[str]
    left_out: float


@dataclass(frozen=True)
class RoundReport(Report):
    """A round, recovered once where the schedule asks for it, and once more if it is the last."""

    count: int
    simplify: SimplifyReport
    recover: tuple[RecoverReport, ...] = ()


@dataclass(frozen=True)
class StageSeconds(Report):
    """Wall seconds of each stage.

    Args:
        select: of choosing or weighing views.
        simplify: of all rounds.
        recover: of all rounds.
        resumed: of these, what calls before this one had taken; None where none had.
    """

    select: float
    simplify: float
    recover: float
    resumed: float | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class DistillReport(Report):
    """A distillation in numbers; `views` is None where nothing was selected."""

    rounds: tuple[RoundReport, ...]
    seconds: StageSeconds
    views: ViewsReport | None
