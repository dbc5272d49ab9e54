"""`g2ard distill`: a dense scene or point cloud → a compact scene, its scores and pictures."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.cli.outputs import budget_of, refuse_file
from g2ard.cli.run_result import (
    counts_line,
    loss,
    say_fit,
    say_views,
    say_weight,
    tell_quality,
    told,
    write_table,
)
from g2ard.cli.tiling import tiling_of, working
from g2ard.config.choices import is_made
from g2ard.io import kind
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.cli.run_folder import RunFolder
    from g2ard.jobs.budget import Budget
    from g2ard.jobs.cost import Cost
    from g2ard.jobs.distill import DistillJob
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.tiling import Tiling
    from g2ard.pipeline.distill import Distilled
    from g2ard.report.run import RunReport


@command(
    "distill",
    example="g2ard distill scene.ply -r 10 -o run/",
    cuda=True,
    settings="g2ard.pipeline.config:DistillConfig",
    fields=(
        *("simplify.method", "simplify.keep_region", "select.focus"),
        *(
            f"recover.{name}"
            for name in ("schedule", "steps", "recovery_time", "sh_degree", "engine", "background", "seed")
        ),
    ),
    scenes=True,
    budgets=True,
    tiles=True,
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
        typer.Option(metavar="VIEWS", help="Views to score on. --views is then used for training only."),
    ] = None,
    preset: opt.PresetOption = "auto",
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the simplified scene too, in RUN/simplified.")
    ] = False,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN", help="Output folder.")],
    format: opt.FormatOption = "ply",
    views_format: opt.ViewsFormatOption = "g2ard",
    clean: Annotated[
        bool,
        typer.Option("--clean", help="First remove invisible and stray Gaussians, as `g2ard clean` does."),
    ] = False,
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="Write view.html, a viewer page with the scene.")
    ] = True,
    resume: opt.ResumeOption = False,
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Distil a dense scene, or a point cloud with photos, into a compact scene.

    The result has an exact number of Gaussians and standard 3DGS properties.
    Views come from --views, or from cameras found beside the scene, or are generated.
    Scenes larger than memory and folders of tiles are distilled tile by tile.
    """
    from g2ard.cli.run_folder import RunFolder
    from g2ard.jobs.cost import check_job_memory, cost_of
    from g2ard.jobs.distill import prepare
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.tiling import is_tiled, needs_whole, refuse_whole
    from g2ard.pipeline.config import DistillConfig

    began = time.monotonic()
    settings, _ = run.settled(DistillConfig(), preset)
    budget = budget_of(run)
    given = views is not None and not is_made(views)
    _check_options(scene, views, held_out, photos)
    if given:
        run.refuse_typed("on given views", "views_format")
    if scene is None or photos:
        run.refuse_typed("without generated views", "up")
    opt.choose_engine(run, settings, "recover.engine")
    refuse_file(output, f"the scene in it is scene.{format}")
    run.claim("--output", output, folder=True)
    folder = RunFolder(run, output, f"scene.{format}", resume)
    if not dry_run and (finished := folder.check(budget)):
        run.result(finished)
        return
    if scene is not None:
        _check_kind(scene)
    options = DistillOptions(
        views=opt.with_images(views, images, alpha),
        photos=photos,
        held_out=None if held_out is None else opt.with_images(held_out, images, alpha),
        up=up,
        size=size,
        clean=clean,
        render_model=run.render_model,
        format=format,
        preset=preset,
        settings=settings,
    )
    tiling = tiling_of(run, scene, output)
    if scene is not None and is_tiled(scene, tiling):
        whole = {"clean": clean, "photos": photos, "dry_run": dry_run}
        refuse_whole(scene, needs_whole(options.config, preset, [budget], **whole))
        _in_tiles(run, scene, tiling, budget, options, folder)
        return
    if scene is not None:
        say_fit(run, scene, budget, f"scene.{format}")
    job = prepare(scene, budget, options, **run.callbacks)
    cost = cost_of(job, job.budget.count, page=page)
    if dry_run:
        _tell_cost(run, job, cost)
        return
    check_job_memory(job, tiling.memory, cost.bytes)
    run.console.expect(cost.stages)
    _whole(run, scene or Path(str(views)), job, folder, time.monotonic() - began)


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


def _check_kind(scene: Path) -> None:
    """Reject a file of views as the scene."""
    if kind(scene) == "views":
        raise typer.BadParameter(
            f"{scene} holds views, not a scene; to start from photos, pass it as --views with -n COUNT"
        )


def _tell_cost(run: Run, job: DistillJob, cost: Cost) -> None:
    """Print what a distillation would do, and its rough time and memory."""
    count = job.budget.count
    run.answer(
        f"{plural(count, 'Gaussian')}, {plural(cost.views, 'target image')} of {cost.pixels:,} pixels, "
        f"{plural(cost.steps, 'step')}: roughly {max(1, cost.seconds):.0f} s on two cores and "
        f"{cost.bytes / 1e6:,.0f} MB"
    )
    run.say_dry()
    run.result({"count": count, **asdict(cost), "seconds": cost.seconds})


