"""Scores of a distillation, as `g2ard distill` writes them to report.json, and of a recovery."""

from dataclasses import replace
from typing import Any

from g2ard.config.choices import Colour
from g2ard.config.schema import listed
from g2ard.jobs.distill import DistillJob
from g2ard.pipeline.distill import Distilled
from g2ard.progress import Progress
from g2ard.rendering.targets import Targets
from g2ard.rendering.visibility import overdraw
from g2ard.report.kinds import KindScore, by_kind
from g2ard.scene.cameras import USUAL
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.simplify.growth import opacity_lost


def report_of(job: DistillJob, done: Distilled) -> dict[str, Any]:
    """Score the simplified and the recovered scene in held-out views, and describe the run.

    Returns:
        Counts (`photos` for a start from photos alone), bytes, scores in held-out views (`scores`) and in
        views of other kinds (`apart`, or None), their image size (`size`), means at the views' own size if a
        requested one shrank them (`own_size`, or None), their summary by kind (`kinds`), the share of the
        light of opaque pixels that the result lets through (`opacity_lost`; None for points from photos),
        Gaussians per pixel (`overdraw`), rounds, seconds by stage, and every setting by path.
    """
    scenes, background = (done.simplified, done.splats), job.config.recover.background
    scores = _scores(*scenes, job.held_out, background, job.progress)
    apart = None if job.apart is None else _scores(*scenes, job.apart, background, job.progress)
    before, after = (
        [*scores[name]["views"], *(apart[name]["views"] if apart else [])]
        for name in ("simplified", "recovered")
    )
    full = job.full_size
    own_size = None if full is None else _scores(*scenes, full, background, job.progress)
    made = job.views.pool is not None and "test" in job.views.pool.splits
    config = replace(job.config, simplify=job.config.simplify.resolved(antialiased=job.prior.antialiased))
    return {
        "input_count": len(job.prior),
        "output_count": len(done.splats),
        "lifted": job.lifted,
        "photos": len(job.views.train.cameras) if job.config.recover.from_points else None,
        "cleaned": job.cleaned,
        "bytes": {"input": job.prior.nbytes, "output": done.splats.nbytes},
        "scores": scores,
        "apart": apart,
        "size": job.held_out.cameras.size_text,
        "own_size": own_size and {name: means(scores) for name, scores in own_size.items()},
        "kinds": by_kind(before, after, USUAL if made else "given"),
        "unseen": _unseen(job, done),
        "opacity_lost": None
        if job.config.recover.from_points
        else opacity_lost(job.prior, done.splats, job.held_out.cameras),
        "overdraw": overdraw(done.splats, job.held_out.cameras),
        "against": job.against,
        "preset": job.preset,
        "prior": job.measured,
        "rounds": done.report.rounds,
        "views": done.report.views,
        "settings": listed(config),
        "seconds": done.report.seconds.as_dict(),
    }


def _scores(
    simplified: Splats, recovered: Splats, targets: Targets, background: Colour, progress: Progress
) -> dict[str, Any]:
    """Score both scenes in some views."""
    scenes = {"simplified": simplified, "recovered": recovered}
    return {
        name: evaluate(
            splats, targets, background=background, progress=progress, stage=f"score {name}"
        ).as_dict()
        for name, splats in scenes.items()
    }


def means(scores: dict[str, Any]) -> dict[str, Any]:
    """Return the means of an evaluation and where it was scored."""
    return {name: scores[name] for name in ("psnr", "ssim", "edge_psnr", "scored_in")}


def scores_by_kind(
    before: Splats, after: Splats, targets: Targets, background: Colour, progress: Progress
) -> tuple[KindScore, ...]:
    """Score a scene before and after recovery in held-out views, by kind of view."""
    first, second = (
        report["views"] for report in _scores(before, after, targets, background, progress).values()
    )
    return by_kind(first, second, "given" if set(targets.cameras.kinds) == {USUAL} else USUAL)


def _unseen(job: DistillJob, done: Distilled) -> float | None:
    """Return the share of the scene that no view sees, or None for the paper's method.

    For a generated pool it is the share of the matter, otherwise of the Gaussians in simplification's views.
    """
    if job.views.unseen is not None:
        return job.views.unseen
    unseen = done.report.rounds[0].simplify.unseen
    return None if unseen is None else unseen / len(job.prior)
