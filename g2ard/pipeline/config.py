"""Configuration of a distillation: the nested configs of all stages."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from g2ard.config.checks import check_fields
from g2ard.config.choices import UNMEASURED, Focus, Policy
from g2ard.errors import InputError, require
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.select.surfaces import CoverageOptions
from g2ard.stages.simplify.config import SimplifyConfig


@dataclass(frozen=True)
class SelectConfig(CoverageOptions):
    """Options for selecting and weighting training views, in addition to `CoverageOptions`.

    Args:
        views_count: number of views, best first: a count, a share in (0, 1] rounded up, "auto" to stop where
            the curve of gains flattens, or None for all that see the scene.
        policy: selection policy, see `g2ard.stages.select.select`.
        weighted: draw views by weight, so that crowded poses do not dominate. On a crowded pool this beats
            uniform draws, and any selection of a tenth of the views.
        reselect: select again from every round's scene instead of once from the prior.
        focus: kind of views to add to generated views, and to given ones without photos: near, at eye level
            (standing) or from anywhere in free space; "far" adds none. None adds views from anywhere: 40 % of
            the share of the scene that a usual view misses. Near and standing views are added to these.
        focus_share: their share of the training views.
    """

    views_count: int | float | Literal["auto"] | None = None
    policy: Policy = "auto"
    weighted: bool = True
    reselect: bool = False
    focus: Focus | None = None
    focus_share: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        share = not isinstance(self.views_count, float) or 0 < self.views_count <= 1
        share = share and not (isinstance(self.views_count, int) and self.views_count < 1)
        require("views_count", self.views_count, share, "a count, auto, none, or a share in (0, 1]")
        require("focus_share", self.focus_share, 0 <= self.focus_share < 1, "a share in [0, 1)")
        if self.views_count == "auto" and self.policy in UNMEASURED:
            raise InputError(
                f"policy {self.policy} does not measure gains; pass a count instead of auto",
                parameter="views_count",
            )

    def count_of(self, candidates: int) -> int | Literal["auto"]:
        """Return the number of candidates to take, or "auto".

        >>> SelectConfig(views_count=0.25).count_of(10), SelectConfig().count_of(10)
        (3, 10)
        """
        wanted = 1.0 if self.views_count is None else self.views_count
        return math.ceil(wanted * candidates - 1e-9) if isinstance(wanted, float) else wanted


@dataclass(frozen=True)
class DistillConfig:
    """Configuration of a distillation; the paper's is `g2ard.preset("paper")`.

    Args:
        select: selection of training views.
        simplify: simplification; its `retention` also sets the counts of rounds (0.75 if None).
        recover: recovery. A schedule with `round_steps` recovers after every round, as the paper does;
            otherwise there is one reduction and one recovery. If `steps` is None, the schedule's are taken,
            and more if a view shows little of the scene (`g2ard.stages.recover.schedule`). Rounds share
            `recovery_time` in proportion to their steps.
        lift: lifting of point clouds.

    Raises:
        InputError: an invalid value.
    """

    select: SelectConfig = field(default_factory=SelectConfig)
    simplify: SimplifyConfig = field(default_factory=SimplifyConfig)
    recover: RecoverConfig = field(default_factory=RecoverConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)

    def __post_init__(self) -> None:
        check_fields(self)
