"""`g2ard.distill`: reading inputs, deciding options, and running the pipeline."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from g2ard.config.checks import AtLeastOne, Positive, checks_arguments
from g2ard.config.choices import Colour, FormatName, PointColor, RenderModel
from g2ard.config.schema import keywords
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.io.types import Points
from g2ard.jobs.budget import Budget, parse_count
from g2ard.jobs.chosen_points import PointChoice
from g2ard.jobs.clean import remove_clutter
from g2ard.jobs.distill_job import DistillJob
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import Numbers, Views, split_views
from g2ard.jobs.memory import RECOVERY_TIMES
from g2ard.jobs.run_views import choose_views, find_pool_growth
from g2ard.jobs.scoring import add_scores
from g2ard.jobs.simplify import Reduction
from g2ard.jobs.start import Given, Start, describe_tiled_start, read_start
from g2ard.jobs.start_points import colored_source, is_sparse_file, keep_seen_points
from g2ard.jobs.teaching import Teaching
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.dense import Dense
from g2ard.pipeline.distill import Distilled, RunViews
from g2ard.progress import Detail, Progress, Say, plural, silent, unsaid
from g2ard.rendering.targets import kinds_told
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import (
    FREE,
    PriorMeasures,
    Regularizers,
    choose_regularizers,
    measure_prior,
)
from g2ard.stages.recover.config import RecoverConfig, Schedule

if TYPE_CHECKING:
    from g2ard.jobs.dense import Opened
    from g2ard.jobs.tile_options import Tiling

_USUAL_RATIO = 10
"""Reduction for which views are chosen if the count is measured later, in these views."""


@checks_arguments
def distill(
    scene: Splats | Points | str | Path | None,
    *,
    count: int | str | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    views: Views | None = None,
    photos: bool | None = None,
    held_out: Views | None = None,
    beside: str | Path | None = None,
    up: Numbers | None = None,
    size: AtLeastOne | None = None,
    clean: bool = False,
    render_model: RenderModel | None = None,
    box: Numbers | None = None,
    where: str | None = None,
    color: PointColor | None = None,
    format: FormatName = "ply",
    preset: str = "auto",
    time: Positive | None = None,
    steps: AtLeastOne | None = None,
    schedule: str | Schedule | None = None,
    background: Colour | None = None,
    seed: int | None = None,
    settings: Mapping[str, Any] | None = None,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
    **fields: Any,
) -> Distilled:
    """Distil a dense scene, or a coloured point cloud, exactly like the command `g2ard distill`.

    The scene is simplified and then recovered against photos or renders of the dense scene, in given, found
    or generated views; the simplified geometry serves as anchors. `g2ard.pipeline.distill` is the lower-level
    version for given targets and a `DistillConfig`.

    Args:
        scene: the dense scene, a coloured point cloud, or the path of either. None starts from photos alone:
            from COLMAP's sparse points, or as a fallback from points along camera rays
            (`g2ard.stages.photo_points`).
        count: Gaussians of the result, at most those of the scene. Photos alone need no budget: see
            `g2ard.jobs.start_points.choose_count`.
        ratio: reduction factor, at least 1.
        fit: largest file, such as "5MB", or a device (see `Budget`).
        min_psnr: PSNR (dB) that simplification alone must keep against the scene, in generated views.
        min_ssim: SSIM that it must keep; with `min_psnr` both hold. `say` receives the result's quality.
        views: cameras in world coordinates with or without photos, or the path of either. None uses cameras
            found beside the scene, or generates views; "made" always generates them. Every 8th view, or the
            test split of the views, is held out for scoring.
        photos: training images. True takes photos and skips views without one, False renders the scene, None
            takes the photo of each view and a render if it has none. A point cloud given with views needs
            photos; without views it is lifted, and the lift renders the training images.
        size: longer side of the views in pixels; photos only shrink to it.
        preset: settings by name: "auto" measures the scene; "trained", "lift" or "noisy" names its kind;
            "paper" is the method of the paper, see `g2ard.preset`.
        format: file format that `fit`, `min_psnr` and `min_ssim` are meant for, a name in
            `g2ard.io.scene_formats.FORMATS`.
        held_out: views to score on instead of the test split; `views` are then used for training only.
        up: (3,) direction away from the ground for generated views; None estimates it.
        clean: remove invisible and stray Gaussians first, like `g2ard clean`.
        render_model: "classic" or "antialiased": overrides what the scene's file says.
        box: of a point cloud's file, keep points between two corners (x, y, z, x, y, z).
        where: keep points for which this holds, such as "classification == 2".
        color: "intensity" or "class" to colour points by.
        beside: a path to look for cameras beside, if `scene` is not a path.
        time: seconds that the whole call may take, roughly: recovery gets what the rest leaves.
        steps: steps of the final recovery; None takes the schedule's, and more where views or points need
            them.
        schedule: fast, default, best or paper.
        background: RGB in [0, 1] behind the scene.
        seed: seed of generated views, and of the order of views in recovery.
        settings: values of `g2ard.DistillConfig` by path, such as {"recover.schedule.rates.means": 1e-3};
            they override the preset.
        work: folder for finished rounds and checkpoints; the same call resumes from it after Ctrl-C.
        progress: called by all stages.
        say: called with log messages.
        fields: other settings by field name, like the command's flags: `method="fast"`, `sh_degree=0`. None
            keeps the preset's value.

    Returns:
        The compact scene, its unrecovered version, a report, and the held-out targets.

    Raises:
        InputError: no budget or several, a budget that does not fit, a point cloud with views but no photos,
            an unreadable file, an unknown setting, or a value out of range.
        KeyboardInterrupt: after Ctrl-C; the same call resumes from `work`.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> small = distill(scene, ratio=10, steps=5, size=48)
    >>> len(small.splats), len(small.simplified), len(small.report.rounds)
    (90, 90, 1)

    With views of your own and a budget in bytes:

    >>> from g2ard.scene.cameras import Camera
    >>> views = Cameras.of(
    ...     Camera.facing([3 * np.cos(a), 3 * np.sin(a), 0], [0, 0, 0], width=64, height=48, name=f"{a}")
    ...     for a in range(8)
    ... )
    >>> small = distill(scene, fit="20kB", views=views, steps=5)
    >>> 0 < small.splats.nbytes < 20_000
    True

    From files: a scene, a point cloud, and one with photos:

    >>> small = distill("scene.ply", ratio=10)  # doctest: +SKIP
    >>> small = distill("cloud.laz", ratio=10)  # doctest: +SKIP
    >>> small = distill("cloud.ply", count=100_000, views="photos/", size=1600)  # doctest: +SKIP
    """
    named = {"steps": steps, "schedule": schedule, "background": background, "seed": seed}
    changed = keywords(distill, DistillConfig(), fields | named)
    budget = None
    if scene is not None or {count, ratio, fit, min_psnr, min_ssim} != {None}:
        budget = Budget(parse_count(count), ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
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
        time=time,
        settings=changed | dict(settings or {}),
        progress=progress,
        say=say,
    )
    source = Source(scene, render_model) if isinstance(scene, str | Path) else scene
    PointChoice(box, where, color).narrow(source, progress)
    job = prepare(source, budget, options)
    done = job.run(work)
    if judgement := job.budget.judge(done.splats):
        say(judgement[1])
    return add_scores(job, done)


@contextmanager
def open_job(
    scene: Given,
    budget: Budget | None,
    options: DistillOptions,
    tiling: Tiling | None = None,
) -> Iterator[DistillJob]:
    """Prepare a distillation of a scene in memory, or in tiles.

    Args:
        tiling: how to process the scene, a file, in tiles; None reads it into memory.
    """
    if tiling is None:
        yield prepare(scene, budget, options)
        return
    from g2ard.jobs.dense import open_tiles

    assert isinstance(scene, Source)
    began = time.monotonic()
    if scene.kind == "splats":
        options.check_trained()
    config = options.config
    source = scene.drawn_as(options.render_model)
    split = None
    if scene.kind == "points" and options.photo_views is not None:
        split = split_views(options.photo_views, options.held_out, options.say)
        _require_photos(split[0].cameras, split[1], "a trained scene")
        if not scene.others and is_sparse_file(scene, options.photo_views):
            source = keep_seen_points(scene, split[0].cameras)
        source = colored_source(source, split[0].cameras, planned=options.planned)
    with open_tiles(
        source,
        tiling,
        RECOVERY_TIMES,
        config.simplify,
        config.lift,
        budgets=[budget] if budget is not None else [],
        planned=options.planned,
        progress=options.progress,
        say=options.say,
    ) as tiles:
        yield prepare(scene, budget, options, replace(tiles, views=split), began)


def prepare(
    scene: Given,
    budget: Budget | None,
    options: DistillOptions,
    tiles: Opened | None = None,
    began: float | None = None,
) -> DistillJob:
    """Read inputs and decide everything that a distillation needs.

    With the use `merging`, messages leave out what only recovery uses. Other arguments and errors are those
    of `distill`.

    Args:
        budget: None chooses a count for photos alone.
        tiles: the scene, if it is in tiles.
        began: when the preparation began; None means now.
    """
    began = began or time.monotonic()
    say = options.say
    recovers = options.recovers
    seed = options.config.recover.seed  # rejects invalid settings before anything is read
    if tiles is None:
        start = read_start(scene, budget, options)
    else:
        assert isinstance(scene, Source)
        start = describe_tiled_start(scene, options, tiles)
    budget = budget or Budget(count=start.usual)
    dense = start.dense
    cleaned = None
    if options.clean and options.planned:
        say("--clean: only the run finds what to remove; counts are of the whole scene")
    elif options.clean:
        dense, cleaned = remove_clutter(dense, seed=seed, progress=options.progress, say=say)
    usual = max(1, dense.total // _USUAL_RATIO)
    views = choose_views(
        dense,
        options,
        usual if budget.is_measured else budget.of(dense.total, start.name),
        given=start.views,
        beside=start.beside,
        teach=not start.needs_photos and options.photos is not True,
    )
    cameras = views.train.cameras
    plan = None if tiles is None else tiles.plan
    reduce = Reduction(
        dense,
        cameras=cameras,
        blind=options.config.simplify.method == "paper",
        given=replace(options.request_views(None), views=None),
        config=options.config.simplify,
        recovered=recovers,
        plan=plan,
    )
    sh_degree = 3 if start.needs_photos else None  # points have one colour each, photos show more
    degree = options.configure(sh_degree=sh_degree).recover.sh_degree
    wanted = reduce.resolve(budget, start.name, f"scene.{options.format}", degree)
    teaching = _choose_teaching(options, start, dense, views)
    measured_in = cameras if teaching.photos and not options.planned else None
    regularizers, why, measures = _choose_regularizers(options, start, dense.sample, measured_in)
    teaching.propose_background(cameras)
    if start.given:
        shown = dense.sample
        if start.needs_photos and tiles is None:
            shown = start.dense.sample.take(np.arange(start.given))
        teaching.check_photos(shown, cameras, renders=not start.needs_photos)
    say(
        _describe_task(
            start, wanted.count, dense.total, cameras if recovers else None, photos=teaching.photos
        )
    )
    if not start.from_photos and wanted.count == dense.total:
        one = "point" if start.lifted else "Gaussian"
        say(f"nothing to simplify: the scene has {plural(dense.total, one)}")
    if recovers:
        say(Detail(f"regularisers: {why}"))
    config = options.configure(regularizers, sh_degree)
    if start.from_photos:
        recover = _adapt_to_photos(config.recover, options)
    else:
        recover = _grow_steps(config.recover, dense, cameras, of_photos=teaching.render is None)
    if teaching.photos:  # photos exist only for given poses
        views = replace(views, validation=None, apart=None)
    return DistillJob(
        dense=dense,
        budget=wanted,
        views=views,
        teaching=teaching,
        config=replace(config, recover=recover),
        lifted=start.lifted,
        preset=why,
        measured=measures,
        recovers=recovers,
        cleaned=cleaned,
        began=began,
        prepared=time.monotonic(),
        time=options.time,
        progress=options.progress,
        say=say,
        plan=plan,
    )


def _adapt_to_photos(recover: RecoverConfig, options: DistillOptions) -> RecoverConfig:
    """Return the settings of a start from photos: all scales of images count unless one was chosen."""
    schedule = recover.schedule
    chosen = isinstance(options.find("recover.schedule"), Schedule)
    if not chosen and options.find("recover.schedule.finest") is None:
        schedule = replace(schedule, finest=0.0)
    return replace(recover, schedule=schedule, from_points=True)


def _grow_steps(
    recover: RecoverConfig, dense: Dense, cameras: Cameras, *, of_photos: bool
) -> RecoverConfig:
    """Return the settings with more steps for a large scene, whose pool of views grows with it."""
    times = find_pool_growth(dense.total)
    if recover.steps is not None or recover.recovery_time is not None or of_photos or times == 1:
        return recover
    needed = recover.final_steps(dense.sample, cameras, of_photos=of_photos)
    return replace(recover, steps=round(needed * times))


def _choose_teaching(
    options: DistillOptions, start: Start, dense: Dense, views: RunViews
) -> Teaching:
    """Decide whether photos are targets, and whether renders of the dense scene are, at least elsewhere."""
    if start.needs_photos:
        _require_photos(views.train.cameras, views.test, "a trained scene")
    elif options.photos:
        otherwise = "leave out {photos} to render the scene there"
        _require_photos(views.train.cameras, views.test, otherwise)
    paths = (*views.train.cameras.image_paths, *views.test.image_paths)
    photos = options.photos
    if photos is None or start.needs_photos:
        photos = start.needs_photos or any(paths)
    background = options.config.recover.background
    renders = not photos or None in paths
    limit = options.target_bytes
    return Teaching(
        partial(dense.images, background=background, limit=limit) if renders else None,
        photos,
        background,
        chosen=options.find("recover.background") is not None,
        insisted=options.photos is True,
        rough=options.planned,
        say=options.say,
        limit=limit,
    )


def _require_photos(train: Cameras, test: Cameras, otherwise: str) -> None:
    """Reject views of which one has no photo; `otherwise` says what helps besides photos."""
    names = (*train.names, *test.names)
    paths = (*train.image_paths, *test.image_paths)
    if None in paths:
        raise InputError(
            f"view {names[paths.index(None)]} has no photo",
            hint=f"give views with photos, their {{images=DIR}}, or {otherwise}",
        )


def _choose_regularizers(
    options: DistillOptions, start: Start, prior: Splats, photos: Cameras | None
) -> tuple[Regularizers, str, PriorMeasures]:
    """Choose regularisers with `choose_regularizers`, or none for points of photos.

    Args:
        photos: training views, if they have photos; only then is their consistency measured.
    """
    kind = options.find("recover.regularizers") or "auto"
    paper = options.find("recover.schedule") == "paper"
    if start.from_photos and kind == "auto" and not paper:
        why = "none; points from photos are rough, and move freely"
        return FREE, why, measure_prior(prior)
    if start.needs_photos and kind == "paper":
        kind = "paper-lift"
    return choose_regularizers(kind, prior, photos, paper=paper)


def _describe_task(
    start: Start, count: int, total: int, train: Cameras | None, *, photos: bool
) -> str:
    """Describe the task in one line; `train` are the views of recovery, if there is one."""
    source = plural(total, "point") if start.lifted else f"{total:,}"
    counts = f"{source} → {plural(count, 'Gaussian')}"
    if train is None:
        return counts
    pictured = sum(path is not None for path in train.image_paths) if photos else 0
    if start.from_photos:
        return f"{plural(pictured, 'photo')} → {plural(count, 'Gaussian')}"
    against = kinds_told(pictured, len(train) - pictured)
    return f"{counts}; {plural(len(train), 'training view')} against {against}"
