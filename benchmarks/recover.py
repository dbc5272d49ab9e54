"""Recovery under study: error on unseen views against seconds, schedules and regularisers side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from benchmarks import rows
from benchmarks.look import Look
from benchmarks.recover_studies import STUDIES, Plan
from benchmarks.simplify import machine, scene_label
from benchmarks.standing import check_protocol, standing_targets
from g2ard import __version__, io
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.pipeline import DistillConfig, distill
from g2ard.poses import make_pool
from g2ard.progress import Progress, silent
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.splits import HOLD_OUT, for_scores, for_training, not_held_out, split_mask
from g2ard.scene.targets import Photos, Targets, TeacherRenders
from g2ard.stages.evaluate import evaluate
from g2ard.stages.lift import lift
from g2ard.stages.recover import RecoverConfig, recover
from g2ard.stages.recover.anchors import PAPER_PRESETS, Anchors, drift95, effective_rank, needle
from g2ard.stages.recover.presets import preset_for
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.recover.schedule import PAPER
from g2ard.stages.simplify import simplify

__all__ = ["STUDIES", "Look", "RecoverBench", "bench_recover"]

_POOL = 128
_FIRST_LOOK = 25
"""Unseen views are looked at after this many steps of a recovery, then after twice as many, and so on."""


@dataclass(frozen=True)
class RecoverBench:
    """A scene with its views, as every study needs it.

    Args:
        scene: a trained scene, or a coloured cloud, which is lifted and needs photos.
        views: to recover on and, without `held_out`, to score on; None makes a pool of 128 poses.
        held_out: views to score on.
        photos: whether the views' photos are the targets; None means if it is a cloud.
        size: shrink views to this longer side.
        background: RGB behind the scene.
        pool_seed: of the pool.
        protocol: "pool" scores on unseen views of the pool, or those given; "standing" on views of other
            kinds, from near and from where people stand (`benchmarks.standing.standing_views`); "both".
    """

    scene: Path
    views: Path | None = None
    held_out: Path | None = None
    photos: bool | None = None
    size: int | None = None
    background: Colour = BLACK
    pool_seed: int = 0
    protocol: str = "pool"
    _starts: dict[int, tuple[Splats, float]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def label(self) -> str:
        """Its name in the CSV; the size belongs to it, for decibels depend on it."""
        name = f"{self.scene.absolute().parent.name}/{self.scene.stem}"
        if not self.lifted or self.scene.is_dir():
            name = scene_label(self.scene)
        return name + (f" {self.size}px" if self.size else "")

    @cached_property
    def lifted(self) -> bool:
        """Whether the prior is a lifted cloud."""
        return io.kind(self.scene) != "splats"

    @cached_property
    def prior(self) -> Splats:
        """The dense scene."""
        if not self.lifted:
            return io.read_splats(self.scene)
        cloud = io.read_cloud(self.scene).points
        return lift(cloud.positions, cloud.colors)

    @cached_property
    def cameras(self) -> tuple[Cameras, Cameras]:
        """Views to recover on, and unseen ones."""
        if self.views is None:
            pool = make_pool(self.prior, _POOL, seed=self.pool_seed).resized(self.size)
            unseen = np.arange(len(pool)) % HOLD_OUT == 0
            return pool.take(~unseen), pool.take(unseen)
        found = io.read_view_set(self.views)
        if self.held_out is not None:
            keep = for_training(self.views, found.cameras.names, found.splits)
            other = io.read_view_set(self.held_out)
            test = other.take(for_scores(self.held_out, other.cameras.names, other.splits)).cameras
            train = found.take(keep).cameras
            train = train.take(not_held_out(train, test))
            if not len(train):
                raise InputError(f"{self.views}: all views to train on are held out")
            return train.resized(self.size), test.resized(self.size)
        masks = (
            split_mask(self.views, found.cameras.names, split, stated=found.splits)
            for split in ("train", "test")
        )
        train, test = (found.cameras.take(mask).resized(self.size) for mask in masks)
        return train, test

    @property
    def from_photos(self) -> bool:
        """Whether photos are the targets."""
        return self.lifted if self.photos is None else self.photos

    @cached_property
    def targets(self) -> tuple[Targets, Targets]:
        """What both kinds of views show."""
        train, test = self.cameras
        if self.from_photos:
            return Photos(train), Photos(test)
        teach = partial(TeacherRenders, self.prior, background=self.background)
        return teach(train), teach(test)

    @cached_property
    def scored(self) -> dict[str, Targets]:
        """What is scored on, by kind of views.

        Raises:
            InputError: an unknown protocol, or standing views where photos are the targets.
        """
        kinds = check_protocol(self.protocol)
        elsewhere = set(kinds) != {"pool"}
        if elsewhere and self.from_photos:
            raise InputError("protocol: no photos show it from elsewhere; a trained scene is needed")
        found: dict[str, Targets] = {"pool": self.targets[1]} if "pool" in kinds else {}
        if not elsewhere:
            return found
        found |= standing_targets(
            self.prior, self.scene, self.pool_seed, size=self.size, background=self.background
        )
        if not found:
            raise InputError(f"{self.scene}: no place for near or standing views")
        return found

    @property
    def sh_degree(self) -> int | None:
        """Of the results: 3 from a cloud, else the scene's own."""
        return 3 if self.lifted else None

    def start(self, budget: int, progress: Progress) -> tuple[Splats, float]:
        """What all one-shot runs of a budget start from, and the seconds it took to make."""
        if budget not in self._starts:
            began = time.monotonic()
            look = visibility_source(self.cameras[0], progress=progress)
            small = simplify(self.prior, budget, visibility=look, progress=progress).splats
            if self.sh_degree is not None:
                small = small.with_sh_degree(self.sh_degree)
            self._starts[budget] = small, time.monotonic() - began
        return self._starts[budget]


