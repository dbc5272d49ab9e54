"""Configuration of a distillation: the nested configs of all stages."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from g2ard.config.checks import AtLeastOne, Within
from g2ard.config.choices import Focus, Policy
from g2ard.config.schema import Settings
from g2ard.errors import InputError
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.select.surfaces import CoverageOptions
from g2ard.stages.simplify.config import SimplifyConfig


@dataclass(frozen=True)
class SelectConfig(Settings, tag="policy"):
    """Settings for selecting and weighting training views; `directional` has more.

    Args:
        policy: selection policy, see `g2ard.stages.select.select`.
        views_count: number of views, best first: a count, a share in (0, 1] rounded up, "auto" to stop where
            the curve of gains flattens, or None for all that see the scene.
        weighted: draw views by weight, so that crowded poses do not dominate. On a crowded pool this beats
            uniform draws, and any selection of a tenth of the views.
        reselect: select again from every round's scene instead of once from the prior.
        focus: kind of views to add to generated views, and to given ones without photos: near, at eye level
            (standing) or from anywhere in free space; "far" adds none. None adds views from anywhere: 40 % of
            the share of the scene that a usual view misses. Near and standing views are added to these.
        focus_share: their share of the training views.
    """

    policy: Policy = "auto"
    views_count: AtLeastOne | Annotated[float, Within("(0, 1]")] | Literal["auto"] | None = None
    weighted: bool = True
    reselect: bool = False
    focus: Focus | None = None
    focus_share: Annotated[float, Within("[0, 1)")] = 0.5

    if TYPE_CHECKING:  # the settings of a policy are those of its class

        def __init__(self, policy: Policy = "auto", **settings: Any) -> None: ...

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.focus in (None, "far") and self.focus_share != SelectConfig.focus_share:
            raise InputError("has no effect without focus", parameter="focus_share")

    def count_of(self, candidates: int) -> int | Literal["auto"]:
        """Return the number of candidates to take, or "auto".

        >>> SelectConfig(views_count=0.25).count_of(10), SelectConfig().count_of(10)
        (3, 10)
        """
        wanted = 1.0 if self.views_count is None else self.views_count
        if isinstance(wanted, float):
            return math.ceil(wanted * candidates - 1e-9)
        return wanted


@dataclass(frozen=True)
class Poses(SelectConfig, variants=("auto",)):
    """Settings of the policy `auto`, which needs no surface: those of `SelectConfig`."""


@dataclass(frozen=True)
class Directional(CoverageOptions, SelectConfig, variants=("directional",)):
    """Settings of the policy `directional`: those of `CoverageOptions`."""

    policy: Literal["directional"] = "directional"


@dataclass(frozen=True)
class DistillConfig(Settings):
    """Configuration of a distillation; the paper's is `g2ard.preset("paper")`.

    Args:
        select: selection of training views.
        simplify: simplification; its `retention` also sets the counts of rounds (0.75 if None).
        recover: recovery. A schedule with `round_steps` recovers after every round, as the paper does;
            otherwise there is one reduction and one recovery. If `steps` is None, the schedule's are taken,
            and more if a view shows little of the scene (`g2ard.stages.recover.config`). Rounds share
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
        super().__post_init__()
        if self.select.reselect and not self.recover.schedule.round_steps:
            raise InputError(
                "has no effect on a schedule without rounds", parameter="select.reselect"
            )
