"""What one cell does, stage by stage, and what it may spend."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from g2ard import baselines, io
from g2ard.baselines.pup import rounds as pup_rounds
from g2ard.bench.definition import Definition, Matched, MethodSpec, SceneSpec
from g2ard.bench.process import Usage
from g2ard.bench.stand import Stage, Stand, fingerprint, scene_key
from g2ard.recover.presets import preset_for
from g2ard.simplify import METHODS as SIMPLIFIERS
from g2ard.simplify import schedule as paper_rounds
from g2ard.splats import Splats

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
        shared = (d.name, d.schedule, d.sh_degree, d.adapt_steps, d.lpips, scene_key(d, self.scene))
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

    def __init__(self, stand: Stand, cell: Cell) -> None:
        self.stand, self.cell = stand, cell
        self.source = stand.prior(cell.method.prior)
        self.prior = cell.method.prior or stand.kinds[0]
        splats = io.read_splats(self.source.output)
        self.count = len(splats)
        self.budget = max(1, math.floor(self.count / cell.ratio + 0.5))
        self.regularizers = self._regularizers(splats)
        self.sh_degree = cell.definition.sh_degree
        if self.sh_degree is None and cell.scene.targets == "photos":
            self.sh_degree = 3
        self.selecting, self.reducing, self.recovering, self.adapting = (Spent() for _ in range(4))
        self.steps = 0
        self.last: dict[str, Any] = {}

    def _regularizers(self, prior: Splats) -> dict[str, Any]:
        method = self.cell.method
        chosen, _, _ = preset_for(method.preset, prior)
        if method.anchor is not None:
            chosen = replace(chosen, anchor=method.anchor)
        if method.shape is not None:
            chosen = replace(chosen, shape=method.shape, effective_rank=method.shape > 0)
        if method.period is not None:
            chosen = replace(chosen, period=method.period)
        return asdict(chosen)

    def counts(self) -> list[int]:
        """Of each round; the last is the budget."""
        rounds = self.cell.method.rounds
        if rounds == "paper":
            return paper_rounds(self.count, self.budget) or [self.budget]
        return pup_rounds(self.count, self.budget) if rounds == "pup" else [self.budget]

    def run(self) -> Stage:
        """The scene that is scored."""
        method, stand = self.cell.method, self.stand
        views = stand.train
        if method.policy is not None:
            chosen = stand.select(self.source, method.policy, method.k, self.cell.seed)
            views = chosen.output
            self.selecting.add(chosen.usage)
        state, flags = self.source, None
        counts = self.counts()
        for number, count in enumerate(counts):
            state = self._reduce(state, views, count, flags)
            if method.reduce in (*SIMPLIFIERS, "no-views"):
                flags = state.output.with_name("flags.npy")
            state = self._recover(state, views, number, len(counts))
        if self.cell.definition.adapt_steps:
            state = stand.readapt(state, self.sh_degree, self.cell.seed)
            self.adapting.add(state.usage)
        return state

    def _reduce(self, state: Stage, views: Path, count: int, flags: Path | None) -> Stage:
        method = self.cell.method
        job: dict[str, Any] = {"method": method.reduce, "count": count, "seed": self.cell.seed}
        if method.reduce not in baselines.METHODS:
            job |= {"budget": self.budget, "protection": method.protection}
        done = self.stand.reduce(state, views, job, flags)
        self.reducing.add(done.usage, done.report.get("seconds"))
        return done

    def _recover(self, state: Stage, views: Path, number: int, rounds: int) -> Stage:
        spend = self._spend(number, rounds)
        if spend is None:
            return state
        job = {
            **spend,
            "regularizers": self.regularizers,
            "sh_degree": self.sh_degree,
            "final": number == rounds - 1,
            "seed": self.cell.seed,
        }
        done = self.stand.recover(state, views, job)
        self.recovering.add(done.usage, done.report["seconds"])
        self.steps += done.report["steps"]
        self.last = done.report
        return done

    def _spend(self, number: int, rounds: int) -> dict[str, Any] | None:
        """Rates, and steps or seconds, of the recovery after a round; None where there is none."""
        method, matched = self.cell.method, self.cell.matched
        final = number == rounds - 1
        if matched.kind == "released":
            if not method.released_steps:
                return None
            steps = method.released_steps if final or method.rounds == "pup" else 8_000
            return {"schedule": method.released_schedule, "steps": steps, "seconds": None}
        schedule = self.cell.definition.schedule
        early = method.round_share / (rounds - 1) if rounds > 1 else 0.0
        if matched.kind == "steps":
            each = int(early * matched.amount)
            steps = int(matched.amount) - each * (rounds - 1) if final else each
            return {"schedule": schedule, "steps": steps, "seconds": None} if steps else None
        left = matched.amount - self.selecting.wall - self.reducing.wall - self.recovering.wall
        if left <= 0:  # scored as it is: the row's seconds say that they were not enough
            return None
        remaining = 1 - early * number
        limit = left if final else left * early / remaining
        return {"schedule": schedule, "steps": None, "seconds": round(limit, 3)}
