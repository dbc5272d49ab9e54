"""Study of recovery: scores on held-out views against seconds, by schedule, regularisers and rounds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Row
from benchmarks.runner import Cell
from benchmarks.score import score
from benchmarks.study import SceneSpec, Study, checked, key
from benchmarks.workspace import PROTOCOLS, Workspace, budget_of, kinds_for
from g2ard.config.presets import PRESETS, configured
from g2ard.errors import InputError
from g2ard.pipeline import DistillConfig, distill
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets
from g2ard.stages.recover import RecoverConfig, recover
from g2ard.stages.recover.anchors import (
    PAPER_REGULARIZERS,
    Anchors,
    Regularizers,
    drift95,
    effective_rank,
    needle,
)
from g2ard.stages.recover.prior import regularizers_for
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.recover.schedule import PAPER, TUNED, Schedule
from g2ard.stages.simplify import round_counts, simplify

__all__ = ["Recover", "Variant"]

_FIRST_LOOK = 25
"""Steps before the first score; the steps then double."""


@dataclass(frozen=True)
class Variant:
    """A variant of recovery.

    Args:
        name: name in rows.
        schedule: "default" or "paper".
        each: whether to run a variant NAME@STEPS for each of the study's `steps`.
        horizon: steps to scale the paper's schedule to; by default its own.
        decay: whether the paper's schedule uses the default's decay.
        multiplier: multiplier of the rates; None chooses it.
        anchor: factor of the weight of L_anchor.
        shape: factor of the weight of L_shape.
        preset: preset of a whole distillation, from selection on, that takes the place of all the above.
        settings: its settings by full path.
    """

    name: str
    schedule: str = key("default", choices=("default", "paper"))
    each: bool = key(False)
    horizon: int | None = key(None, least=1)
    decay: bool = key(False)
    multiplier: float | None = key(None, least=0)
    anchor: float = key(1.0, least=0)
    shape: float = key(1.0, least=0)
    preset: str | None = key(None, choices=tuple(PRESETS))
    settings: Mapping[str, Any] = key({})

    @property
    def plan(self) -> Schedule:
        """The schedule."""
        if self.schedule == "paper":
            found = PAPER if self.horizon is None else PAPER.scaled(self.horizon)
            return replace(found, cosine_floor=TUNED.cosine_floor) if self.decay else found
        return replace(TUNED, multiplier=self.multiplier or TUNED.multiplier)


@dataclass(frozen=True)
class Recover(Study):
    """A study of recovery. Scoring does not count as time.

    All runs start from the same simplification, except those of variants with a preset: these distil anew,
    and their CPU seconds include it.

    Args:
        methods: tables of `Variant`.
        steps: steps of variants with the default schedule or a preset, over all rounds; only the last unless
            a variant runs each.
        protocol: kinds of views to score: "pool", "standing" (near and standing views), "anywhere", or "all".
    """

    steps: tuple[int, ...] = key((1000,), least=1, axis=True)
    protocol: str = key("all", choices=tuple(PROTOCOLS), axis=True)

    @classmethod
    def method(cls, name: str, values: Mapping[str, Any]) -> Variant:
        """Return the variant of a table."""
        try:
            return Variant(name, **checked(Variant, values, {"name"}))
        except InputError as error:
            raise InputError(f"method {name}: {error}") from None

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio, variant and seed."""
        kinds = kinds_for(self.protocol, scene)
        place = _Workspace(work, self, scene)
        label = scene.name + (f" {self.size}px" if self.size else "")  # decibels depend on it
        for ratio in self.ratios:
            for variant in self.methods:
                for steps in self.steps if variant.each else self.steps[-1:]:
                    name = f"{variant.name}@{steps}" if variant.each else variant.name
                    horizon = None if variant.schedule == "paper" else steps
                    for seed in self.seeds:
                        names = {"scene": label, "ratio": ratio, "variant": name, "seed": seed}
                        run = partial(self._run, place, ratio, variant, horizon, seed, kinds)
                        yield Cell(names, run, kinds, [repr(variant), horizon])

    @staticmethod
    def _run(
        place: _Workspace,
        ratio: float,
        variant: Variant,
        steps: int | None,
        seed: int,
        kinds: Sequence[str],
    ) -> list[Row]:
        return _Run(place, ratio, variant, steps, seed, kinds).rows()

    def summary(self, rows: list[Row]) -> tuple[str, list[str], list[list[str]]] | None:
        """Return the default's time to reach the final PSNR of other variants."""
        lines = []
        rows = [row for row in rows if "error" not in row]
        for other in rows:
            if not other.get("final") or other["variant"].startswith("default@"):
                continue
            names = ("scene", "ratio", "seed", "views_kind")
            rivals = [
                row
                for row in rows
                if row.get("variant", "").startswith("default@")
                and row["count"] == row["budget"]
                and all(row[name] == other[name] for name in names)
            ]
            reached = min((r["seconds"] for r in rivals if r["psnr"] >= other["psnr"]), default=None)
            share = ["never", "–"]
            if reached is not None:
                share = [f"{reached:.1f}", f"{reached / other['seconds']:.3f}"]
            told = [other["scene"], f"{other['ratio']:g}", other["variant"], other["views_kind"]]
            if rivals:
                lines.append([*told, f"{other['psnr']:.2f}", f"{other['seconds']:.1f}", *share])
        columns = ["scene", "ratio", "against", "views", "PSNR", "seconds", "default's", "share"]
        return ("The default's seconds to the other's PSNR", columns, lines) if lines else None


