"""`g2ard.distill`: reading inputs, deciding options, and running the pipeline."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.errors import InputError
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import load_scene, say_regions
from g2ard.jobs.job import DistillJob
from g2ard.jobs.view_checks import warn_of_photos
from g2ard.jobs.views import is_made, views_of
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from g2ard.io.types import Points
    from g2ard.jobs.fit import Aim
    from g2ard.jobs.inputs import Views
    from g2ard.pipeline import Distilled

    Scene = Splats | Points | str | Path | None


def distill(
    scene: Scene,
    *,
    count: int | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    views: Views | None = None,
    photos: bool | None = None,
    held_out: Views | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    size: int | None = None,
    clean: bool = False,
    format: str = "ply",
    preset: str = "auto",
    settings: Mapping[str, Any] | None = None,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
    **fields: Any,
) -> Distilled:
    """Distil a dense scene, or a coloured point cloud with photos, exactly like the command `g2ard distill`.

    The scene is simplified and then recovered against photos or renders of the dense scene, in given, found
    or generated views; the simplified geometry serves as anchors. `g2ard.pipeline.distill` is the lower-level
    version for given targets and a `DistillConfig`.

    Args:
        scene: the dense scene, a coloured point cloud, or the path of either. None starts from photos alone:
            from COLMAP's sparse points, or as a fallback from points along camera rays
            (`g2ard.jobs.photos`).
        count: Gaussians of the result, at most those of the scene.
        ratio: reduction factor, at least 1.
        fit: largest file, such as "5MB", or a device: quest3, mobile or web.
        min_psnr: PSNR (dB) that simplification alone must keep against the scene, in generated views.
        min_ssim: SSIM to keep likewise; with `min_psnr` both hold. `say` receives the result's quality.
        views, photos, held_out, beside, up, size, clean, format, preset: see `g2ard.DistillOptions`.
        settings: values of `g2ard.DistillConfig` by path, such as {"recover.schedule.rates.means": 1e-3};
            they override the preset.
        work: folder for finished rounds and checkpoints; the same call resumes from it after Ctrl-C.
        progress: called by all stages.
        say: called with log messages.
        fields: settings by field name, like the command's flags: `steps=100`, `background=(1, 1, 1)`,
            `method="fast"`. None keeps the preset's value.

    Returns:
        The compact scene, its unrecovered version, a report, and the held-out targets.

    Raises:
        InputError: no budget or several, a budget that does not fit, a point cloud without views, an
            unreadable file, an unknown setting, or a value out of range.
        KeyboardInterrupt: after Ctrl-C; the same call resumes from `work`.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> small = distill(scene, ratio=10, steps=5, size=48)
    >>> len(small.splats), len(small.simplified), len(small.report.rounds)
    (90, 90, 1)
    """
    budget = Budget(count, ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
    options = DistillOptions(
        views=views,
        photos=photos,
        held_out=held_out,
        beside=beside,
        up=up,
        size=size,
        clean=clean,
        format=format,
        preset=preset,
        settings={name: value for name, value in fields.items() if value is not None} | dict(settings or {}),
    )
    job = prepare(scene, [budget], options, progress=progress, say=say)
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
    """Read inputs and decide everything that a distillation needs, for one or more budgets.

    `counted` is called with the number of Gaussians to reduce, before budgets and views are computed; its
    exceptions propagate. Other arguments and errors are those of `distill`.
    """
    from g2ard.jobs.inputs import clutter_seen
    from g2ard.stages.recover.presets import preset_for

    began = time.monotonic()
    seed, background = options.config.recover.seed, options.config.recover.background
    if scene is None:
        scene = _points(budgets, options, progress, say)
    prior, lifted, beside, name = _prior(scene, options, progress, say)
    if lifted and (options.views is None or is_made(options.views)):
        raise InputError(
            "a point cloud cannot render training images", path=name, hint="give its photos with {views}"
        )
    cleaned = None
    if options.clean:
        found, _ = clutter_seen(prior, seed=seed, progress=progress, say=say)
        prior, cleaned = prior.take(found.keep), found.counts
    if counted is not None:
        counted(len(prior))
    lift_degree = 3 if lifted else None
    degree = options.configured(sh_degree=lift_degree).recover.sh_degree
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
    kind = options.named("recover.regularizers") or "auto"
    regularizers, why, measured = preset_for(
        "paper-lift" if lifted and kind == "paper" else kind,
        prior,
        train if use_photos else None,
        paper=options.named("recover.schedule") == "paper",
    )
    if use_photos and not lifted:
        warn_of_photos(prior, train, background, say)
    shown = sum(pictured[: len(train)]) if use_photos else 0
    say(_task(prior, aims, shown, len(train) - shown))
    say(f"regularisers: {why}")
    config = options.configured(regularizers, lift_degree)
    say_regions(prior, config.simplify, name, say)
    return DistillJob(
        prior=prior,
        aims=aims,
        views=replace(views, apart=None) if use_photos else views,  # photos exist only for given poses
        teacher=prior if needs_teacher else None,
        photos_over_renders=use_photos and needs_teacher,
        config=config,
        weights=views.train.weights if config.select.weighted else None,
        lifted=lifted,
        preset=why,
        measured=measured,
        seconds=time.monotonic() - began,
        cleaned=cleaned,
        progress=progress,
        say=say,
    )


def _task(prior: Splats, aims: Sequence[Aim], photos: int, renders: int) -> str:
    """Describe the task in one line."""
    from g2ard.scene.targets import kinds_told

    counts = ", ".join([*(f"{aim.count:,}" for aim in aims[:-1]), plural(aims[-1].count, "Gaussian")])
    views = plural(photos + renders, "view")
    return f"{len(prior):,} → {counts}; {views} against {kinds_told(photos, renders)}"


def _aims(
    prior: Splats,
    budgets: Sequence[Budget],
    options: DistillOptions,
    degree: int | None,
    name: str,
    progress: Progress,
    say: Say,
) -> tuple[Aim, ...]:
    """Resolve the budgets; bytes are measured at the result's SH degree."""
    from g2ard.jobs.fit import aim_of
    from g2ard.jobs.simplify import Reduction

    seed = options.config.recover.seed
    written = prior if degree is None else prior.with_sh_degree(degree)
    return tuple(
        aim_of(
            budget,
            prior if budget.bytes is None else written,
            name,
            file=f"scene.{options.format}",
            reduce=Reduction(prior, seed=seed, progress=progress),
            recovered=True,
            seed=seed,
            progress=progress,
            say=say,
        )
        for budget in budgets
    )


