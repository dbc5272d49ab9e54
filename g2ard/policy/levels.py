"""`g2ard.lod`: levels of detail, each merged from the one before and recovered at the size it is seen at."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.config.choices import BLACK, Colour
from g2ard.policy.budget import Budget
from g2ard.policy.inputs import make_targets
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.report.base import Report
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from g2ard.policy.inputs import Views
    from g2ard.policy.job import DistillJob
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.targets import Targets

RATIOS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""A level is half of the one before, as viewers' own tools make them."""

_SMALLEST = 200
"""Pixels that the longer side of a level's views keeps: beneath, the error of a render is its edge's."""


@dataclass(frozen=True)
class LevelReport(Report):
    """A level in numbers.

    Args:
        count: Gaussians.
        ratio: how many times fewer than the scene.
        size: pixels of the longer side of the views that it is recovered and scored in.
        seconds: of the whole level.
        simplified, recovered: PSNR, dB, in held-out views of that size; None for the scene itself.
    """

    count: int
    ratio: float
    size: int
    seconds: float
    simplified: float | None = None
    recovered: float | None = None


@dataclass(frozen=True, eq=False)
class Levels:
    """A scene's levels of detail, the finest first, and a report on each."""

    splats: tuple[Splats, ...]
    reports: tuple[LevelReport, ...]


def lod(
    scene: Splats | str | Path,
    *,
    ratios: Sequence[float] = RATIOS,
    recover: bool = True,
    views: Views | None = None,
    photos: bool | None = False,
    steps: int | None = None,
    size: int | None = None,
    background: Colour = BLACK,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    seed: int = 0,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Levels:
    """Levels of detail of a trained scene, as `g2ard lod` makes them, to the bit.

    A level is merged from the one before, so that its Gaussians are unions of that one's. From √r times as
    far N/r Gaussians fill as many pixels each, but a viewer that has not loaded more shows them near, too:
    level r is recovered against views shrunk by √√r, midway between.

    Args:
        scene: the dense scene, or its path.
        ratios: how many times fewer Gaussians each level has, rising; 1 is the scene as it is.
        recover: optimise each level; else they are merged alone.
        views: as for `g2ard.distill`.
        photos: True for the views' photos as targets, None for photos if every view has one; the default are
            the scene's own renders.
        steps: of each recovery; None for as many as `g2ard.distill` would take.
        size: pixels that the longer side of the finest level's views is shrunk to.
        background: RGB in [0, 1] behind the scene.
        beside: where to look for cameras, if `scene` is no path.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        seed: of all that is random.
        work: a folder for finished levels and checkpoints; the same call goes on there after a Ctrl-C.
        progress: told of all stages.
        say: told in lines what was noticed and decided.

    Returns:
        The levels, of exactly round(N/r) Gaussians each.

    Raises:
        InputError: ratios that do not rise, a scene or views that cannot be read.
        KeyboardInterrupt: after Ctrl-C; what is in `work` can be gone on from.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(800, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> ball = Splats.create(ball, scales=np.full((800, 3), 0.05), logit_opacities=np.full(800, 4))
    >>> [len(level) for level in lod(ball, ratios=(1, 4, 8), steps=3, size=48).splats]
    [800, 200, 100]
    """
    from g2ard.policy.distill import prepare
    from g2ard.policy.distill_options import DistillOptions

    check_ratios(ratios)
    job = prepare(
        scene,
        [Budget(ratio=ratio) for ratio in ratios],
        DistillOptions(
            views=views,
            photos=photos,
            size=size,
            beside=beside,
            up=up,
            settings=recovery_settings(steps, background, seed),
        ),
        progress=progress,
        say=say,
    )
    splats: list[Splats] = []
    reports: list[LevelReport] = []
    finer = job.prior
    for ratio, aim in zip(ratios, job.aims, strict=True):
        if ratio == 1:
            splats.append(job.prior)
            reports.append(LevelReport(len(job.prior), 1.0, level_size(job.views.train.cameras, 1), 0.0))
            continue
        say(f"level {len(splats)}: {plural(aim.count, 'Gaussian')}")
        place = None if work is None else work / f"level-{len(splats)}"
        level, finer, report = _level(job, finer, aim.count, ratio, recover, place)
        splats.append(level)
        reports.append(report)
    return Levels(tuple(splats), tuple(reports))


def recovery_settings(steps: int | None, background: Colour, seed: int) -> dict[str, Any]:
    """Return the settings of a level's recovery by path."""
    found = {"recover.background": background, "recover.seed": seed}
    return found if steps is None else {**found, "recover.steps": steps}


def check_ratios(ratios: Sequence[float]) -> None:
    """Refuse ratios that do not rise from 1 or more.

    Raises:
        InputError: naming them.
    """
    from g2ard.errors import InputError

    rising = all(a < b for a, b in pairwise(ratios))
    if not ratios or not rising or not all(1 <= ratio < math.inf for ratio in ratios):
        given = ", ".join(f"{ratio:g}" for ratio in ratios)
        raise InputError(f"expected rising numbers of at least 1, got {given}", parameter="ratios")


def _level(
    job: DistillJob, finer: Splats, count: int, ratio: float, recover: bool, work: Path | None
) -> tuple[Splats, Splats, LevelReport]:
    """The level, the same before recovery, and its report."""
    from g2ard.pipeline import distill as pipeline
    from g2ard.stages.evaluate import evaluate

    began = time.perf_counter()
    longest = level_size(job.views.train.cameras, ratio)
    held_out = _targets(job, job.views.test, longest)
    if recover:
        apart = None if job.views.apart is None or job.teacher is None else job.views.apart.resized(longest)
        if work is not None:
            work.mkdir(parents=True, exist_ok=True)
        done = pipeline(
            finer,
            count,
            _targets(job, job.views.train.cameras, longest),
            job.config,
            weights=job.weights,
            validation=None if apart is None else _targets(job, apart.take(range(0, len(apart), 2)), longest),
            work=work,
            progress=job.progress,
        )
        level, merged = done.splats, done.simplified
    else:
        level = merged = _merged(job, finer, count)
    scores = [
        evaluate(splats, held_out, background=job.config.recover.background, progress=job.progress).psnr
        for splats in ((merged, level) if recover else (merged,))
    ]
    seconds = time.perf_counter() - began
    return (
        level,
        merged,
        LevelReport(count, ratio, longest, seconds, scores[0], scores[1] if recover else None),
    )


def _merged(job: DistillJob, finer: Splats, count: int) -> Splats:
    """One step of the chain, weighed by the views that recovery would learn from."""
    from g2ard.rendering.visibility import visibility_source
    from g2ard.stages.simplify import simplify

    look = visibility_source(job.views.train.cameras, progress=job.progress)
    return simplify(finer, count, visibility=look, progress=job.progress).splats


def _targets(job: DistillJob, cameras: Cameras, longest: int) -> Targets:
    return make_targets(
        cameras.resized(longest),
        job.teacher,
        job.config.recover.background,
        progress=job.progress,
        say=job.say,
    )


def level_size(cameras: Cameras, ratio: float) -> int:
    """Pixels of the longer side of a level's views, given the finest level's."""
    longest = int(max(cameras.widths.max(), cameras.heights.max()))
    return longest if ratio == 1 else max(_SMALLEST, round(longest / ratio**0.25))