def bench_recover(
    bench: RecoverBench,
    study: str,
    csv_path: Path,
    *,
    ratios: Sequence[float] = (10,),
    seeds: Sequence[int] = (0,),
    steps: Sequence[int] = (100, 300, 1000),
    seconds: float = 30.0,
    variants: Sequence[str] | None = None,
    progress: Progress = silent,
) -> list[Look]:
    """Run every ratio × variant × seed of a study that `csv_path` does not hold whole; rows are appended.

    Every run starts from the same `g2ard simplify` of the prior, looking through the training views, and is
    scored on unseen views of each kind of its protocol along the way; the looks do not count as time.

    Args:
        bench: the scene.
        study: of `STUDIES`.
        csv_path: where the rows go. Whole runs are kept; rows of runs that were stopped are dropped.
        ratios: the budget is round(N / ratio).
        seeds: of the order of views.
        steps: horizons of the default schedule in `curves` and `paper`; other studies use the last.
        seconds: of recovery, in `rounds`.
        variants: of the study's; None runs all.
        progress: told after each run, and by the runs.

    Returns:
        The rows of these ratios, seeds and variants.

    Raises:
        InputError: an unknown study, variant or protocol, a scene or views that cannot be read, or a result
            with a value that is not finite.
    """
    if study not in STUDIES:
        raise InputError(f"study: expected one of {', '.join(STUDIES)}, got {study!r}")
    check_protocol(bench.protocol)
    kept = _whole(rows.read(csv_path, Look))
    rows.rewrite(csv_path, kept, Look)
    preset, why, _ = preset_for("auto", bench.prior, bench.cameras[0] if bench.from_photos else None)
    plans = STUDIES[study](steps, seconds, preset)
    papers = PAPER_PRESETS[why.split()[0]]
    unknown = [v for v in variants or () if v not in plans]
    if unknown:
        raise InputError(f"variants: expected some of {', '.join(plans)}, got {', '.join(unknown)}")
    wanted = [
        (study, bench.label, float(ratio), seed, variant)
        for ratio in ratios
        for variant in variants or plans
        for seed in seeds
    ]
    done = {(look.key, look.views_kind) for look in kept}
    for number, key in enumerate(wanted, 1):
        kinds = [kind for kind in bench.scored if (key, kind) not in done]
        if kinds:
            plan = plans[key[4]]
            weights = plan.regularizers or (papers if plan.schedule.rates == PAPER.rates else preset)
            run = _Run(bench, key, replace(plan, regularizers=weights), kinds)
            found = run.looks(progress)
            rows.append(csv_path, found)
            kept += found
        progress("bench recover", number, len(wanted), {key[1]: f"{key[2]:g}× {key[4]}"})
    return [look for look in kept if look.key in set(wanted) and look.views_kind in bench.scored]


def _whole(looks: Sequence[Look]) -> list[Look]:
    ended = {(look.key, look.views_kind) for look in looks if look.final}
    return [look for look in looks if (look.key, look.views_kind) in ended]


