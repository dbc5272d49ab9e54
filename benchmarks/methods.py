"""What a study compares: how each method reduces, in which rounds, and what of the recovery is its own."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks import baselines
from g2ard.config.choices import METHODS as SIMPLIFIERS
from g2ard.config.choices import POLICIES, SCHEDULE_NAMES
from g2ard.errors import InputError

__all__ = ["FINAL_STEPS", "METHODS", "REDUCERS", "ROUND_STEPS", "Leg", "Matched", "MethodSpec"]

_RIVALS = ("splat-transform", "splat-transform-adaptive")
REDUCERS = (*SIMPLIFIERS, "no-views", *_RIVALS, *baselines.METHODS)
"""What reduces a scene: g2ard's methods, other programs, baselines."""

ROUND_STEPS, FINAL_STEPS = 8_000, 30_000
"""Of the paper's recoveries (`tab:s_config`): after each round, and once more at the target count."""


@dataclass(frozen=True)
class Matched:
    """What a cell may spend: `amount` steps or seconds, what the method's release spends, or nothing."""

    kind: str
    amount: float = 0.0

    @property
    def label(self) -> str:
        """As rows and charts call it."""
        named = {"steps": f"{self.amount:g} steps", "seconds": f"{self.amount:g} s", "none": "as it is"}
        return named.get(self.kind, self.kind)


@dataclass(frozen=True)
class Leg:
    """One recovery of a method.

    Args:
        round: after which reduction, from 0.
        final: whether it is the last; the paper's appearance rates decay otherwise in it (`tab:s_config`).
        share: of the matched steps or seconds.
    """

    round: int
    final: bool
    share: float


@dataclass(frozen=True)
class MethodSpec:
    """One method.

    Args:
        name: as the rows call it.
        reduce: one of g2ard's policies (default, no-views, fast, paper), a baseline, a rival program, or
            "none": the prior as it is, a teacher's row.
        rounds: "one" shot; "paper", 75 % a round with recovery after each, and one more at the end; "pup",
            its two.
        round_share: share of the matched steps or seconds that the recoveries after rounds take; None means
            the method's own: 8,000 a round to 30,000 at the end for "paper", half for "pup".
        prior: "lift", "trained" or "given": which of the scene's priors; None means the scene's own choice.
        policy: of view selection; None trains on all views.
        k: share of the training views that the policy keeps.
        shared_start: the policy's views serve the last recovery alone. What comes before (all reductions, and
            in rounds their recoveries) takes all views and the study's first seed, so that rows that differ
            in policy go on from one checkpoint (`tab:s_policy`); the matched amount is the last recovery's.
        preset: of the regularisers; auto goes by the prior's kind where that is known, else measures it.
        lambdas: "own" weights of the regularisers, or the "paper"'s (`tab:s_recovery`).
        anchor: overrides the weight of L_anchor.
        shape: overrides the weight of L_shape; 0 also ends the effective rank's barrier.
        effective_rank: overrides whether the needle barrier of L_shape is on.
        period: overrides how many steps there are from one addition of the regularisers to the next, 100.
        protection: λ_h of the `paper` policy; 0 takes the flags away.
        schedule: rates of the matched cells; None means the study's.
        released_steps: steps of each recovery in the method's own release, of the last where rounds are the
            paper's (8,000 after each round come before); None where there is none.
        released_schedule: their rates.
    """

    name: str
    reduce: str
    rounds: str = "one"
    round_share: float | None = None
    prior: str | None = None
    policy: str | None = None
    k: float = 1.0
    shared_start: bool = False
    preset: str = "auto"
    lambdas: str = "own"
    anchor: float | None = None
    shape: float | None = None
    effective_rank: bool | None = None
    period: int | None = None
    protection: float | None = None
    schedule: str | None = None
    released_steps: int | None = None
    released_schedule: str = "3dgs"

    def __post_init__(self) -> None:
        for key, known in (
            ("reduce", (*REDUCERS, "none")),
            ("rounds", ("one", "paper", "pup")),
            ("prior", (None, "lift", "trained", "given")),
            ("policy", (None, *POLICIES)),
            ("preset", ("auto", "trained", "lift", "noisy")),
            ("lambdas", ("own", "paper")),
            ("schedule", (None, *SCHEDULE_NAMES)),
            ("released_schedule", ("3dgs", "paper", "default")),
        ):
            if getattr(self, key) not in known:
                options = ", ".join(str(option) for option in known if option)
                raise InputError(
                    f"method {self.name}: {key}: expected one of {options}, got {getattr(self, key)!r}"
                )
        for key in ("shared_start", "effective_rank"):
            if getattr(self, key) not in (None, True, False):
                value = getattr(self, key)
                raise InputError(f"method {self.name}: {key}: expected true or false, got {value!r}")
        if self.period is not None and self.period < 1:
            raise InputError(f"method {self.name}: period: expected at least 1, got {self.period}")
        if not 0 < self.k <= 1 or not 0 <= (self.round_share or 0) < 1:
            raise InputError(f"method {self.name}: k {self.k} and round_share {self.round_share}: shares")

    @property
    def recovers(self) -> bool:
        """Whether there is anything to match; a teacher's row is the prior alone."""
        return self.reduce != "none"

    def legs(self, rounds: int) -> list[Leg]:
        """The recoveries over so many reductions; their shares add up to 1, but for a shared start's.

        >>> [(leg.round, leg.final, round(leg.share, 3)) for leg in METHODS["g2ard-paper"].legs(2)]
        [(0, False, 0.174), (1, False, 0.174), (1, True, 0.652)]
        """
        last = rounds - 1
        twice = self.rounds == "paper"
        if self.shared_start:
            share = ROUND_STEPS / FINAL_STEPS if twice else 0.5
            return [*(Leg(n, False, share) for n in range(last)), Leg(last, True, 1.0)]
        early = rounds if twice else last
        if self.round_share is not None:
            whole = self.round_share
        else:
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
"""What a definition may name without describing it. PUP's and LightGaussian's released steps are those of
their papers; Mini-Splatting trains on for 15,000 once it has simplified; NanoGS and splat-transform do not
recover. The paper's method takes 8,000 after each round, and after the last 30,000 more (`tab:s_config`). The
teacher is the prior as it is."""
