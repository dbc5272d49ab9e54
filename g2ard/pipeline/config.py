"""Configuration of a distillation: the nested configs of all stages, and presets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from g2ard.config.checks import AtLeastOne, Within, checks_arguments
from g2ard.config.choices import UNMEASURED, Focus, Policy
from g2ard.config.schema import Settings, changed, full_paths
from g2ard.errors import InputError, require
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.select.surfaces import CoverageOptions, SurfaceOptions
from g2ard.stages.simplify.config import SimplifyConfig


@dataclass(frozen=True)
class SelectConfig(Settings, tag="policy"):
    """Settings for selecting and weighting training views; `directional` and `coverage` have more.

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
        if self.views_count == "auto" and self.policy in UNMEASURED:
            raise InputError(
                f"policy {self.policy} does not measure gains; pass a count instead of auto",
                parameter="views_count",
            )
        if self.focus in (None, "far") and self.focus_share != SelectConfig.focus_share:
            raise InputError("has no effect without focus", parameter="focus_share")

    def count_of(self, candidates: int) -> int | Literal["auto"]:
        """Return the number of candidates to take, or "auto".

        >>> SelectConfig(views_count=0.25).count_of(10), SelectConfig().count_of(10)
        (3, 10)
        """
        wanted = 1.0 if self.views_count is None else self.views_count
        return math.ceil(wanted * candidates - 1e-9) if isinstance(wanted, float) else wanted


@dataclass(frozen=True)
class Poses(SelectConfig, variants=("auto", "pose-diverse", "random", "uniform")):
    """Settings of policies that need no surface: those of `SelectConfig`."""


@dataclass(frozen=True)
class Coverage(SurfaceOptions, SelectConfig, variants=("coverage",)):
    """Settings of the policy `coverage`: those of `SurfaceOptions`."""

    policy: Literal["coverage"] = "coverage"


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
    """

    select: SelectConfig = field(default_factory=SelectConfig)
    simplify: SimplifyConfig = field(default_factory=SimplifyConfig)
    recover: RecoverConfig = field(default_factory=RecoverConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.select.reselect and not self.recover.schedule.round_steps:
            raise InputError("has no effect on a schedule without rounds", parameter="select.reselect")


Config = TypeVar("Config")

_PAPER: dict[str, Any] = {
    "select.policy": "directional",
    "select.views_count": 0.5,
    "select.weighted": False,
    "select.reselect": False,
    "simplify.method": "paper",
    "simplify.fold": 0.0,
    "recover.schedule": "paper",
    "recover.sh_degree": 3,
    "adapt.schedule": "paper",
    "adapt.sh_degree": 3,
}

PRESETS: dict[str, dict[str, Any]] = {
    "auto": {},
    **{kind: {"recover.regularizers": kind} for kind in ("trained", "lift", "noisy")},
    **{
        kind: {**_PAPER, "recover.regularizers": kind}
        for kind in ("paper", "paper-trained", "paper-lift", "paper-noisy")
    },
}
"""Preset name → values by path. `auto` and `paper` choose their regularisers by measuring the scene."""

GS_CPR: dict[str, Any] = {
    "register.matcher": "sift",
    "register.refine": "none",
    "register.passes": 1,
    "register.min_inliers": 6,
    "register.fallback": False,
}
"""The protocol of GS-CPR for `g2ard register`: one pass of feature matching, without a fallback."""


def configured(config: Config, preset: str = "auto", settings: Mapping[str, Any] | None = None) -> Config:
    """Apply a preset to a config, then individual settings.

    A schedule given by name is scaled to `recover.steps`. The paper's schedule implies SH degree 3.

    Args:
        config: config of one stage or of several; the preset's values for others are ignored.
        settings: values by path or unambiguous tail.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> config = configured(RecoverConfig(), "paper", {"steps": 3000})
    >>> config.schedule.steps, config.schedule.round_steps, config.sh_degree
    (3000, 800, 3)
    """
    from g2ard.stages.recover.config import Schedule

    require("preset", repr(preset), preset in PRESETS, f"one of {', '.join(PRESETS)}")
    given = full_paths(settings or {}, config)
    values = {**PRESETS[preset], **given}
    schedule, steps = values.get("recover.schedule", "default"), values.get("recover.steps")
    if isinstance(schedule, str):
        given = dict(given)
        if schedule == "paper":
            given.setdefault("recover.sh_degree", 3)
        named = Schedule.named(schedule)
        given["recover.schedule"] = named if steps is None else named.scaled(steps)
    made = changed(changed(config, PRESETS[preset]), given)
    select = getattr(made, "select", None)
    if select and select.views_count is None and select.policy != "auto" and "select.policy" in given:
        raise InputError("has no effect without views_count", parameter="select.policy")
    return made


@checks_arguments
def preset(name: str = "paper", config: Any = None) -> Any:
    """Return the configuration of a preset; change it further with `dataclasses.replace`.

    `paper` follows the paper (`tab:s_config`, `tab:s_avs`, `tab:s_recovery`): simplification in rounds that
    keep 75 %; half of the views, selected directionally once from the raw prior and drawn uniformly; 8,000
    steps after every round and 30,000 at the end, none of them undone; anchors from each round's
    construction; SH degree 3; 7,000 steps of adaptation. `docs/g2ard-and-the-paper.md` lists the readings of
    what the paper leaves open.

    Args:
        name: auto, trained, lift, noisy, paper, paper-trained, paper-lift or paper-noisy. `auto` and `paper`
            use the weights of a trained scene here; `g2ard.distill` measures the scene to choose.
        config: the config to apply it to, such as `AdaptConfig()`; None means `DistillConfig()`.

    Raises:
        InputError: an unknown name.

    >>> paper = preset("paper-lift")
    >>> paper.simplify.method, paper.recover.regularizers.anchor, paper.recover.schedule.round_steps
    ('paper', 0.001, 8000)
    """

    config = DistillConfig() if config is None else config
    known = is_dataclass(config) and not isinstance(config, type)
    require("config", repr(config), known, "a config, such as AdaptConfig()")
    return configured(config, name)
