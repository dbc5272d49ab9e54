"""How long a distillation will take and what memory: a few of its renders and steps, on this machine."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from g2ard.memory import peak_rss
from g2ard.targets import CACHE_BYTES, Targets
from g2ard.visibility import visibility

if TYPE_CHECKING:
    from g2ard.policy.job import DistillJob
    from g2ard.splats import Splats

__all__ = ["Estimate", "estimate", "total"]

_TRIED = 2
"""Views that are rendered, and learned from, to tell how long all will take."""
_STEPS = 8
_MERGING = 8.0
"""Seconds of `default`, its views included, over those of `fast` without any. Measured, one thread, 10×:
guitar 13.7, playbot 8.0, a park 6.8, an open scene 6.0."""
_TRAINER_BYTES = 983
"""Of a Gaussian in recovery: parameters, Adam's moments, buffers (`docs/benchmarks.md`)."""
_RASTER_BYTES = 192
"""Of a Gaussian of the dense scene while it is rendered, at most; 123 where most lie outside the views."""
_PROGRAM_BYTES = 150_000_000
"""Of the interpreter and what it loads."""


@dataclass(frozen=True)
class Estimate:
    """Of one budget.

    Args:
        views: that targets are needed of, those for scoring included.
        pixels: of one view.
        steps: of recovery, all rounds together.
        seconds: by stage: targets, simplify, recover, score.
        bytes: of memory at the peak: what this process has taken at most, the trial included, and what comes
            on top of it, the targets above all.
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


def estimate(job: DistillJob, budget: int) -> Estimate:
    """Render two views, merge once the fast way and take eight steps; the rest is counting.

    Args:
        job: as `g2ard.policy.distill.prepare` returns it.
        budget: Gaussians of the result.

    Returns:
        An `Estimate`; on a busy machine it says what a busy machine takes.
    """
    train, test, apart = job.views.train.cameras, job.views.test, job.views.apart
    few = train.take(np.linspace(0, len(train) - 1, min(_TRIED, len(train))).round().astype(int))
    began = time.monotonic()
    targets = job.tried(few)
    for view in range(len(few)):
        targets[view]
    per_view = (time.monotonic() - began) / len(few)
    if job.config.method == "default":
        visibility(job.prior, few)  # for its memory
    merged, merging = _merged(job, budget)
    per_step = _step_seconds(job, merged, targets)
    steps = _steps(job, merged)
    views = len(train) + len(test) + (0 if apart is None or job.teacher is None else len(apart))
    scored = len(test) + (0 if apart is None else len(apart) // 2)
    small = per_view * len(merged) / len(job.prior) if job.teacher is not None else per_step / 3
    limit = job.config.recovery_time
    pixels = int(np.mean(train.widths.astype(np.int64) * train.heights))
    return Estimate(
        views=views,
        pixels=pixels,
        steps=steps,
        seconds={
            "targets": per_view * views,
            "simplify": merging,
            "recover": limit if limit is not None else per_step * steps,
            "score": 2 * scored * small,
        },
        bytes=_trial_bytes(job, budget)
        + 2 * merged.nbytes  # the recovered scene, and its rows on their way to the file
        + min(CACHE_BYTES, views * pixels * _pixel_bytes(job)),
    )


def total(estimates: Sequence[Estimate]) -> tuple[float, int]:
    """Seconds and bytes of one run at several budgets: targets are made once, budgets one by one."""
    apart = sum(found.total - found.seconds["targets"] for found in estimates)
    return estimates[0].seconds["targets"] + apart, max(found.bytes for found in estimates)


def _pixel_bytes(job: DistillJob) -> int:
    """Of a target: RGB in float32 where it was rendered, in 8 bits where it is a photo."""
    return 12 if job.teacher is not None else 3


def _trial_bytes(job: DistillJob, budget: int) -> int:
    """What this process took at most, the trial included; where the system does not tell, what it should."""
    if (peak := peak_rss()) is not None:
        return peak
    rendering = _RASTER_BYTES * len(job.prior) if job.teacher is not None else 0
    return _PROGRAM_BYTES + job.prior.nbytes + max(rendering, _TRAINER_BYTES * budget)


def _merged(job: DistillJob, budget: int) -> tuple[Splats, float]:
    """The scene at its count, by `fast`, and about how long the method that was asked for takes."""
    from g2ard.stages.simplify import simplify

    began = time.monotonic()
    merged = simplify(job.prior, budget, method="fast").splats
    seconds = time.monotonic() - began
    if job.config.sh_degree is not None:
        merged = merged.with_sh_degree(job.config.sh_degree)
    return merged, seconds if job.config.method == "fast" else _MERGING * seconds


def _step_seconds(job: DistillJob, student: Splats, targets: Targets) -> float:
    from g2ard.stages.recover import RecoverConfig, recover

    config = job.config
    schedule = replace(config.schedule, multiplier=1.0, reach=1.0)
    tried = RecoverConfig(
        schedule=schedule,
        steps=_STEPS,
        regularizers=config.regularizers,
        ssim_weight=config.ssim_weight,
        background=config.background,
        engine=config.engine,
    )
    return recover(student, targets, tried).report.seconds / _STEPS


def _steps(job: DistillJob, student: Splats) -> int:
    from g2ard.pipeline import final_steps
    from g2ard.stages.simplify import schedule as counts_of

    config = job.config
    photos = job.photos_over_renders or job.teacher is None
    last = final_steps(config, student, job.views.train.cameras, photos=photos)
    if not config.schedule.round_steps:
        return last
    kept, fold = config.simplify.retention or 0.75, config.simplify.fold
    return last + config.schedule.round_steps * len(counts_of(len(job.prior), len(student), kept, fold))
