"""`g2ard.distill`: what a scene, its views and a few options come to, and the pipeline on it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.errors import InputError
from g2ard.policy.budget import Budget
from g2ard.policy.distill_options import DistillOptions, takes_options
from g2ard.policy.inputs import load_scene, say_regions
from g2ard.policy.job import DistillJob
from g2ard.policy.view_checks import warn_of_photos
from g2ard.policy.views import is_made, views_of
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.regions import as_regions
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from g2ard.io.types import Points
    from g2ard.pipeline import DistillConfig, Distilled
    from g2ard.policy.fit import Aim
    from g2ard.stages.lift import LiftConfig
    from g2ard.stages.recover.anchors import Regularizers

    Scene = Splats | Points | str | Path | None

__all__ = ["distill", "prepare"]


@takes_options
def distill(
    scene: Scene,
    *,
    count: int | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
    **options: Any,
) -> Distilled:
    """Distil a dense scene, or a coloured cloud with photos, as `g2ard distill` does, to the bit.

    Views are chosen or made, the scene is simplified, its geometry frozen as anchors, and what is left is
    recovered against the views' photos or the dense scene's own renders. `g2ard.pipeline.distill` is the same
    for a caller who has targets and a `DistillConfig` of their own.

    Args:
        scene: the dense scene, a coloured cloud, or the path of either; None where `views` hold photos and
            there is nothing else: the start is then COLMAP's sparse points, else points within the cameras'
            sight (`g2ard.policy.photos`).
        count: Gaussians of the result, at most as many as there are.
        ratio: how many times fewer there are to be, at least 1.
        fit: instead, about the most whose file has these bytes at most, such as "5MB"; or a device: quest3,
            mobile or web.
        min_psnr: instead, about the fewest that simplification alone keeps this PSNR with, dB, against the
            scene in views of its own.
        min_ssim: the same of SSIM; with `min_psnr` both hold. `say` tells what the result has.
        work: a folder for finished rounds and checkpoints; the same call goes on there after a Ctrl-C.
        progress: told of all stages.
        say: told in lines what was noticed and decided.
        options: all else, see `g2ard.DistillOptions`.

    Returns:
        The compact scene, the same before recovery, a report, and the targets that were held out.

    Raises:
        InputError: not exactly one kind of budget, one that does not fit, a cloud without views,
            files that cannot be read, or a value out of its range.
        KeyboardInterrupt: after Ctrl-C; what is in `work` can be gone on from.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> small = distill(scene, ratio=10, steps=5, size=48)
    >>> len(small.splats), len(small.simplified), len(small.report.rounds)
    (90, 90, 1)
    """
    budget = Budget(count, ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
    job = prepare(scene, [budget], DistillOptions(**options), progress=progress, say=say)
    done = job.run(work=work)
    if judgement := job.aims[0].judge(done.splats):
        say(judgement[1])
    return done


def prepare(
    scene: Scene,
    budgets: Sequence[Budget],
    options: DistillOptions,
    *,
    counted: Callable[[int], object] | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> DistillJob:
    """Read and decide all that a distillation needs, at one budget or several; else as `distill`.

    `counted` is told how many Gaussians there are to reduce, before budgets and views are worked out; what it
    raises ends the preparation.

    Raises:
        InputError: as `distill`.
    """
    from g2ard.config.constants import changed, full_names
    from g2ard.pipeline import DistillConfig
    from g2ard.policy.inputs import clutter_seen
    from g2ard.stages.lift import LiftConfig
    from g2ard.stages.recover.presets import preset_for

    began = time.monotonic()
    chosen = options.by_preset()
    values = full_names(options.constants or {}, {"recover": DistillConfig(), "lift": LiftConfig()})
    lifting = changed(LiftConfig(), "lift", values)
    if scene is None:
        scene = _points(budgets, options, progress, say)
    prior, lifted, beside, name = _prior(scene, options.beside, lifting, progress, say)
    if lifted and (options.views is None or is_made(options.views)):
        raise InputError(
            "a point cloud cannot render training images", path=name, hint="give its photos with {views}"
        )
    cleaned, seed = None, options.seed
    if options.clean:
        found, _ = clutter_seen(prior, seed=seed, progress=progress, say=say)
        prior, cleaned = prior.take(found.keep), found.counts
    if counted is not None:
        counted(len(prior))
    degree = _sh_degree(options, chosen, lifted)
    aims = _aims(prior, budgets, options, degree, name, progress, say)
    views = views_of(
        prior,
        options.views,
        options.held_out,
        beside=beside,
        size=options.size,
        up=options.up,
        seed=seed,
        teach=not lifted and options.photos is not True,
        progress=progress,
        say=say,
    )
    train = views.train.cameras
    pictured = [path is not None for path in (*train.image_paths, *views.test.image_paths)]
    if lifted or options.photos:
        _all_pictured(pictured, (*train.names, *views.test.names), lifted)
    use_photos = lifted or (any(pictured) if options.photos is None else options.photos)
    needs_teacher = not (use_photos and all(pictured))
    kind = "paper-lift" if lifted and options.preset == "paper" else options.preset
    photographed = train if use_photos else None
    regularizers, why, measured = preset_for(kind, prior, photographed, paper=chosen["schedule"] == "paper")
    if use_photos and not lifted:
        warn_of_photos(prior, train, options.background, say)
    shown = sum(pictured[: len(train)]) if use_photos else 0
    say(_task(prior, aims, shown, len(train) - shown))
    say(f"regularisers: {why}")
    config = changed(_config(options, chosen, degree, regularizers), "recover", values)
    say_regions(prior, config.simplify, name, say)
    return DistillJob(
        prior=prior,
        aims=aims,
        views=replace(views, apart=None) if use_photos else views,  # photos are only where they were taken
        teacher=prior if needs_teacher else None,
        photos_over_renders=use_photos and needs_teacher,
        config=config,
        weights=views.train.weights if chosen["weighted"] else None,
        lifting=lifting if lifted else None,
        preset=why,
        measured=measured,
        seconds=time.monotonic() - began,
        cleaned=cleaned,
        progress=progress,
        say=say,
    )


def _task(prior: Splats, aims: Sequence[Aim], photos: int, renders: int) -> str:
    """What is to be made of what, in words."""
    from g2ard.scene.targets import kinds_told

    counts = ", ".join([*(f"{aim.count:,}" for aim in aims[:-1]), plural(aims[-1].count, "Gaussian")])
    views = plural(photos + renders, "view")
    return f"{len(prior):,} → {counts}; {views} against {kinds_told(photos, renders)}"


def _sh_degree(options: DistillOptions, chosen: dict[str, Any], lifted: bool) -> int | None:
    """Of the result: 3 from a cloud or for the paper's if none is asked for; None is the scene's own."""
    whole = lifted or chosen["schedule"] == "paper" or options.preset.startswith("paper")
    return 3 if options.sh_degree is None and whole else options.sh_degree


def _aims(
    prior: Splats,
    budgets: Sequence[Budget],
    options: DistillOptions,
    degree: int | None,
    name: str,
    progress: Progress,
    say: Say,
) -> tuple[Aim, ...]:
    """What the budgets come to; bytes are of the scene at the degree that the result is written in."""
    from g2ard.policy.fit import aim_of
    from g2ard.policy.simplify import Reduction

    written = prior if degree is None else prior.with_sh_degree(degree)
    return tuple(
        aim_of(
            budget,
            prior if budget.bytes is None else written,
            name,
            file=f"scene.{options.format}",
            reduce=Reduction(prior, seed=options.seed, progress=progress),
            recovered=True,
            seed=options.seed,
            progress=progress,
            say=say,
        )
        for budget in budgets
    )


def _all_pictured(pictured: Sequence[bool], names: Sequence[str], lifted: bool) -> None:
    """Refuse a view without a photo where only photos can be targets."""
    if not all(pictured):
        scene = "a trained scene" if lifted else "leave out {photos} to render the scene there"
        raise InputError(
            f"view {names[list(pictured).index(False)]} has no photo",
            hint=f"give views with photos, or {scene}",
        )


def _config(
    options: DistillOptions, chosen: dict[str, Any], degree: int | None, regularizers: Regularizers
) -> DistillConfig:
    """The pipeline's; `chosen` is what the preset had to decide."""
    from g2ard.pipeline import DistillConfig
    from g2ard.stages.recover.schedule import schedule_named
    from g2ard.stages.simplify.config import SimplifyConfig

    return DistillConfig(
        method=chosen["method"],
        schedule=schedule_named(chosen["schedule"], options.steps),
        steps=options.steps,
        recovery_time=options.recovery_time,
        regularizers=regularizers,
        sh_degree=degree,
        background=options.background,
        views=chosen["views_count"],
        policy=chosen["policy"],
        simplify=SimplifyConfig(keep_region=as_regions(options.keep_region)),
        weighted=chosen["weighted"],
        reselect=options.reselect,
        seed=options.seed,
        engine=options.engine,
    )