def _whole(run: Run, source: Path, job: DistillJob, folder: RunFolder, prepared: float) -> None:
    """Distil, write the run's folder and print a summary; `prepared` are seconds before this call."""
    began, page = time.monotonic(), ""
    with folder.working(len(job.prior), job.budget.count, _photos(job)):
        result = job.run(folder.work)
        folder.write(result, job.views, job.targets)
        with run.finishing("scoring"):
            report = job.report(result, folder.scene)
        report = replace(report, seconds=_seconds(prepared, report.seconds, time.monotonic() - began))
        _write_pages(run, source, job, result, report, folder.path)
        if run.config["page"]:
            seen, colour = job.views.train.cameras, job.config.recover.background
            dense = None if job.config.recover.from_points else job.prior
            with run.finishing("view.html"):
                size, page = folder.write_view(result.splats, dense, seen, colour)
            report = replace(report, bytes={**report.bytes, "view": size})
        folder.write_report(report)
    of_photos = job.config.recover.from_points  # such points are no scene to compare with
    run.say(counts_line(report))
    write_table(run, report)
    for line in told(report, verbose=run.verbose):
        run.say(line)
    say_views(run, report.views, job.config.select.views_count is not None)
    if not of_photos:
        say_weight(run, source, folder.scene, result.splats, lifted=job.prior if job.lifted else None)
    folder.say_files("preview.png", page)
    run.result(report.as_dict())
    tell_quality(run, job.budget, result.splats)


def _in_tiles(
    run: Run, scene: Path, tiling: Tiling, budget: Budget, options: DistillOptions, folder: RunFolder
) -> None:
    """Distil tile by tile; finished steps stay in the tiling's folder until the command succeeds."""
    from g2ard.jobs.tiled import distill_in_tiles
    from g2ard.report.distilled import tiled_report

    with working(run, tiling, options.views, options.held_out, again=" with --resume"):
        done = distill_in_tiles(scene, budget, tiling, options, **run.callbacks)
        report, scores = done.report, done.report.scores
        with folder.writing():
            folder.write(done, done.views)
            counts = f"{report.input_count:,} → {report.output_count:,}"
            with run.finishing("report.html"):
                tiled_report(folder.path / "report.html", f"{scene.name}: {counts}", report)
            folder.write_report(report)
    write_table(run, report)
    for line in filter(None, map(loss, report.kinds)):
        run.say(line)
    run.say(
        f"{folder.path}: {report.output_count:,} of {report.input_count:,} Gaussians; over all pixels "
        f"{scores.simplified:.2f} → {scores.recovered:.2f} dB; "
        f"{plural(scores.steps, 'step')} in all tiles together"
    )
    folder.say_files()
    run.result(report.as_dict())


def _seconds(prepared: float, stages: dict[str, float], elapsed: float) -> dict[str, float]:
    """Return the seconds by stage, with the scores as the rest of `elapsed`, and their total.

    >>> _seconds(4.0, {"simplify": 2.0, "recover": 9.0, "resumed": 3.0}, 10.0)
    {'prepare': 4.0, 'simplify': 2.0, 'recover': 9.0, 'resumed': 3.0, 'score': 2.0, 'total': 17.0}
    """
    resumed = stages.get("resumed", 0.0)
    score = elapsed + 2 * resumed - sum(stages.values())
    return {"prepare": prepared, **stages, "score": score, "total": prepared + elapsed + resumed}


def _photos(job: DistillJob) -> list[Path]:
    """Return the photos and masks that the job reads."""
    views = (job.views.train.cameras, job.views.test)
    paths = (path for cameras in views for path in (*cameras.image_paths, *cameras.mask_paths))
    return list(dict.fromkeys(path for path in paths if path is not None)) if job.reads_photos else []


def _write_pages(
    run: Run, source: Path, job: DistillJob, result: Distilled, report: RunReport, folder: Path
) -> None:
    """Write report.html and preview.png."""
    from g2ard.report.distilled import distill_report, preview

    scenes = [("simplified", result.simplified), ("recovered", result.splats)]
    before = plural(report.photos, "photo") if report.photos else f"{len(job.prior):,}"
    title = f"{source.name}: {before} → {plural(len(result.splats), 'Gaussian')}"
    targets = list(filter(None, (job.targets.held_out, job.targets.apart)))
    colour = job.config.recover.background
    with run.finishing("report.html"):
        distill_report(folder / "report.html", title, scenes, targets, report, colour, told=told(report))
    with run.finishing("preview.png"):
        preview(folder / "preview.png", targets[0], scenes, colour)
