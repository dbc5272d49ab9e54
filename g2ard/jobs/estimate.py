"""Rough estimates of a distillation's time and memory, from a few renders and steps on this machine."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from g2ard.jobs.job import DistillJob
from g2ard.rendering.targets import CACHE_BYTES, Targets
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.recover import recover
from g2ard.stages.recover.schedule import steps_from_points
from g2ard.stages.simplify import simplify
from g2ard.system.peak_memory import peak_rss

_TRIAL_VIEWS, _TRIAL_STEPS = 4, 8
"""Number of views rendered and of steps taken for the estimate."""
_MERGE_TIMES = 4.0
"""Time of merging by `default` or `paper` relative to `fast`: 2 to 6.5 measured."""
_RECOVERY_OVERHEAD = 1.3
"""Time of a recovery relative to its steps alone; the rest is trials of rates and validation."""
_SHARED_STAGES = "prepare", "targets"
"""Stages that several budgets share."""
_PAGE_BYTES, _PAGE_FULL = 170, 130_000
"""Memory of packing the viewer page: bytes per Gaussian and SH coefficient above degree 0, and the count from
which it stops growing. Measured on playbot: 113 MB for 25,000 Gaussians, 511 for 125,000, 538 for 250,000.
"""
_TRAINER_BYTES = 983
"""Bytes per Gaussian in recovery: parameters, Adam's moments, buffers (`docs/benchmarks.md`)."""
_PROGRAM_BYTES = 150_000_000
"""Bytes of the interpreter and loaded libraries."""


@dataclass(frozen=True)
class Estimate:
    """Estimate for one budget.

    Args:
        views: number of views that need a target, including those for scoring.
        seconds: by stage: prepare (measured), targets, simplify, recover, score.
        bytes: peak memory: the peak of this process so far, including the trial, plus what the run adds,
            mainly the targets.
    """

    views: int
    pixels: int
    steps: int
    seconds: dict[str, float]
    bytes: int

    @property
    def total(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())


def estimate(job: DistillJob, budget: int, *, page: bool = True) -> Estimate:
    """Estimate a job at one budget from a few renders and steps and one fast merge."""
    train, test, apart = job.views.train.cameras, job.views.test, job.views.apart
    near = 0 if apart is None or job.teacher is None else len(apart)
    some = evenly_spaced(len(train), _TRIAL_VIEWS)
    targets = job.targets_for(train.take(some), lazy=True)
    began = time.monotonic()
    for view in range(len(targets.cameras)):
        targets[view]
    per_view = (time.monotonic() - began) / len(targets.cameras)
    merged, merging = _merged(job, budget)
    views = len(train) + len(test) + near
    pixels = int(np.mean(train.widths.astype(np.int64) * train.heights))
    kept = job.is_kept(budget)
    steps = 0 if kept else _steps(job, merged)
    return Estimate(
        views=views,
        pixels=pixels,
        steps=steps,
        seconds={
            "prepare": job.seconds,
            "targets": per_view * (len(test) + near if kept else views),
            # each view is rendered once for visibility
            "simplify": 0.0 if kept else merging + per_view * len(train),
            "recover": _recovery_seconds(job, merged, targets, steps) if steps else 0.0,
            "score": per_view * (2 * len(test) + near),
        },
        bytes=_peak_bytes(job, merged, page)
        + 2 * merged.nbytes  # the recovered scene, and its rows during writing
        + min(CACHE_BYTES, views * pixels * (12 if job.teacher is not None else 3)),
    )


def expected(job: DistillJob) -> list[tuple[str, float]]:
    """Return the stages of a prepared job, in order, with rough relative times, for an ETA of the whole.

    They are seconds for 500,000 → 50,000 Gaussians of playbot on two cores.
    """
    train, test = len(job.views.train.cameras), len(job.views.test)
    stages = [("teacher", 0.03 * (train + test))]
    for aim in job.aims:
        schedule, steps = job.config.recover.schedule, job.config.recover.steps
        if steps is None:
            points = job.config.recover.from_points
            steps = steps_from_points(aim.count, schedule.steps) if points else schedule.steps
        if not job.is_kept(aim.count):
            stages += [
                ("visibility", 0.01 * train),
                ("simplify", 1.2 * len(job.prior) / 500_000),
                ("recover", 0.02 * steps),
            ]
        stages += [
            ("scoring", 0.06 * test),
            ("report.html", 1.5),
            ("view.html", 1.0),
        ]
    return stages


def total(estimates: Sequence[Estimate]) -> tuple[float, int]:
    """Return seconds and bytes of one run at several budgets, which share preparation and targets."""
    once = sum(estimates[0].seconds[stage] for stage in _SHARED_STAGES)
    apart = sum(found.total - sum(found.seconds[stage] for stage in _SHARED_STAGES) for found in estimates)
    return once + apart, max(found.bytes for found in estimates)


def _peak_bytes(job: DistillJob, merged: Splats, page: bool) -> int:
    """Return the peak memory without targets: the trial's, or that of writing the page if it is more."""
    scene = job.prior.nbytes
    trial = peak_rss() or _PROGRAM_BYTES + scene + _TRAINER_BYTES * len(merged)
    if not page:
        return trial
    packing = _PAGE_BYTES * 3 * merged.shN.shape[1] * min(len(merged), _PAGE_FULL)
    return max(trial, min(trial, _PROGRAM_BYTES) + 2 * scene + packing)


def _merged(job: DistillJob, budget: int) -> tuple[Splats, float]:
    """Merge the scene by `fast`; return it and the expected time of the requested method."""
    began = time.monotonic()
    merged = simplify(job.prior, budget, method="fast").splats
    seconds = time.monotonic() - began
    if (degree := job.config.recover.sh_degree) is not None:
        merged = merged.with_sh_degree(degree)
    return merged, seconds if job.config.simplify.method == "fast" else _MERGE_TIMES * seconds


def _recovery_seconds(job: DistillJob, student: Splats, targets: Targets, steps: int) -> float:
    config = job.config.recover
    if config.recovery_time is not None:
        return config.recovery_time
    schedule = replace(config.schedule, multiplier=1.0, reach=1.0)
    tried = replace(config, schedule=schedule, steps=_TRIAL_STEPS, recovery_time=None)
    seconds = recover(student, targets, tried).report.seconds / _TRIAL_STEPS
    return _RECOVERY_OVERHEAD * steps * seconds


def _steps(job: DistillJob, student: Splats) -> int:
    """Return the steps of all recoveries: after each round, if the schedule has rounds, and of the last."""
    config, photos = job.config, job.photos_over_renders or job.teacher is None
    last = config.recover.final_steps(student, job.views.train.cameras, photos=photos)
    if not config.recover.schedule.round_steps:
        return last
    rounds = config.simplify.rounds(len(job.prior), len(student), recovered=True)
    return last + len(rounds) * config.recover.schedule.round_steps
