"""Study of recovery: scores on held-out views against seconds, by schedule, regularisers and rounds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np

from benchmarks.baselines import mcmc
from benchmarks.rows import Row
from benchmarks.score import figures, score
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import PROTOCOLS, Workspace, budget_of, kinds_for
from g2ard.config.choices import Engine
from g2ard.errors import InputError
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.distill import distill
from g2ard.pipeline.presets import PRESETS, configure
from g2ard.rendering.targets import Targets
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.shape import effective_rank, needle_share
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Anchors, choose_regularizers, drift95
from g2ard.stages.recover.optimize import recover
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.simplify import simplify

__all__ = ["Recover", "Variant"]

_RETRAINED = ("mcmc", "gaussianspa", "fastgs")
_FIRST_LOOK = 25
"""Steps before the first score; the steps then double."""


@dataclass(frozen=True)
class Variant:
    """A variant of recovery.

    Args:
        name: name in rows.
        each: whether to run a variant NAME@STEPS for each of the study's `steps`.
        preset: preset of a whole distillation, from selection on; None only recovers, from a simplification
            that all such variants share.
        settings: settings of the distillation by full path. Without `recover.steps`, the study's are taken.
        retrains: method that trains instead: "mcmc" anew from points of the prior, the others from the prior.
    """

    name: str
    each: bool = key(False)
    preset: str | None = key(None, choices=tuple(PRESETS))
    settings: Mapping[str, Any] = key({})
    retrains: str | None = key(None, choices=_RETRAINED)


@dataclass(frozen=True)
class Recover(Study):
    """A study of recovery. Scoring does not count as time.

    The CPU seconds of variants with a preset include simplification.

    Args:
        methods: tables of `Variant`.
        steps: steps of variants that set none, over all rounds; only the last unless a variant runs each.
        engine: engine of recovery.
        gsplat: whether variants that retrain do so on an NVIDIA GPU, with gsplat's rasteriser and strategy.
        protocol: kinds of views to score: "pool", "standing" (near and standing views), "anywhere", or "all".
    """

    DEFAULT: ClassVar[Variant] = Variant("default")

    steps: tuple[int, ...] = key((1000,), least=1, axis=True)
    engine: str = key("fused", choices=get_args(Engine))
    gsplat: bool = key(False)
    protocol: str = key("all", choices=tuple(PROTOCOLS), axis=True)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio, variant and seed."""
        kinds = kinds_for(self.protocol, scene)
        place = _Workspace(work, self, scene)
        label = scene.name + (f" {self.size}px" if self.size else "")  # decibels depend on it
        for ratio in self.ratios:
            for variant in self.methods:
                for steps in self.steps if variant.each else self.steps[-1:]:
                    name = f"{variant.name}@{steps}" if variant.each else variant.name
                    for seed in self.seeds:
                        names = {"scene": label, "ratio": ratio, "variant": name, "seed": seed}
                        run = _Run(place, ratio, variant, steps, seed, kinds)
                        yield Cell(names, run.rows, kinds, [repr(variant), steps])

    def summary(self, rows: list[Row]) -> tuple[str, list[str], list[list[str]]] | None:
        """Return the default's time to reach the final PSNR of other variants."""
        lines = []
        rows = [row for row in rows if "psnr" in row]
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
            reached = min(
                (r["seconds"] for r in rivals if r["psnr"] >= other["psnr"]), default=None
            )
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
            small = simplify(
                self.splats, budget, visibility=visibility_source(self.train_cameras)
            ).splats
            if self.sh_degree is not None:
                small = small.with_sh_degree(self.sh_degree)
            self.starts[budget] = small, time.monotonic() - began
        return self.starts[budget]

    def config(self, variant: Variant, budget: int, steps: int, seed: int) -> DistillConfig:
        """Return the configuration of a variant, with the regularisers of this scene's kind.

        Its recoveries take `steps` together, in its schedule's proportion, unless `recover.steps` is set.
        """
        preset = variant.preset or "auto"
        given = {**PRESETS[preset], **variant.settings}
        views = self.train_cameras if self.scene.targets == "photos" else None
        weights, _, _ = choose_regularizers(
            given.get("recover.regularizers", "auto"), self.splats, views
        )
        values = {
            **variant.settings,
            "recover.engine": self.study.engine,
            "recover.regularizers": weights,
            "recover.sh_degree": self.sh_degree,
            "recover.background": self.scene.background,
            "recover.seed": seed,
        }
        config = configure(DistillConfig(), preset, values)
        if config.recover.steps is not None:
            return config
        schedule = config.recover.schedule
        rounds = config.simplify.rounds(len(self.splats), budget, recovered=True)
        early = len(rounds) if schedule.round_steps else 0
        share = schedule.steps / (schedule.steps + early * schedule.round_steps)
        schedule = schedule.scaled(round(share * steps))
        last = steps - early * schedule.round_steps
        return replace(config, recover=replace(config.recover, schedule=schedule, steps=last))


