"""Configuration of a distillation: every stage's, nested."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from g2ard.config.choices import UNMEASURED, Policy
from g2ard.errors import InputError, require
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.select.surfaces import CoverageOptions
from g2ard.stages.simplify.config import SimplifyConfig


@dataclass(frozen=True)
class SelectConfig(CoverageOptions):
    """Which views recovery learns from, and how often it draws each; and `CoverageOptions`.

    Args:
        views_count: how many of the views, best first: a count, a share in (0, 1] rounded up, "auto" for as
            many as the curve of gains asks for, or None for all that see the scene.
        policy: how views are chosen, see `g2ard.stages.select`.
        weighted: draw views by weights, their own or the selection's, so that crowded poses do not rule: on a
            crowded pool all views drawn so beat an even draw, and every choice of a tenth of them.
        reselect: choose again from every round's scene instead of once from the raw prior.
    """

    views_count: int | float | Literal["auto"] | None = None
    policy: Policy = "auto"
    weighted: bool = True
    reselect: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        share = not isinstance(self.views_count, float) or 0 < self.views_count <= 1
        require("views_count", self.views_count, share, "a count, auto, none, or a share in (0, 1]")
        if self.views_count == "auto" and self.policy in UNMEASURED:
            raise InputError(
                f"policy {self.policy} does not measure what views add; give a count, not auto",
                parameter="views_count",
            )

    def count_of(self, candidates: int) -> int | Literal["auto"]:
        """Return how many of the candidates to take, or "auto".

        >>> SelectConfig(views_count=0.25).count_of(10), SelectConfig().count_of(10)
        (3, 10)
        """
        wanted = 1.0 if self.views_count is None else self.views_count
        return math.ceil(wanted * candidates - 1e-9) if isinstance(wanted, float) else wanted


@dataclass(frozen=True)
class DistillConfig:
    """How a scene is distilled; the paper's way is `g2ard.preset("paper")`.

    Args:
        select: which views are learned from.
        simplify: how the scene is reduced; its retention also sets the counts of rounds, 0.75 if None.
        recover: how it is recovered. A schedule with `round_steps` recovers after every round of 75 % (the
            paper); without them the reduction is one shot and all recovery happens at the target count.
            `steps` None means the schedule's, more where a view holds little of the scene
            (`g2ard.stages.recover.schedule`); rounds share `recovery_time` in proportion to their steps.
        lift: how a cloud becomes a scene.
    """

    select: SelectConfig = field(default_factory=SelectConfig)
    simplify: SimplifyConfig = field(default_factory=SimplifyConfig)
    recover: RecoverConfig = field(default_factory=RecoverConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
