"""What the studies of recovery compare: variants by name, each with its schedule and regularisers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from g2ard.stages.recover.anchors import Regularizers
from g2ard.stages.recover.schedule import PAPER, TUNED, Schedule

__all__ = ["STUDIES", "Plan"]

_PAPER_FINAL = 3_000
"""The paper's 30,000 and 8,000 steps, at a tenth."""


@dataclass(frozen=True)
class Plan:
    """What a variant does."""

    schedule: Schedule
    steps: int | None = None
    recovery_time: float | None = None
    regularizers: Regularizers | None = None


def _curves(steps: Sequence[int], seconds: float, preset: Regularizers) -> dict[str, Plan]:
    """The default over several horizons, the paper's schedule at a tenth, and that with a decay."""
    paper = PAPER.scaled(_PAPER_FINAL)
    plans = {f"default@{n}": Plan(TUNED, steps=n) for n in steps}
    plans["paper/10"] = Plan(paper)
    plans["paper/10-decay"] = Plan(replace(paper, cosine_floor=TUNED.cosine_floor))
    return plans


def _regularizers(steps: Sequence[int], seconds: float, preset: Regularizers) -> dict[str, Plan]:
    parts = {
        "full": preset,
        "-anchor": replace(preset, anchor=0.0),
        "-shape": replace(preset, shape=0.0),
        "none": replace(preset, anchor=0.0, shape=0.0),
    }
    return {name: Plan(TUNED, steps=steps[-1], regularizers=weights) for name, weights in parts.items()}


def _rounds(steps: Sequence[int], seconds: float, preset: Regularizers) -> dict[str, Plan]:
    """Equal recovery seconds: one shot, or shared with rounds in the paper's proportion or a lighter one."""
    shares = {"one-shot": 0.0, "rounds": PAPER.round_steps / PAPER.steps, "light-rounds": 0.05}
    return {
        name: Plan(replace(TUNED, round_steps=round(share * TUNED.steps)), recovery_time=seconds)
        for name, share in shares.items()
    }


def _multiplier(steps: Sequence[int], seconds: float, preset: Regularizers) -> dict[str, Plan]:
    fixed = {"×0.33": 1 / 3, "×0.58": 3**-0.5, "×1": 1.0, "×1.73": 3**0.5}
    plans = {name: Plan(replace(TUNED, multiplier=m), steps=steps[-1]) for name, m in fixed.items()}
    return {**plans, "chosen": Plan(TUNED, steps=steps[-1])}


def _endurance(steps: Sequence[int], seconds: float, preset: Regularizers) -> dict[str, Plan]:
    return {"default": Plan(TUNED, steps=5000)}


def _paper(steps: Sequence[int], seconds: float, preset: Regularizers) -> dict[str, Plan]:
    return {"paper": Plan(PAPER), **{f"default@{n}": Plan(TUNED, steps=n) for n in steps}}


STUDIES: dict[str, Callable[[Sequence[int], float, Regularizers], dict[str, Plan]]] = {
    "curves": _curves,
    "regularizers": _regularizers,
    "rounds": _rounds,
    "multiplier": _multiplier,
    "endurance": _endurance,
    "paper": _paper,
}
"""curves: against the paper's schedule at a tenth; paper: against all of it; rounds: at equal seconds;
endurance: 5,000 steps, fails on a value that is not finite."""
