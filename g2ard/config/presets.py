"""Whole configurations by name: what every stage is to do so that together they are a published method."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from g2ard.errors import InputError
from g2ard.pipeline import DistillConfig
from g2ard.pipeline.adapt import AdaptConfig
from g2ard.stages.recover.anchors import PAPER_PRESETS
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.schedule import PAPER
from g2ard.stages.select.surfaces import CoverageOptions
from g2ard.stages.simplify.config import SimplifyConfig

__all__ = ["Preset", "preset"]


@dataclass(frozen=True)
class Preset:
    """A configuration of every stage; each field is what the function of its name takes.

    Args:
        method: simplification's, for `simplify(method=…)`.
        simplify: its constants.
        policy: of view selection, for `select(policy=…)`.
        views: the share of the candidates that it keeps.
        select: its constants.
        recover: of one recovery at the target count; those of rounds have `final=False`.
        distill: of the pipeline, all of the above in it.
        adapt: of new appearance on frozen geometry.
    """

    method: str
    policy: str
    views: float
    recover: RecoverConfig
    distill: DistillConfig
    adapt: AdaptConfig
    simplify: SimplifyConfig = field(default_factory=SimplifyConfig)
    select: CoverageOptions = field(default_factory=CoverageOptions)


def preset(name: str = "paper", prior: str = "trained") -> Preset:
    """A preset; `dataclasses.replace` changes what is wanted otherwise.

    `paper` is the paper (`tab:s_config`, `tab:s_avs`, `tab:s_recovery`): simplification in rounds of 75 %;
    half of the views, by directional selection, once, from the raw prior; an even draw of them; 8,000 steps
    after every round and 30,000 at the end, all of them kept; anchors of each round's construction; SH of
    degree 3; 7,000 steps of adaptation. Where it is silent `docs/decisions.md` says what we read.

    Args:
        name: "paper".
        prior: the row of `tab:s_recovery`: trained, lift (an untrained cloud's), or noisy (trained and less
            regular). `g2ard.stages.recover.presets.preset_for("paper", …)` measures which.

    Returns:
        A `Preset`: the configurations of simplify, select, recover, distill and adapt.

    Raises:
        InputError: no such preset, or prior.

    >>> paper = preset("paper", prior="lift")
    >>> paper.distill.method, paper.distill.regularizers.anchor, paper.recover.schedule.round_steps
    ('paper', 0.001, 8000)
    """
    if name != "paper":
        raise InputError(f"expected paper, got {name!r}", parameter="preset")
    if prior not in PAPER_PRESETS:
        raise InputError(f"expected {', '.join(PAPER_PRESETS)}, got {prior!r}", parameter="prior")
    recover = RecoverConfig(schedule=PAPER, regularizers=PAPER_PRESETS[prior], sh_degree=3)
    distill = DistillConfig(
        method="paper",
        schedule=PAPER,
        regularizers=recover.regularizers,
        sh_degree=3,
        views=0.5,
        policy="directional",
        weighted=False,
    )
    adapt = replace(AdaptConfig(), schedule="paper", tolerance=0.0, prior_views=0.0, sh_degree=3)
    return Preset("paper", "directional", 0.5, recover, distill, adapt)