class _Workspace(Workspace):
    """A scene with data shared by its recoveries."""

    study: Recover

    @property
    def sh_degree(self) -> int | None:
        """The SH degree of the results: 3 for point clouds, otherwise that of the scene."""
        return 3 if self.lifted else None

    @cached_property
    def train_targets(self) -> Targets:
        """The training targets, loaded before timing starts."""
        targets = self.targets(self.train_cameras)
        for view in range(len(targets.cameras)):
            targets[view]
        return targets

    @cached_property
    def starts(self) -> dict[int, tuple[Splats, float]]:
        """Count → the simplified scene for one-shot runs, and the seconds to make it."""
        return {}

    def start(self, budget: int) -> tuple[Splats, float]:
        """Return the start of a count, made once."""
        if budget not in self.starts:
            began = time.monotonic()
            small = simplify(self.splats, budget, visibility=visibility_source(self.train_cameras)).splats
            if self.sh_degree is not None:
                small = small.with_sh_degree(self.sh_degree)
            self.starts[budget] = small, time.monotonic() - began
        return self.starts[budget]

    def weights(self, variant: Variant) -> Regularizers:
        """Return the regularisers: the paper's for its schedule, with the variant's factors."""
        views = self.train_cameras if self.scene.targets == "photos" else None
        preset, why, _ = regularizers_for("auto", self.splats, views)
        own = PAPER_REGULARIZERS[why.split()[0]] if variant.schedule == "paper" else preset
        return replace(own, anchor=own.anchor * variant.anchor, shape=own.shape * variant.shape)

    def distillation(self, variant: Variant, budget: int, steps: int, seed: int) -> DistillConfig:
        """Return the configuration of a variant with a preset, with the regularisers of this scene's kind.

        Its recoveries take `steps` together, in its schedule's proportion, unless `recover.steps` is set.
        """
        assert variant.preset is not None
        given = {**PRESETS[variant.preset], **variant.settings}
        views = self.train_cameras if self.scene.targets == "photos" else None
        weights, _, _ = regularizers_for(given.get("recover.regularizers", "auto"), self.splats, views)
        values = {
            **variant.settings,
            "recover.regularizers": weights,
            "recover.sh_degree": self.sh_degree,
            "recover.background": self.scene.background,
            "recover.seed": seed,
        }
        config = configured(DistillConfig(), variant.preset, values)
        if config.recover.steps is not None:
            return config
        schedule, simplification = config.recover.schedule, config.simplify
        kept = simplification.retention_of("paper")
        rounds = round_counts(len(self.splats), budget, kept, simplification.fold)
        early = len(rounds) if schedule.round_steps else 0
        share = schedule.steps / (schedule.steps + early * schedule.round_steps)
        schedule = schedule.scaled(round(share * steps))
        last = steps - early * schedule.round_steps
        return replace(config, recover=replace(config.recover, schedule=schedule, steps=last))