def _all_pictured(pictured: Sequence[bool], names: Sequence[str], lifted: bool) -> None:
    """Reject views without a photo if targets must be photos."""
    if not all(pictured):
        scene = "a trained scene" if lifted else "leave out {photos} to render the scene there"
        raise InputError(
            f"view {names[list(pictured).index(False)]} has no photo",
            hint=f"give views with photos, or {scene}",
        )


def _points(budgets: Sequence[Budget], options: DistillOptions, progress: Progress, say: Say) -> Points:
    """Create starting points from photos alone."""
    if options.views is None or is_made(options.views):
        raise InputError("missing; without a scene, pass photos with poses as views", parameter="scene")
    from g2ard.jobs.photos import points_of_photos

    wanted = max((budget.count for budget in budgets if budget.count is not None), default=None)
    return points_of_photos(
        options.views,
        options.held_out,
        wanted,
        asked=budgets[0].kind,
        background=options.config.recover.background,
        seed=options.config.recover.seed,
        progress=progress,
        say=say,
    )


def _prior(
    scene: Splats | Points | str | Path,
    options: DistillOptions,
    progress: Progress,
    say: Say,
) -> tuple[Splats, bool, str | Path | None, str]:
    """Return the dense scene, whether it was lifted, where to look for cameras, and its name in errors."""
    from g2ard.io import kind, read_cloud
    from g2ard.stages.lift import lift

    if isinstance(scene, Splats):
        return scene, False, options.beside, "scene"
    name, beside = "cloud", options.beside
    if isinstance(scene, str | Path):
        if kind(scene) == "splats":
            return load_scene(scene, say), False, beside or scene, str(scene)
        name, cloud = str(scene), read_cloud(scene)
        for note in cloud.notes:
            say(f"{scene}: {note}")
        scene = cloud.points
    lifted = lift(scene.positions, scene.colors, **vars(options.config.lift), progress=progress)
    return lifted, True, beside, name
