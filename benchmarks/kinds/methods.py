"""Methods of a matched study: reduction, rounds and recovery."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

from benchmarks import baselines
from benchmarks.policies import POLICIES
from benchmarks.study import key
from g2ard.config.choices import Method, ScheduleName
from g2ard.errors import InputError
from g2ard.stages.recover.anchors import REGULARIZERS

__all__ = ["FINAL_STEPS", "METHODS", "REDUCERS", "ROUND_STEPS", "Budget", "Leg", "MethodSpec"]

REDUCERS = (
    *get_args(Method),
    "no-views",
    "splat-transform",
    "splat-transform-adaptive",
    *baselines.METHODS,
)
"""Reductions: g2ard's methods, splat-transform, baselines."""

ROUND_STEPS, FINAL_STEPS = 8_000, 30_000
"""Steps of the paper's recoveries after each round and at the target count (`tab:s_config`)."""


@dataclass(frozen=True)
class Budget:
    """The budget of a cell: `amount` "steps" or "seconds", the steps of the method's release, or "none"."""

    kind: str
    amount: float = 0.0


@dataclass(frozen=True)
class Leg:
    """A recovery of a method.

    Args:
        round: index of the reduction before it.
        final: whether it is the last, for which the paper has other appearance rates (`tab:s_config`).
        share: share of the matched steps or seconds.
    """

    round: int
    final: bool
    share: float


@dataclass(frozen=True)
class MethodSpec:
    """A method.

    Args:
        name: name in rows.
        reduce: one of `REDUCERS`, or "none" for the prior itself, the teacher's row.
        rounds: "one" shot; "paper": 75 % per round, with recovery after each and at the end; "pup": two.
        prior: "lift", "trained" or "given"; None means the scene's default.
        policy: policy of view selection; None trains on all views.
        k: share of training views that the policy keeps.
        shared_start: whether only the last recovery uses the policy's views. Earlier stages use all views
            and the study's first seed, so that rows continue from one checkpoint (`tab:s_policy`), and only
            the last recovery is matched.
        preset: preset of the regularisers; auto uses the prior's kind if known, or measures it.
        lambdas: weights of the regularisers: "own" or "paper" (`tab:s_recovery`).
        regularizers: fields of `Regularizers` that override those weights.
        protection: λ_h of the `paper` policy; 0 disables flags.
        schedule: rates of matched cells; None means the study's.
        released_steps: steps per recovery in the method's release, or of the last one with the paper's
            rounds (after 8,000 per round). None if there is no release.
        released_schedule: rates of the release.
    """

    name: str
    reduce: str = key(choices=(*REDUCERS, "none"))
    rounds: str = key("one", choices=("one", "paper", "pup"))
    prior: str | None = key(None, choices=("lift", "trained", "given"))
    policy: str | None = key(None, choices=POLICIES)
    k: float = key(1.0, least=0)
    shared_start: bool = key(False)
    preset: str = key("auto", choices=("auto", "trained", "lift", "noisy"))
    lambdas: str = key("own", choices=("own", "paper"))
    regularizers: Mapping[str, Any] = key({})
    protection: float | None = key(None, least=0)
    schedule: str | None = key(None, choices=get_args(ScheduleName))
    released_steps: int | None = key(None, least=0)
    released_schedule: str = key("3dgs", choices=("3dgs", "paper", "default"))

    def __post_init__(self) -> None:
        if not 0 < self.k <= 1:
            raise InputError(f"k: expected a share in (0, 1], got {self.k}")
        replace(REGULARIZERS["lift"], **self.regularizers)  # checks names and values

    @property
    def recovers(self) -> bool:
        """Whether the method recovers; the teacher's row does not."""
        return self.reduce != "none"

    def legs(self, rounds: int) -> list[Leg]:
        """Return the recoveries for a number of reductions; shares sum to 1, except with a shared start.

        >>> [(leg.round, leg.final, round(leg.share, 3)) for leg in METHODS["g2ard-paper"].legs(2)]
        [(0, False, 0.174), (1, False, 0.174), (1, True, 0.652)]
        """
        last = rounds - 1
        twice = self.rounds == "paper"
        if self.shared_start:
            share = ROUND_STEPS / FINAL_STEPS if twice else 0.5
            return [*(Leg(n, False, share) for n in range(last)), Leg(last, True, 1.0)]
        early = rounds if twice else last
        whole = ROUND_STEPS * early / (ROUND_STEPS * early + FINAL_STEPS) if twice else 0.5
        share = whole / early if early else 0.0
        return [*(Leg(n, False, share) for n in range(early)), Leg(last, True, 1 - share * early)]


METHODS: dict[str, MethodSpec] = {
    m.name: m
    for m in (
        MethodSpec("g2ard", "default"),
        MethodSpec("g2ard-fast", "fast"),
        MethodSpec(
            "g2ard-paper",
            "paper",
            rounds="paper",
            lambdas="paper",
            released_steps=FINAL_STEPS,
            released_schedule="paper",
        ),
        MethodSpec("lightgaussian", "lightgaussian", released_steps=5_000),
        MethodSpec("pup", "pup", rounds="pup", released_steps=5_000),
        MethodSpec("mini-splatting", "mini-splatting", released_steps=15_000),
        MethodSpec("nanogs", "nanogs", released_steps=0),
        MethodSpec("opacity-area", "opacity-area"),
        MethodSpec("random", "random"),
        MethodSpec("splat-transform", "splat-transform", released_steps=0),
        MethodSpec("splat-transform-adaptive", "splat-transform-adaptive", released_steps=0),
        MethodSpec("teacher", "none"),
    )
}
"""Predefined methods. Released steps of PUP and LightGaussian are from their papers. Mini-Splatting trains
for 15,000 steps after simplification. NanoGS and splat-transform do not recover."""
