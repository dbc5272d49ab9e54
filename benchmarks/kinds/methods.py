"""Methods of a matched study: how each reduces, in which rounds, and how it recovers."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks import baselines
from benchmarks.study import key
from g2ard.config.choices import METHODS as SIMPLIFIERS
from g2ard.config.choices import POLICIES, SCHEDULE_NAMES
from g2ard.errors import InputError

__all__ = ["FINAL_STEPS", "METHODS", "REDUCERS", "ROUND_STEPS", "Leg", "Matched", "MethodSpec"]

REDUCERS = (*SIMPLIFIERS, "no-views", "splat-transform", "splat-transform-adaptive", *baselines.METHODS)
"""What reduces a scene: g2ard's methods, another program, baselines."""

ROUND_STEPS, FINAL_STEPS = 8_000, 30_000
"""Of the paper's recoveries (`tab:s_config`): after each round, and once more at the target count."""


@dataclass(frozen=True)
class Matched:
    """What a cell may spend: `amount` steps or seconds, what the method's release spends, or nothing."""

    kind: str
    amount: float = 0.0

    @property
    def label(self) -> str:
        """Its name in rows and charts."""
        named = {"steps": f"{self.amount:g} steps", "seconds": f"{self.amount:g} s", "none": "as it is"}
        return named.get(self.kind, self.kind)


@dataclass(frozen=True)
class Leg:
    """One recovery of a method.

    Args:
        round: the reduction it follows, from 0.
        final: whether it is the last, in which the paper's appearance rates decay otherwise (`tab:s_config`).
        share: of the matched steps or seconds.
    """

    round: int
    final: bool
    share: float


@dataclass(frozen=True)
class MethodSpec:
    """One method.

    Args:
        name: its name in the rows.
        reduce: one of `REDUCERS`, or "none": the prior as it is, a teacher's row.
        rounds: "one" shot; "paper", 75 % a round with recovery after each and once more at the end; "pup",
            its two.
        prior: "lift", "trained" or "given"; None means the scene's usual one.
        policy: of view selection; None trains on all views.
        k: share of the training views that the policy keeps.
        shared_start: the policy's views serve the last recovery only. What comes before takes all views and
            the study's first seed, so that rows continue from one checkpoint (`tab:s_policy`). The matched
            amount is the last recovery's.
        preset: of the regularisers; auto goes by the prior's kind if that is known, otherwise measures it.
        lambdas: "own" weights of the regularisers, or the "paper"'s (`tab:s_recovery`).
        anchor: overrides the weight of L_anchor.
        shape: overrides the weight of L_shape; 0 also ends the effective rank's barrier.
        effective_rank: overrides whether the needle barrier of L_shape is on.
        period: overrides the steps between two additions of the regularisers.
        protection: λ_h of the `paper` policy; 0 takes the flags away.
        schedule: rates of the matched cells; None means the study's.
        released_steps: steps of each recovery in the method's own release, of the last one if rounds are the
            paper's (8,000 after each round come before). None means that there is no release.
        released_schedule: their rates.
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
    anchor: float | None = key(None, least=0)
    shape: float | None = key(None, least=0)
    effective_rank: bool | None = key(None)
    period: int | None = key(None, least=1)
    protection: float | None = key(None, least=0)
    schedule: str | None = key(None, choices=SCHEDULE_NAMES)
    released_steps: int | None = key(None, least=0)
    released_schedule: str = key("3dgs", choices=("3dgs", "paper", "default"))

    def __post_init__(self) -> None:
        if not 0 < self.k <= 1:
            raise InputError(f"k: expected a share in (0, 1], got {self.k}")

    @property
    def recovers(self) -> bool:
        """Whether there is anything to match; a teacher's row is the prior alone."""
        return self.reduce != "none"

    def legs(self, rounds: int) -> list[Leg]:
        """Return the recoveries over so many reductions; the shares add up to 1, except a shared start's.

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


_PAPER = MethodSpec(
    "g2ard-paper",
    "paper",
    rounds="paper",
    lambdas="paper",
    released_steps=FINAL_STEPS,
    released_schedule="paper",
)
METHODS: dict[str, MethodSpec] = {
    m.name: m
    for m in (
        MethodSpec("g2ard", "default"),
        MethodSpec("g2ard-fast", "fast"),
        _PAPER,
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
"""What a study may name without describing it. Released steps of PUP and LightGaussian are those of their
papers. Mini-Splatting trains on for 15,000 once it has simplified. NanoGS and splat-transform do not
recover."""
