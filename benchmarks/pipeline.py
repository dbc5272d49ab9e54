"""What one cell does, stage by stage, and what it may spend."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from benchmarks import baselines
from benchmarks.baselines.pup import rounds as pup_rounds
from benchmarks.definition import Definition, SceneSpec
from benchmarks.methods import ROUND_STEPS, Leg, Matched, MethodSpec
from benchmarks.process import Usage
from benchmarks.workspace import Stage, Workspace, fingerprint, scene_key
from g2ard import io
from g2ard.scene.splats import Splats
from g2ard.stages.recover.presets import preset_for
from g2ard.stages.simplify import METHODS as SIMPLIFIERS
from g2ard.stages.simplify import round_counts

__all__ = ["Cell", "Pipeline", "Spent"]


@dataclass(frozen=True)
class Cell:
    """What is to be measured, and where its answer lies."""

    definition: Definition
    scene: SceneSpec
    ratio: float
    method: MethodSpec
    matched: Matched
    seed: int

    @cached_property
    def key(self) -> str:
        """Changes with anything that could change the figures, the scene's files included."""
        d = self.definition
        shared: tuple[Any, ...] = (
            d.name,
            d.schedule,
            d.sh_degree,
            d.adapt_steps,
            d.lpips,
            scene_key(d, self.scene),
        )
        shared += (d.adapt_schedule, d.adapt_on, d.convention, d.eight_bit, d.lpips_input)
        if self.method.shared_start:
            shared += (d.seeds[0],)
        return fingerprint([*shared, asdict(self.method), asdict(self.matched), self.ratio, self.seed])

    @property
    def label(self) -> str:
        return f"{self.scene.name} {self.ratio:g}× {self.method.name} ({self.matched.label})"


@dataclass
class Spent:
    """What the stages of one kind took together."""

    cpu: float = 0.0
    wall: float = 0.0
    peak: float = 0.0

    def add(self, usage: Usage, wall: float | None = None) -> None:
        self.cpu += usage.cpu_s
        self.wall += usage.wall_s if wall is None else wall
        self.peak = max(self.peak, usage.peak_mb)