@dataclass
class _Run:
    """A recovery, a chain of recoveries or a whole distillation, with scores along the way."""

    place: _Workspace
    ratio: float
    variant: Variant
    steps: int
    seed: int
    kinds: Sequence[str]

    def rows(self) -> list[Row]:
        """Run, and return a row per score and kind of views."""
        place = self.place
        self.budget = budget_of(len(place.splats), self.ratio)
        self.config = place.config(self.variant, self.budget, self.steps, self.seed)
        self.rounds = self.config.recover.schedule.round_steps > 0
        self.found: list[Row] = []
        self.before = self.now = 0.0  # seconds of finished recoveries and of the current one
        self.cpu = 0.0
        if self.variant.retrains:
            return self._retrained()
        alone = self.variant.preset is None and not self.rounds
        done, started, reports, simplify_s = (self._recovered if alone else self._distilled)()
        self._count_cpu()
        _check_finite(done, [loss for report in reports for loss in report.loss])
        spent, steps = sum(r.seconds for r in reports), sum(r.steps for r in reports)
        extra = sum(report.seconds * report.regularizers.share for report in reports)
        end = {
            "simplify_s": simplify_s,
            "drift95": drift95(Anchors.of(started), done.means),
            "reg_share": extra / max(spent, 1e-9),
            "skipped": sum(report.skipped["non_finite"] for report in reports),
        }
        return [*self.found, *({**row, **end} for row in self._looks(done, steps, spent, 1))]

    def _retrained(self) -> list[Row]:
        """Train by another method; return a row per score and kind of views."""
        place = self.place
        targets, colour = place.train_targets, place.scene.background
        self.cpu_began = time.process_time()
        if self.variant.retrains == "mcmc":
            done, seconds = mcmc.train(
                place.splats,
                self.budget,
                targets,
                self.steps,
                gsplat=place.study.gsplat,
                background=colour,
                seed=self.seed,
                watch=self._watch,
            )
        else:
            from benchmarks.baselines.fastgs import FastGS
            from benchmarks.baselines.gaussianspa import GaussianSpa
            from benchmarks.baselines.thinning import Training

            method = GaussianSpa if self.variant.retrains == "gaussianspa" else FastGS
            training = Training(
                place.splats, targets, self.steps, background=colour, seed=self.seed
            )
            done, seconds = training.run(method(self.budget, self.steps), self._watch)
        self._count_cpu()
        _check_finite(done, [])
        return [*self.found, *self._looks(done, self.steps, seconds, 1)]

    def _recovered(self) -> tuple[Splats, Splats, list[RecoverReport], float]:
        """Recover once; return the scene, its start, the report and the seconds of simplification."""
        targets = self.place.train_targets
        start, seconds = self.place.start(self.budget)
        self.cpu_began = time.process_time()
        done = recover(start, targets, self.config.recover, watch=self._watch)
        return done.splats, start, [done.report], seconds

    def _distilled(self) -> tuple[Splats, Splats, list[RecoverReport], float]:
        """Distil; return the scene, its last start, the reports and the seconds of simplification."""
        targets = self.place.train_targets
        watch = self._watch if self.variant.preset is None else None
        self.cpu_began = time.process_time()
        done = distill(self.place.splats, self.budget, targets, self.config, watch=watch)
        reports = [report for entry in done.report.rounds for report in entry.recover]
        return done.splats, done.simplified, reports, done.report.seconds.simplify

    def _watch(self, step: int, seconds: float, splats: Callable[[], Splats]) -> None:
        if step == 1:
            self.before += self.now
            if self.rounds:
                self.cpu_began = time.process_time()  # excludes simplification
        self.now = seconds
        self._count_cpu()
        if (
            step >= _FIRST_LOOK
            and (step // _FIRST_LOOK).bit_count() == 1
            and step % _FIRST_LOOK == 0
        ):
            self.found += self._looks(splats(), step, self.before + seconds, 0)
        self.cpu_began = time.process_time()

    def _count_cpu(self) -> None:
        now = time.process_time()
        self.cpu += now - self.cpu_began
        self.cpu_began = now

    def _looks(self, splats: Splats, step: int, seconds: float, final: int) -> Iterator[Row]:
        for kind in self.kinds:
            if kind not in self.place.kinds_of_views:
                if final:  # no place for them in this scene
                    yield {"views_kind": kind, "views": 0, "final": 1}
                continue
            scored = score(splats, self.place.kinds_of_views[kind], self.place.scene.background)
            yield {
                "views_kind": kind,
                "budget": self.budget,
                "count": len(splats),
                "step": step,
                "seconds": seconds,
                "cpu_s": self.cpu,
                **figures(scored),
                "needle": needle_share(splats.scales),
                "rank_p1": float(np.percentile(effective_rank(splats.scales), 1)),
                "final": final,
            }


def _check_finite(splats: Splats, losses: Sequence[float]) -> None:
    names = ("means", "quats", "scales", "logit_opacities", "sh0", "shN")
    bad = [name for name in names if not np.isfinite(getattr(splats, name)).all()]
    if bad or not np.isfinite(losses).all():
        raise InputError(f"recovery: not finite: {', '.join(bad) or 'the loss'}")
