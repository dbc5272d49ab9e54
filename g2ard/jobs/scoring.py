"""Scores and report of a distillation."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from g2ard.config.schema import listed
from g2ard.io import read_splats
from g2ard.jobs.distill_job import DistillJob
from g2ard.jobs.doubts import doubt_merging, doubt_views
from g2ard.jobs.viewer_frame import choose_level_views
from g2ard.pipeline.distill import Distilled
from g2ard.poses import best_views
from g2ard.rendering.targets import Subset, Targets, kinds_of, scored_in
from g2ard.rendering.visibility import overdraw
from g2ard.report.distilled import Drawn
from g2ard.report.labels import RESULT
from g2ard.report.run import Packed, RunReport, summarize_by_kind
from g2ard.scene.cameras import USUAL
from g2ard.stages.evaluate import Evaluation, evaluate
from g2ard.system.peak_memory import peak_rss_of_all

_SHOWN = 3
"""Views in pictures of a run."""

_PICTURE = 800
"""Longer side in pixels of a view in these pictures, at least, also after --size."""


def choose_best_targets(job: DistillJob, done: Distilled) -> Targets:
    """Return targets of the views that show the result best: placed ones, or some of the scored ones."""
    held_out = job.targets.held_out
    full = job.views.full
    pool = job.views.pool
    cameras = held_out.cameras
    if job.renders and pool is not None:
        found = choose_level_views(job.prior, _SHOWN, pool.cameras)
        longest = max(_PICTURE, int(cameras.sides.max()))
        return job.dense.images(found.scaled(longest), job.config.recover.background)
    names = best_views(done.splats, _SHOWN, cameras).names
    if full is None:
        best: Targets = Subset(held_out, [cameras.names.index(name) for name in names])
    else:
        larger = full.take([full.names.index(name) for name in names])
        best = job.teaching.targets(larger.resized(_PICTURE))
    return done.match_exposures(best)


def add_scores(job: DistillJob, done: Distilled) -> Distilled:
    """Return a result with its scores in held-out views, at their own size."""
    targets = done.match_exposures(job.targets.full or job.targets.held_out)
    background = job.config.recover.background
    found = evaluate(
        done.splats, targets, background=background, progress=job.progress, stage="scoring"
    )
    return replace(done, scores=replace(found, scored_in=scored_in(targets, "held-out")))


def describe_run(
    job: DistillJob, done: Distilled, file: Path, drawn: Drawn | None = None
) -> RunReport:
    """Score the simplified and the recovered scene in held-out views, and describe the run.

    Args:
        file: the written result; its scores are those of the file read back if it is packed.
        drawn: keeps the pictures that the page shows.
    """
    background = job.config.recover.background
    from_points = job.config.recover.from_points
    score = partial(evaluate, background=background, progress=job.progress)

    scenes = {"simplified": done.simplified, "recovered": done.splats}

    def score_one(name: str, label: str, targets: Targets) -> Evaluation:
        watch = None if drawn is None else partial(drawn.keep, label, targets)
        return score(scenes[name], targets, stage=f"score {name}", watch=watch)

    def score_both(targets: Targets) -> dict[str, Evaluation]:
        recovered = score_one("recovered", RESULT, targets)  # first, since its worst views are kept
        return {
            "simplified": score_one("simplified", "simplified", targets),
            "recovered": recovered,
        }

    targets = job.targets
    plan = job.plan
    held_out = done.match_exposures(targets.held_out)
    scores = score_both(held_out)
    apart = None if targets.apart is None else score_both(targets.apart)
    twice = None if targets.twice is None else score_both(targets.twice)
    full = None if targets.full is None else score_both(done.match_exposures(targets.full))
    parts = [part for part in (scores, apart, twice) if part is not None]
    before, after = ([view for part in parts for view in part[name].views] for name in scenes)
    generated = job.views.pool is not None and "test" in job.views.pool.splits
    simplify = job.config.simplify.resolved(antialiased=job.prior.antialiased)
    packed = None
    if file.name != "scene.ply":
        found = score(read_splats(file), held_out, stage="score file")
        packed = Packed(file.name, found.psnr, found.ssim)
    job.progress("gaps", 0, 0)
    photos = len(job.views.train.cameras) if from_points else None
    return RunReport(
        job.total,
        len(done.splats),
        job.lifted,
        photos,
        job.cleaned,
        bytes={
            "input": job.prior.nbytes * job.total // len(job.prior),
            "output": done.splats.nbytes,
            "file": file.stat().st_size,
        },
        scores=scores,
        apart=apart,
        size=held_out.cameras.size_text,
        own_size=None if full is None else {name: found.means for name, found in full.items()},
        kinds=summarize_by_kind(before, after, USUAL if generated else "given"),
        unseen=_find_unseen_share(job, done),
        warnings=_collect_warnings(job, done),
        opacity_lost=None if from_points else job.dense.opacity_lost(done.splats, held_out.cameras),
        overdraw=overdraw(done.splats, held_out.cameras, job.progress),
        against=kinds_of(targets.held_out),
        preset=job.preset,
        prior=job.measured,
        rounds=done.report.rounds,
        views=done.report.views,
        settings=listed(replace(job.config, simplify=simplify)),
        seconds=_sum_seconds(job, done),
        packed=packed,
        tiles=None if plan is None else plan.tiles,
        peak_rss_bytes=None if plan is None else peak_rss_of_all(),
    )


def _sum_seconds(job: DistillJob, done: Distilled) -> dict[str, float]:
    """Return the seconds by stage, with the scores as the rest until now, and their total."""
    stages = done.report.seconds.as_dict()
    now = time.monotonic()
    resumed = stages.get("resumed", 0.0)
    score = now - job.prepared + 2 * resumed - sum(stages.values())
    total = now - job.began + resumed
    return {"prepare": job.prepared - job.began, **stages, "score": score, "total": total}


def _collect_warnings(job: DistillJob, done: Distilled) -> tuple[str, ...]:
    """Return warnings about the views, and about regions of the result."""
    warnings = doubt_views(job.prior, job.views.train.cameras)
    if not job.config.recover.from_points:
        warnings += doubt_merging(job.prior, done.splats, blind=False)
    if job.views.guess is not None:
        warnings.append(
            f"warning: the up direction is a guess ({job.views.guess}); --up X,Y,Z sets it"
        )
    return tuple(warnings)


def _find_unseen_share(job: DistillJob, done: Distilled) -> float | None:
    """Return the share of the scene that no view sees, or None for the paper's method.

    For a generated pool it is the share of the matter, otherwise of the Gaussians in simplification's views.
    """
    if job.views.unseen is not None:
        return job.views.unseen
    unseen = done.report.rounds[0].simplify.unseen
    return None if unseen is None else unseen / job.total
