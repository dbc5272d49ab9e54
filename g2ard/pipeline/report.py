"""Reports of the pipeline: views, rounds, seconds."""

from dataclasses import dataclass, field

from g2ard.io.reports import LEFT_OUT, Report
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.simplify.report import SimplifyReport


@dataclass(frozen=True)
class ViewsReport(Report):
    """Report of the view selection.

    Args:
        chosen: names of the chosen views, best first.
        refused: names of views that see nothing of the scene or lie inside geometry.
        left_out: share of the whole pool's objective that the remaining views would add.
    """

    policy: str
    candidates: int
    chosen: list[str]
    weighted: bool
    refused: list[str]
    left_out: float


@dataclass(frozen=True)
class RoundReport(Report):
    """Report of a round: simplification, and its recoveries if there are any."""

    count: int
    simplify: SimplifyReport
    recover: tuple[RecoverReport, ...] = ()


@dataclass(frozen=True)
class StageSeconds(Report):
    """Wall seconds of each stage.

    Args:
        resumed: part of these spent by earlier, interrupted calls; None if there were none.
    """

    select: float
    simplify: float
    recover: float
    resumed: float | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class DistillReport(Report):
    """Report of a distillation. `views` holds its selection of views, or None."""

    rounds: tuple[RoundReport, ...]
    seconds: StageSeconds
    views: ViewsReport | None