def _points(budgets: Sequence[Budget], options: DistillOptions, progress: Progress, say: Say) -> Points:
    """A start from photos alone."""
    if options.views is None or is_made(options.views):
        raise InputError("without one, photos with poses are needed as views", parameter="scene")
    from g2ard.policy.photos import points_of_photos

    wanted = max((budget.count for budget in budgets if budget.count is not None), default=None)
    return points_of_photos(
        options.views,
        options.held_out,
        wanted,
        asked=budgets[0].kind,
        background=options.background,
        seed=options.seed,
        progress=progress,
        say=say,
    )


def _prior(
    scene: Splats | Points | str | Path,
    beside: str | Path | None,
    lifting: LiftConfig,
    progress: Progress,
    say: Say,
) -> tuple[Splats, bool, str | Path | None, str]:
    """The dense scene, whether it is a lift, where cameras may lie beside it, and what errors call it."""
    from g2ard.io import kind, read_cloud
    from g2ard.stages.lift import lift

    if isinstance(scene, Splats):
        return scene, False, beside, "scene"
    name = "cloud"
    if isinstance(scene, str | Path):
        if kind(scene) == "splats":
            return load_scene(scene, say), False, beside or scene, str(scene)
        name, cloud = str(scene), read_cloud(scene)
        for note in cloud.notes:
            say(f"{scene}: {note}")
        scene = cloud.points
    lifted = lift(scene.positions, scene.colors, **vars(lifting), progress=progress)
    return lifted, True, beside, name
