"""`g2ard distill`: a dense scene or point cloud → a compact scene, its scores and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.outputs import read_budget, refuse_file
from g2ard.cli.run import Run
from g2ard.cli.run_result import say_fit, tell_plan, tell_run
from g2ard.cli.work_folder import drop_work, read_tiling, work_folder
from g2ard.config.choices import is_given, is_made
from g2ard.io import Source


@command(
    "distill",
    example="g2ard distill scene.ply -r 10 -o run/",
    settings="g2ard.pipeline.config:DistillConfig",
    fields=(
        *("simplify.method", "simplify.keep_region", "select.focus"),
        *(
            f"recover.{name}"
            for name in (
                "schedule",
                "steps",
                "recovery_time",
                "sh_degree",
                "engine",
                "background",
                "seed",
            )
        ),
    ),
    scenes=True,
    budgets=True,
    tiles=True,
    points=True,
)
def distill(
    run: Run,
    *,
    scene: Annotated[
        Path | None,
        typer.Argument(
            metavar="[SCENE|CLOUD]",
            help="A trained scene or coloured point cloud. Omit it to start from the photos of --views.",
        ),
    ] = None,
    others: opt.OthersArgument = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    alpha: opt.AlphaOption = "composite",
    photos: Annotated[
        bool | None,
        typer.Option(
            "--photos/--renders",
            help="Training images: photos or the scene's renders; by default photos where views have them, "
            "if they show the scene.",
        ),
    ] = None,
    held_out: Annotated[
        Path | None,
        typer.Option(
            metavar="VIEWS", help="Views to score on. --views is then used for training only."
        ),
    ] = None,
    preset: opt.PresetOption = "auto",
    time: opt.TimeOption = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the simplified scene too, in RUN/simplified.")
    ] = False,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN", help="Output folder.")],
    format: opt.FormatOption = "ply",
    views_format: opt.ViewsFormatOption = "g2ard",
    clean: Annotated[
        bool,
        typer.Option(
            "--clean", help="First remove invisible and stray Gaussians, as `g2ard clean` does."
        ),
    ] = False,
    page: Annotated[
        bool,
        typer.Option("--page/--no-page", help="Write view.html, a viewer page with the scene."),
    ] = True,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare/--no-compare",
            help="Show a small dense scene beside the result in view.html.",
        ),
    ] = True,
    resume: opt.ResumeOption = False,
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Distil a dense scene, or a coloured point cloud, into a compact scene.

    The result has an exact number of Gaussians and standard 3DGS properties.
    Views come from --views, or from cameras found beside the scene, or are generated.
    A point cloud needs no photos; with posed ones (--views), the result is as sharp as they are.
    Photos alone need no -n: it is one Gaussian per 100 of their pixels, at most 100,000.
    Scenes larger than memory and folders of tiles are distilled tile by tile.
    """
    from g2ard.cli.run_folder import RunFolder
    from g2ard.jobs.cost import check_job_memory, cost_of
    from g2ard.jobs.distill import open_job
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.scoring import choose_best_targets, describe_run
    from g2ard.jobs.tile_options import is_tiled
    from g2ard.pipeline.config import DistillConfig
    from g2ard.report.distilled import Drawn

    settings, _ = run.settle(DistillConfig(), preset)
    budget = read_budget(run, optional=scene is None)
    given = is_given(views)
    _check_options(scene, views, held_out, photos)
    if given:
        run.refuse_typed("on given views", "views_format")
    if scene is None or photos:
        run.refuse_typed("without generated views", "up")
    opt.check_engine(settings.get("recover.engine"))
    refuse_file(output, f"the scene in it is scene.{format}")
    run.claim("--output", output, folder=True)
    source = None if scene is None else Source(scene, run.render_model, others or ())
    opt.choose_points(run, source)
    folder = RunFolder(run, output, f"scene.{format}", resume)
    if not dry_run and (finished := folder.check(budget)):
        drop_work(read_tiling(run, source, output))
        run.result(finished)
        return
    if source is not None and source.kind == "views":
        raise typer.BadParameter(
            f"{scene} holds views, not a scene; to start from photos, pass it as --views with -n COUNT"
        )
    tiling = read_tiling(run, source, output)
    options = DistillOptions(
        views=opt.with_images(views, images, alpha),
        photos=photos,
        held_out=None if held_out is None else opt.with_images(held_out, images, alpha),
        up=up,
        size=size,
        clean=clean,
        format=format,
        preset=preset,
        time=time,
        memory=tiling.memory,
        settings=settings,
        planned=dry_run,
        **run.callbacks,
    )
    how = tiling if source is not None and is_tiled(source, tiling) else None
    if scene is not None and budget is not None and how is None:
        say_fit(run, scene, budget, f"scene.{format}")
    written = None if dry_run else how
    held = work_folder(run, written, options.views, options.held_out, again=" with --resume")
    with held, open_job(source, budget, options, how) as job:
        cost = cost_of(job, job.budget.count, page=page)
        if dry_run:
            tell_plan(run, job.budget.count, cost, job.plan)
            return
        check_job_memory(job, tiling.memory, cost.bytes)
        name = scene or Path(str(views))
        with folder.hold(job):
            done = job.run(folder.unfinished)
            folder.write(done, job.views, job.targets)
            drawn = None
            line = ""
            with run.showing("choosing views for report.html"):
                drawn = Drawn(
                    choose_best_targets(job, done),
                    list(filter(None, (done.held_out, job.targets.apart))),
                )
            with run.finishing("scoring"):
                report = describe_run(job, done, folder.scene, drawn)
            if drawn is not None:
                report, line = folder.write_pages(source or name, job, done, report, drawn)
            folder.write_report(report)
    tell_run(run, name, job, done, report, folder, line)


def _check_options(
    scene: Path | None, views: Path | None, held_out: Path | None, photos: bool | None
) -> None:
    """Reject inputs that leave nothing to distil, to train on or to score on."""
    if is_made(str(held_out)):
        raise typer.BadParameter(
            "--held-out must be a file of views; generated views already hold out every 8th"
        )
    if scene is None and (views is None or is_made(views)):
        raise typer.BadParameter("give a SCENE, or photos with their poses as --views")
    if photos and is_made(views):
        raise typer.BadParameter("--photos: generated views have no photos; give --views VIEWS")
    if scene is None and photos is False:
        raise typer.BadParameter("--renders needs a SCENE to render; give one or remove --renders")