class _Run:
    """One recovery, or a chain of them, with its looks."""

    def __init__(
        self, bench: RecoverBench, key: tuple[str, str, float, int, str], plan: Plan, kinds: Sequence[str]
    ) -> None:
        self.bench, self.key, self.plan, self.kinds = bench, key, plan, kinds
        self.budget = max(1, int(np.floor(len(bench.prior) / key[2] + 0.5)))
        self.found: list[Look] = []
        self.simplify_s = 0.0
        self.before = self.now = 0.0  # seconds of finished recoveries, and of the one in progress
        self.cpu, self.cpu_began = 0.0, time.process_time()

    def looks(self, progress: Progress) -> list[Look]:
        """Run it.

        Raises:
            InputError: a loss or a value of the result is not finite.
        """
        way = self._chain if self.plan.schedule.round_steps else self._once
        done, started, reports = way(progress)
        self._count_cpu()
        _check_finite(done, [loss for report in reports for loss in report.loss])
        spent = sum(report.seconds for report in reports)
        extra = sum(report.seconds * report.regularizers.share for report in reports)
        ends = [
            replace(
                look,
                simplify_s=self.simplify_s,
                drift95=drift95(Anchors.of(started), done.means),
                reg_share=extra / max(spent, 1e-9),
                skipped=sum(report.skipped["non_finite"] for report in reports),
            )
            for look in self._look(done, reports[-1].steps, spent, final=1)
        ]
        return [*self.found, *ends]

    def _once(self, progress: Progress) -> tuple[Splats, Splats, list[RecoverReport]]:
        plan, bench = self.plan, self.bench
        start, self.simplify_s = bench.start(self.budget, progress)
        assert plan.regularizers is not None
        config = RecoverConfig(
            schedule=plan.schedule,
            steps=plan.steps,
            recovery_time=plan.recovery_time,
            regularizers=plan.regularizers,
            background=bench.background,
            seed=self.key[3],
        )
        for view in range(len(bench.targets[0].cameras)):  # made once: the first run would pay for all
            bench.targets[0][view]
        self.cpu_began = time.process_time()
        done = recover(start, bench.targets[0], config, progress=progress, watch=self._watch)
        return done.splats, start, [done.report]

    def _chain(self, progress: Progress) -> tuple[Splats, Splats, list[RecoverReport]]:
        plan, bench = self.plan, self.bench
        assert plan.regularizers is not None
        how = RecoverConfig(
            schedule=plan.schedule,
            steps=plan.steps,
            recovery_time=plan.recovery_time,
            regularizers=plan.regularizers,
            sh_degree=bench.sh_degree,
            background=bench.background,
            seed=self.key[3],
        )
        config = DistillConfig(recover=how)
        done = distill(
            bench.prior, self.budget, bench.targets[0], config, progress=progress, watch=self._watch
        )
        self.simplify_s = done.report.seconds.simplify
        reports = [report for entry in done.report.rounds for report in entry.recover]
        return done.splats, done.simplified, reports

    def _watch(self, step: int, seconds: float, splats: Callable[[], Splats]) -> None:
        if step == 1:
            self.before += self.now
            if self.plan.schedule.round_steps:
                self.cpu_began = time.process_time()  # what came before was simplification, for the most part
        self.now = seconds
        self._count_cpu()
        if step >= _FIRST_LOOK and (step // _FIRST_LOOK).bit_count() == 1 and step % _FIRST_LOOK == 0:
            self.found += self._look(splats(), step, self.before + seconds)
        self.cpu_began = time.process_time()

    def _count_cpu(self) -> None:
        now = time.process_time()
        self.cpu += now - self.cpu_began
        self.cpu_began = now

    def _look(self, splats: Splats, step: int, seconds: float, *, final: int = 0) -> list[Look]:
        """One for each kind of views."""
        return [self._looked(kind, splats, step, seconds, final) for kind in self.kinds]

    def _looked(self, kind: str, splats: Splats, step: int, seconds: float, final: int) -> Look:
        study, scene, ratio, seed, variant = self.key
        score = evaluate(splats, self.bench.scored[kind], background=self.bench.background)
        return Look(
            study=study,
            scene=scene,
            ratio=ratio,
            seed=seed,
            variant=variant,
            budget=self.budget,
            count=len(splats),
            step=step,
            seconds=seconds,
            cpu_s=self.cpu,
            simplify_s=0.0,
            psnr=score.psnr,
            ssim=score.ssim,
            drift95=None,
            needle=needle(splats.scales),
            rank_p1=float(np.percentile(effective_rank(splats.scales), 1)),
            reg_share=None,
            skipped=None,
            final=final,
            version=f"g2ard {__version__}",
            machine=machine(),
            views_kind=kind,
        )


def _check_finite(splats: Splats, losses: Sequence[float]) -> None:
    bad = [
        name
        for name in ("means", "quats", "scales", "logit_opacities", "sh0", "shN")
        if not np.isfinite(getattr(splats, name)).all()
    ]
    if bad or not np.isfinite(losses).all():
        raise InputError(f"recovery: not finite: {', '.join(bad) or 'the loss'}")
