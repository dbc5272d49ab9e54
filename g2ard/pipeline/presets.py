"""Presets: settings by path that make up a method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any, TypeVar

from g2ard.config.checks import checks_arguments
from g2ard.config.choices import Named
from g2ard.config.schema import changed, full_paths
from g2ard.errors import InputError, require

Config = TypeVar("Config")

_PAPER: Named = {
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

PRESETS: dict[str, Named] = {
    "auto": {},
    **{kind: {"recover.regularizers": kind} for kind in ("trained", "lift", "noisy")},
    **{
        kind: {**_PAPER, "recover.regularizers": kind}
        for kind in ("paper", "paper-trained", "paper-lift", "paper-noisy")
    },
}
"""Preset name → values by path. `auto` and `paper` choose their regularisers by measuring the scene."""


def configure(
    config: Config, preset: str = "auto", settings: Mapping[str, Any] | None = None
) -> Config:
    """Apply a preset to a config, then individual settings.

    A schedule given by name is scaled to `recover.steps`. The paper's schedule implies SH degree 3.

    Args:
        config: config of one stage or of several; the preset's values for others are ignored.
        settings: values by path or unambiguous tail.

    >>> from g2ard.stages.recover.config import RecoverConfig
    >>> config = configure(RecoverConfig(), "paper", {"steps": 3000})
    >>> config.schedule.steps, config.schedule.round_steps, config.sh_degree
    (3000, 800, 3)
    """
    from g2ard.stages.recover.config import Schedule

    require("preset", repr(preset), preset in PRESETS, f"one of {', '.join(PRESETS)}")
    given = full_paths(settings or {}, config)
    values = {**PRESETS[preset], **given}
    schedule = values.get("recover.schedule", "default")
    steps = values.get("recover.steps")
    if isinstance(schedule, str):
        given = dict(given)
        if schedule == "paper":
            given.setdefault("recover.sh_degree", 3)
        named = Schedule.named(schedule)
        given["recover.schedule"] = named if steps is None else named.scaled(steps)
    made = changed(changed(config, PRESETS[preset]), given)
    select = getattr(made, "select", None)
    if (
        select
        and select.views_count is None
        and select.policy != "auto"
        and "select.policy" in given
    ):
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
    from g2ard.pipeline.config import DistillConfig

    config = DistillConfig() if config is None else config
    known = is_dataclass(config) and not isinstance(config, type)
    require("config", repr(config), known, "a config, such as AdaptConfig()")
    return configure(config, name)