class Pipeline:
    """One cell's stages, from the prior to the scene that is scored."""

    def __init__(self, workspace: Workspace, cell: Cell) -> None:
        self.workspace, self.cell = workspace, cell
        self.source = workspace.prior(cell.method.prior)
        self.prior = cell.method.prior or workspace.kinds[0]
        splats = io.read_splats(self.source.output)
        self.count = len(splats)
        self.budget = max(1, math.floor(self.count / cell.ratio + 0.5))
        self.regularizers = self._regularizers(splats)
        self.sh_degree = cell.definition.sh_degree
        if self.sh_degree is None and cell.scene.targets != "teacher":
            self.sh_degree = 3
        self.selecting, self.reducing, self.recovering, self.adapting = (Spent() for _ in range(4))
        self.steps = 0
        self.last: dict[str, Any] = {}

    def _regularizers(self, prior: Splats) -> dict[str, Any]:
        """The weights that the method asks for: the paper's for this kind of prior, or ours."""
        method = self.cell.method
        known = {"trained": "trained", "lift": "lift"} if method.lambdas == "paper" else {}
        kind = known.get(self.prior, "auto") if method.preset == "auto" else method.preset
        chosen, _, _ = preset_for(kind, prior, paper=method.lambdas == "paper")
        if method.anchor is not None:
            chosen = replace(chosen, anchor=method.anchor)
        if method.shape is not None:
            chosen = replace(chosen, shape=method.shape, effective_rank=method.shape > 0)
        if method.effective_rank is not None:
            chosen = replace(chosen, effective_rank=method.effective_rank)
        if method.period is not None:
            chosen = replace(chosen, period=method.period)
        return asdict(chosen)

    def counts(self) -> list[int]:
        """Of each round; the last is the budget."""
        if not self.cell.method.recovers:
            return []
        rounds = self.cell.method.rounds
        if rounds == "paper":
            return round_counts(self.count, self.budget) or [self.budget]
        return pup_rounds(self.count, self.budget) if rounds == "pup" else [self.budget]

    def run(self) -> Stage:
        """The scene that is scored."""
        method, workspace = self.cell.method, self.workspace
        views = workspace.train
        if method.policy is not None:
            chosen = workspace.select(self.source, method.policy, method.k, self.cell.seed)
            views = chosen.output
            self.selecting.add(chosen.usage)
        early = workspace.train if method.shared_start else views
        counts = self.counts()
        legs = method.legs(len(counts)) if counts else []
        state, flags = self.source, None
        for number, count in enumerate(counts):
            built = state = self._reduce(state, early, count, flags)
            if method.reduce in (*SIMPLIFIERS, "no-views"):
                flags = state.output.with_name("flags.npy")
            for leg in (leg for leg in legs if leg.round == number):
                state = self._recover(state, views if leg.final else early, leg, legs, built)
        if self.cell.definition.adapt_steps:
            state = workspace.readapt(state, self.sh_degree, self.cell.seed)
            self.adapting.add(state.usage)
        return state

    def _seed(self, final: bool) -> int:
        """What comes before a shared start's last recovery is every row's."""
        shared = self.cell.method.shared_start and not final
        return self.cell.definition.seeds[0] if shared else self.cell.seed

    def _reduce(self, state: Stage, views: Path, count: int, flags: Path | None) -> Stage:
        method = self.cell.method
        job: dict[str, Any] = {"method": method.reduce, "count": count, "seed": self._seed(False)}
        if method.reduce not in baselines.METHODS:
            job |= {"budget": self.budget, "protection": method.protection}
        done = self.workspace.reduce(state, views, job, flags)
        self.reducing.add(done.usage, done.report.get("seconds"))
        return done

    def _recover(self, state: Stage, views: Path, leg: Leg, legs: list[Leg], built: Stage) -> Stage:
        """One recovery; what goes on from another at the same count stays held to the geometry as `built`."""
        spend = self._spend(leg, legs)
        if spend is None:
            return state
        job = {
            **spend,
            "regularizers": self.regularizers,
            "sh_degree": self.sh_degree,
            "final": leg.final,
            "seed": self._seed(leg.final),
        }
        done = self.workspace.recover(state, views, job, None if state is built else built)
        self.recovering.add(done.usage, done.report["seconds"])
        self.steps += done.report["steps"]
        self.last = done.report
        return done

    def _spend(self, leg: Leg, legs: list[Leg]) -> dict[str, Any] | None:
        """Rates, and steps or seconds, of a recovery; None where there is none."""
        method, matched = self.cell.method, self.cell.matched
        if matched.kind == "released":
            if not method.released_steps:
                return None
            rounds_own = method.rounds == "paper" and not leg.final
            steps = ROUND_STEPS if rounds_own else method.released_steps
            return {"schedule": method.released_schedule, "steps": steps, "seconds": None}
        schedule = method.schedule or self.cell.definition.schedule
        before = legs[: legs.index(leg)]
        if method.shared_start:  # the checkpoint is not matched
            before = []
        if matched.kind == "steps":
            steps = int(leg.share * matched.amount)
            if leg.final:
                steps = int(matched.amount) - sum(int(b.share * matched.amount) for b in before)
            return {"schedule": schedule, "steps": steps, "seconds": None} if steps else None
        spent = self.selecting.wall
        if not method.shared_start:
            spent += self.reducing.wall + self.recovering.wall
        left = matched.amount - spent
        if left <= 0:  # scored as it is: the row's seconds say that they were not enough
            return None
        limit = left if leg.final else left * leg.share / (1 - sum(b.share for b in before))
        return {"schedule": schedule, "steps": None, "seconds": round(limit, 3)}
