"""How long a distillation will take and what memory: a little of every stage, on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from g2ard.errors import InputError
from g2ard.policy.tiling import RECOVERY_TIMES, TileMemory, amount
from g2ard.progress import plural
from g2ard.rendering.visibility import MOST_LOOKS, fewest_looks, visibility_source
from g2ard.scene.targets import CACHE_BYTES, Targets
from g2ard.system.memory import peak_rss
from g2ard.tiles.pour import foretold
from g2ard.tiles.store import row_width

if TYPE_CHECKING:
    from g2ard.policy.job import DistillJob
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

__all__ = ["Estimate", "check_memory", "estimate", "total"]

_TRIED = 2, 6
"""Views that a stage is tried on: the difference is four views' time, the rest is what it begins with."""
_STEPS = 8
_MERGING = 4.0
"""Seconds of merging by `default` or `paper` over those of `fast`, looks at the scene left out. Measured, two
threads, 2 to 20×: guitar 2 to 6.5, playbot 2.4 to 4."""
_LOOKS = 1.5
"""Looks that simplification takes over the fewest it might: an object takes those, a room many more."""
_PAGE_ROWS, _PAGE_POWER = 20_000, 2 / 3
"""Gaussians that packing the page is tried on, and the power of their number that its time goes with: playbot
1.6 s of 25,000, 4.8 of 125,000, 7.5 of 250,000."""
_PAGE_BYTES, _PAGE_FULL = 170, 130_000
"""While packing, of a Gaussian's every coefficient above SH degree 0, and the Gaussians from which on
it stays: playbot 113 MB of 25,000, 511 of 125,000, 538 of 250,000."""
_PICTURES = 0.3
"""Seconds of the report, its pictures and the scene's file; 0.2 to 0.4 on guitar, fox and playbot."""
_PROBED = 8
"""Views of each kind by which recovery watches itself, and rates it tries, at most four."""
_RATES = 3
_ONCE = "prepare", "targets"
"""Stages that several budgets share."""
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
        seconds: by stage: prepare (as it took), targets, select, simplify, recover, score, write.
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