class _Run:
    """A recovery, or a chain of recoveries, with scores along the way; or a whole distillation."""

    def __init__(
        self,
        place: _Workspace,
        ratio: float,
        variant: Variant,
        steps: int | None,
        seed: int,
        kinds: Sequence[str],
    ) -> None:
        self.place, self.plan, self.kinds = place, variant.plan, kinds
        self.budget = budget_of(len(place.splats), ratio)
        self.options: dict[str, Any] = {
            "schedule": self.plan,
            "steps": steps,
            "regularizers": place.weights(variant),
            "background": place.scene.background,
            "seed": seed,
        }
        self.config: DistillConfig | None = None
        if variant.preset is not None and steps is not None:
            self.config = place.distillation(variant, self.budget, steps, seed)
        self.found: list[Row] = []
        self.simplify_s = 0.0
        self.before = self.now = 0.0  # seconds of finished recoveries and of the current one
        self.cpu, self.cpu_began = 0.0, time.process_time()

    def rows(self) -> list[Row]:
        """Run, and return a row per score and kind of views."""
        done, started, reports = (self._chain if self.config or self.plan.round_steps else self._once)()
        self._count_cpu()
        _check_finite(done, [loss for report in reports for loss in report.loss])
        spent, steps = sum(r.seconds for r in reports), sum(r.steps for r in reports)
        extra = sum(report.seconds * report.regularizers.share for report in reports)
        end = {
            "simplify_s": self.simplify_s,
            "drift95": drift95(Anchors.of(started), done.means),
            "reg_share": extra / max(spent, 1e-9),
            "skipped": sum(report.skipped["non_finite"] for report in reports),
        }
        return [*self.found, *({**row, **end} for row in self._looks(done, steps, spent, 1))]

    def _once(self) -> tuple[Splats, Splats, list[RecoverReport]]:
        targets = self.place.train_targets
        start, self.simplify_s = self.place.start(self.budget)
        self.cpu_began = time.process_time()
        done = recover(start, targets, RecoverConfig(**self.options), watch=self._watch)
        return done.splats, start, [done.report]

    def _chain(self) -> tuple[Splats, Splats, list[RecoverReport]]:
        place, targets = self.place, self.place.train_targets
        watch = self._watch if self.config is None else None
        config = self.config or DistillConfig(
            recover=RecoverConfig(**self.options, sh_degree=place.sh_degree)
        )
        self.cpu_began = time.process_time()
        done = distill(place.splats, self.budget, targets, config, watch=watch)
        self.simplify_s = done.report.seconds.simplify
        reports = [report for entry in done.report.rounds for report in entry.recover]
        return done.splats, done.simplified, reports

    def _watch(self, step: int, seconds: float, splats: Callable[[], Splats]) -> None:
        if step == 1:
            self.before += self.now
            if self.plan.round_steps:
                self.cpu_began = time.process_time()  # excludes simplification
        self.now = seconds
        self._count_cpu()
        if step >= _FIRST_LOOK and (step // _FIRST_LOOK).bit_count() == 1 and step % _FIRST_LOOK == 0:
            self.found += self._looks(splats(), step, self.before + seconds, 0)
        self.cpu_began = time.process_time()

    def _count_cpu(self) -> None:
        now = time.process_time()
        self.cpu += now - self.cpu_began
        self.cpu_began = now

    def _looks(self, splats: Splats, step: int, seconds: float, final: int) -> Iterator[Row]:
        for kind in self.kinds:
            if kind not in self.place.kinds_of_views:
                if final:
                    yield {"views_kind": kind, "error": f"no place for {kind} views"}
                continue
            scored = score(splats, self.place.kinds_of_views[kind], self.place.scene.background)
            yield {
                "views_kind": kind,
                "budget": self.budget,
                "count": len(splats),
                "step": step,
                "seconds": seconds,
                "cpu_s": self.cpu,
                **scored.figures(),
                "needle": needle(splats.scales),
                "rank_p1": float(np.percentile(effective_rank(splats.scales), 1)),
                "final": final,
            }


def _check_finite(splats: Splats, losses: Sequence[float]) -> None:
    names = ("means", "quats", "scales", "logit_opacities", "sh0", "shN")
    bad = [name for name in names if not np.isfinite(getattr(splats, name)).all()]
    if bad or not np.isfinite(losses).all():
        raise InputError(f"recovery: not finite: {', '.join(bad) or 'the loss'}")
