"""Scores of a distillation, as `g2ard distill` writes them to report.json."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from g2ard.progress import Progress

if TYPE_CHECKING:
    from g2ard.jobs.job import DistillJob
    from g2ard.pipeline import Distilled
    from g2ard.scene.splats import Splats
    from g2ard.scene.targets import Targets


def report_of(job: DistillJob, done: Distilled) -> dict[str, Any]:
    """Score the simplified and the recovered scene in held-out views, and describe the run.

    Args:
        job: the job.
        done: its result.

    Returns:
        Counts, bytes, scores in each kind of views (or None), rounds, seconds by stage, and every setting by
        path.
    """
    from g2ard.config.paths import listed

    kinds = {"scores": job.held_out, "apart": job.apart[1]}
    config = replace(job.config, simplify=job.config.simplify.resolved())
    found = done.report.as_dict()
    return {
        "input_count": len(job.prior),
        "output_count": len(done.splats),
        "cleaned": job.cleaned,
        "bytes": {"input": job.prior.nbytes, "output": done.splats.nbytes},
        **{kind: _scores(job, done, targets, job.progress) for kind, targets in kinds.items()},
        "unseen": _unseen(job, done),
        "against": job.against,
        "preset": job.preset,
        "prior": job.measured.as_dict(),
        "rounds": found["rounds"],
        "views": found["views"],
        "settings": listed(config),
        "seconds": found["seconds"],
    }


def _scores(
    job: DistillJob, done: Distilled, targets: Targets | None, progress: Progress
) -> dict[str, Any] | None:
    """Score both scenes in one kind of views."""
    from g2ard.stages.evaluate import evaluate

    if targets is None:
        return None
    scenes: dict[str, Splats] = {"simplified": done.simplified, "recovered": done.splats}
    return {
        name: evaluate(
            splats,
            targets,
            background=job.config.recover.background,
            progress=progress,
            stage=f"score {name}",
        ).as_dict()
        for name, splats in scenes.items()
    }


def _unseen(job: DistillJob, done: Distilled) -> float | None:
    """Return the share of the scene that no view sees, or None for the paper's method.

    For a generated pool it is the share of the matter, otherwise of the Gaussians in simplification's views.
    """
    if job.views.unseen is not None:
        return job.views.unseen
    unseen = done.report.rounds[0].simplify.unseen
    return None if unseen is None else unseen / len(job.prior)