def estimate(job: DistillJob, budget: int, *, page: bool = True) -> Estimate:
    """Try each stage on a few views or rows, merge once the fast way, take eight steps; the rest is counting.

    Args:
        job: as `g2ard.policy.distill.prepare` returns it.
        budget: Gaussians of the result.
        page: whether a page for the browser is to be written too.

    Returns:
        An `Estimate`; on a busy machine it says what a busy machine takes.
    """
    train, test, apart = job.views.train.cameras, job.views.test, job.views.apart
    apart = None if job.teacher is None else apart
    targets = job.tried(_evenly(train, _TRIED[1]))
    rendered = [_seconds(partial(targets.__getitem__, view)) for view in range(len(targets.cameras))]
    per_view = float(np.mean(rendered[1:] or rendered))
    merged, merging = _merged(job, budget)
    scored = _seconds(lambda: _evaluate(job, merged, targets)) / len(targets.cameras)
    views = len(train) + len(test) + (0 if apart is None else len(apart))
    judged = len(test) + (0 if apart is None else len(apart) // 2)
    pixels = int(np.mean(train.widths.astype(np.int64) * train.heights))
    steps = _steps(job, merged)
    return Estimate(
        views=views,
        pixels=pixels,
        steps=steps,
        seconds={
            "prepare": job.seconds,
            "targets": rendered[0] + per_view * (views - 1),
            "select": _select_seconds(job, merged),
            "simplify": merging,
            "recover": _recover_seconds(job, merged, targets, steps, scored),
            "score": 2 * judged * scored,
            "write": _PICTURES + (_page_seconds(merged) if page else 0.0),
        },
        bytes=max(_trial_bytes(job, budget), _page_bytes(job, merged) if page else 0)
        + 2 * merged.nbytes  # the recovered scene, and its rows on their way to the file
        + min(CACHE_BYTES, views * pixels * _pixel_bytes(job)),
    )


def check_memory(job: DistillJob, most: int | None, *, page: bool = True) -> None:
    """Refuse a job that takes more memory than `most` bytes by `estimate`, at any of its budgets; None is no
    limit.

    Raises:
        InputError: it does.
    """
    if most is None:
        return
    need = max(estimate(job, budget, page=page).bytes for budget in job.budgets)
    if need > most:
        count = len(job.prior)
        told = f"--memory: {plural(count, 'Gaussian')} in one piece take about {amount(need, up=True)}, "
        told += f"more than {amount(most)}; smaller views, --size, take less"
        if job.teacher is not None and job.lifting is None:  # what tiles can work on
            tiles = TileMemory(count, 4 * row_width(job.prior.sh_degree), RECOVERY_TIMES)
            told += f"; in tiles {tiles.advice(most, max(1, count // 2), foretold([job.prior.means], count))}"
        raise InputError(told)


def total(estimates: Sequence[Estimate]) -> tuple[float, int]:
    """Seconds and bytes of one run at several budgets: preparation and targets once, the rest one by one."""
    once = sum(estimates[0].seconds[stage] for stage in _ONCE)
    apart = sum(found.total - sum(found.seconds[stage] for stage in _ONCE) for found in estimates)
    return once + apart, max(found.bytes for found in estimates)


def _seconds(work: Callable[[], object]) -> float:
    began = time.monotonic()
    work()
    return time.monotonic() - began


def _evenly(cameras: Cameras, count: int) -> Cameras:
    chosen = np.linspace(0, len(cameras) - 1, min(count, len(cameras))).round().astype(int)
    return cameras.take(np.unique(chosen))


def _over_views(work: Callable[[Cameras], object], cameras: Cameras, count: float) -> float:
    """Seconds of work that goes over `count` views, by what it takes for two and for six of them."""
    few, some = (_evenly(cameras, tried) for tried in _TRIED)
    first = _seconds(lambda: work(few))
    if len(some) == len(few):
        return first
    each = (_seconds(lambda: work(some)) - first) / (len(some) - len(few))
    return first + max(0.0, each) * max(0.0, count - len(few))


def _evaluate(job: DistillJob, merged: Splats, targets: Targets) -> None:
    from g2ard.stages.evaluate import evaluate

    evaluate(merged, targets, background=job.config.background)


def _select_seconds(job: DistillJob, student: Splats) -> float:
    """Of choosing views, or of weighing them, in every round that does."""
    from g2ard.stages.select import select

    config, train = job.config, job.views.train.cameras
    if config.views is None and (job.weights is not None or not config.weighted):
        return 0.0
    policy = config.policy if config.views is not None else "auto"

    def choose(cameras: Cameras) -> None:
        select(job.prior, cameras, len(cameras), policy=policy, seed=config.seed, options=config.select)

    once = _over_views(choose, train, len(train))
    return once * (max(1, _rounds(job, student)) if config.reselect else 1)


def _page_seconds(merged: Splats) -> float:
    """Of packing a scene as the page holds it, by some of its rows."""
    from g2ard.io.sog_write import sog_bytes
    from g2ard.policy.budget import DEVICES

    if len(merged) > DEVICES["web"]:
        return 0.0
    rows = np.linspace(0, len(merged) - 1, min(_PAGE_ROWS, len(merged))).round().astype(int)
    some = merged.take(rows)
    tried = _seconds(lambda: sog_bytes(Path("page.sog"), replace(some, offset=np.zeros(3))))
    return tried * (len(merged) / len(some)) ** _PAGE_POWER


def _pixel_bytes(job: DistillJob) -> int:
    """Of a target: RGB in float32 where it was rendered, in 8 bits where it is a photo."""
    return 12 if job.teacher is not None else 3


def _trial_bytes(job: DistillJob, budget: int) -> int:
    """What this process took at most, the trial included; where the system does not tell, what it should."""
    if (peak := peak_rss()) is not None:
        return peak
    rendering = _RASTER_BYTES * len(job.prior) if job.teacher is not None else 0
    return _PROGRAM_BYTES + job.prior.nbytes + max(rendering, _TRAINER_BYTES * budget)


def _page_bytes(job: DistillJob, merged: Splats) -> int:
    """What is taken while the page is written, the scene and the program included."""
    packing = _PAGE_BYTES * 3 * ((merged.sh_degree + 1) ** 2 - 1) * min(len(merged), _PAGE_FULL)
    return min(_PROGRAM_BYTES, peak_rss() or _PROGRAM_BYTES) + 2 * job.prior.nbytes + packing


def _merged(job: DistillJob, budget: int) -> tuple[Splats, float]:
    """The scene at its count, by `fast`, and about how long the method that was asked for takes."""
    from g2ard.stages.simplify import simplify

    began = time.monotonic()
    merged = simplify(job.prior, budget, method="fast").splats
    seconds = time.monotonic() - began
    if job.config.sh_degree is not None:
        merged = merged.with_sh_degree(job.config.sh_degree)
    if job.config.method == "fast":
        return merged, seconds + _look_seconds(job)
    return merged, _MERGING * seconds + (_look_seconds(job) if job.config.method == "default" else 0.0)


def _look_seconds(job: DistillJob) -> float:
    """Of the renders that simplification looks at, of which there are as many as they find something."""
    train = job.views.train.cameras
    looks = min(_LOOKS * fewest_looks(len(job.prior)), MOST_LOOKS, len(train))
    return _over_views(lambda some: visibility_source(some)(job.prior), train, looks)


def _recover_seconds(
    job: DistillJob, student: Splats, targets: Targets, steps: int, per_score: float
) -> float:
    """Of all steps, of trials of rates and of the looks by which recovery watches itself."""
    from g2ard.stages.recover.guard import LOOKS
    from g2ard.stages.recover.probe import trial_steps

    if (limit := job.config.recovery_time) is not None:
        return limit
    schedule = job.config.schedule
    tried = _RATES if schedule.multiplier is None and trial_steps(steps) else 0
    kinds = 1 if job.views.apart is None or job.teacher is None else 2
    looks = 2 + tried + (kinds * len(LOOKS) if schedule.guarded else 0)
    per_step = _step_seconds(job, student, targets)
    return per_step * (steps + tried * trial_steps(steps)) + _PROBED * looks * per_score


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

    config = job.config
    photos = job.photos_over_renders or job.teacher is None
    last = final_steps(config, student, job.views.train.cameras, photos=photos)
    return last + config.schedule.round_steps * _rounds(job, student)


def _rounds(job: DistillJob, student: Splats) -> int:
    """How many recoveries there are before the last; 0 where the schedule has no rounds."""
    from g2ard.stages.simplify import round_counts

    config = job.config
    if not config.schedule.round_steps:
        return 0
    kept, fold = config.simplify.retention or 0.75, config.simplify.fold
    return len(round_counts(len(job.prior), len(student), kept, fold))
