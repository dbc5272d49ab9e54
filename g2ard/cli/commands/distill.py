"""`g2ard distill`: a dense scene or point cloud → a compact scene, its scores and pictures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.cli.outputs import Outputs, budgets_of
from g2ard.cli.run_result import say_views, say_weight, tell_quality, told, why_large, write_table
from g2ard.cli.tiling import tiling_of
from g2ard.config.choices import is_made
from g2ard.io import kind
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.cli.run_folder import RunFolder
    from g2ard.jobs.budget import Budget
    from g2ard.jobs.job import DistillJob
    from g2ard.pipeline.distill import Distilled


@command(
    "distill",
    example="g2ard distill scene.ply -r 10 -o run/",
    cuda=True,
    settings="g2ard.pipeline.config:DistillConfig",
    fields=(
        *("simplify.method", "simplify.keep_region", "select.focus"),
        *(
            f"recover.{name}"
            for name in ("schedule", "steps", "recovery_time", "engine", "background", "seed")
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
    view: Annotated[
        bool, typer.Option("--view/--no-view", help="Write view.html, a viewer page with the scene.")
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
    from g2ard.cli.tiled import TiledCommand
    from g2ard.jobs.distill import prepare
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.tiling import is_tiled
    from g2ard.pipeline.config import DistillConfig

    began = time.monotonic()
    settings, _ = run.settled(DistillConfig(), preset)
    budgets = budgets_of(run)
    given = views is not None and not is_made(views)
    _check_options(scene, views, held_out, photos)
    if given:
        run.refuse_typed("on given views", "views_format")
    if scene is None or photos:
        run.refuse_typed("without generated views", "up")
    opt.choose_engine(run, settings, "recover.engine")
    if opt.is_unnamed(run, output) and len(budgets) > 1:
        output = Path("{count}")

    def folder_at(path: Path) -> RunFolder:
        return RunFolder(run, path, f"scene.{format}", resume)

    def check(path: Path, budget: Budget) -> None:
        run.claim("--output", path, folder=True)
        if not dry_run:
            folder_at(path).check(budget)

    outputs = Outputs(run, output, budgets, check)
    outputs.check()
    early = [folder_at(path) for path in outputs.paths()]
    if early and not dry_run and all(folder.is_done for folder in early):
        run.results([folder.tell_finished() for folder in early])
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
        TiledCommand(run, scene, outputs, tiling, budgets).distill(options, folder_at)
        return
    job = prepare(scene, budgets, options, counted=outputs.check, **run.callbacks)
    folders = [folder_at(path) for path in outputs.paths(len(job.prior))]
    if dry_run:
        _tell_estimates(run, job, folders)
    else:
        _distil_all(run, scene or Path(str(views)), job, folders, tiling.memory, began)


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


def _tell_estimates(run: Run, job: DistillJob, folders: Sequence[RunFolder]) -> None:
    """Print the estimated time and memory of each budget, and the total of several."""
    from g2ard.jobs.estimate import estimate, total

    found, told = [], []
    for folder, budget in zip(folders, job.budgets, strict=True):
        one = estimate(job, budget, page=run.config["view"])
        parts = ", ".join(f"{stage} {_rounded(seconds)} s" for stage, seconds in one.seconds.items())
        about = f"about {max(1, one.total):.0f} s ({parts}) and {one.bytes / 1e6:,.0f} MB"
        place = "" if opt.is_unnamed(run, folder.path) else f"{folder.path}: "
        run.answer(
            f"{place}{plural(budget, 'Gaussian')}, {plural(one.views, 'target image')} "
            f"of {one.pixels:,} pixels, {plural(one.steps, 'step')}: {about}"
        )
        found.append(one)
        told.append({"output": str(folder.path), "count": budget, **asdict(one), "total_seconds": one.total})
    seconds, size = total(found)
    if len(found) > 1:
        run.answer(f"all {len(found)} with shared targets: about {seconds:.0f} s and {size / 1e6:,.0f} MB")
    to_file = run.json not in (None, "-")
    run.say(f"dry run: only {run.json} is written" if to_file else "dry run: nothing is written")
    run.result({"runs": told, "total": {"seconds": seconds, "bytes": size}})


def _rounded(seconds: float) -> str:
    return f"{seconds:.1f}" if seconds < 10 else f"{seconds:.0f}"


def _distil_all(
    run: Run, source: Path, job: DistillJob, folders: Sequence[RunFolder], memory: int | None, began: float
) -> None:
    """Distil to every budget whose folder is not finished, and check the last result's quality."""
    from g2ard.jobs.estimate import expected
    from g2ard.jobs.memory_limit import check_job_memory

    finished = {folder.path: folder.tell_finished() for folder in folders if folder.is_done}
    if len(finished) == len(folders):
        run.results(list(finished.values()))
        return
    check_job_memory(job, memory, page=run.config["view"])
    run.console.expect(expected(job))
    prepared = time.monotonic()
    job.render_targets()
    before_runs = {"prepare": prepared - began, "targets": time.monotonic() - prepared}
    reports, others = [], " (--resume continues with the rest)" if len(folders) > 1 else ""
    for aim, folder in zip(job.aims, folders, strict=True):
        if folder.path in finished:
            reports.append(finished[folder.path])
            continue
        before = run.kept
        result, report = _distil(run, source, job, aim.count, folder, before_runs)
        before_runs = {}  # shared by all budgets
        reports.append(report)
        run.kept = [*before, f"{folder.path} is finished{others}"]
        judged = aim, result.splats
    run.results(reports)
    tell_quality(run, *judged)


def _distil(
    run: Run, source: Path, job: DistillJob, budget: int, folder: RunFolder, before: dict[str, float]
) -> tuple[Distilled, dict[str, Any]]:
    """Distil to one budget, write the run's folder and print a summary.

    Args:
        before: seconds of the stages before this call, which count as this budget's.
    """
    began, page = time.monotonic(), ""
    with folder.working(len(job.prior), budget, _photos(job)):
        result = job.run(budget, work=folder.work)
        folder.write_scene(result.splats)
        folder.write_simplified(result.simplified if run.config["keep"] else None)
        folder.write_views(job.views)
        folder.write_scored(job.held_out.cameras, None if job.apart is None else job.apart.cameras)
        with run.finishing("scoring"):
            report = _scored(run, job, result, folder)
        report["seconds"] = _seconds(before, report["seconds"], time.monotonic() - began)
        _write_pages(run, source, job, result, report, folder.path)
        if run.config["view"]:
            seen, colour = job.views.train.cameras, job.config.recover.background
            with run.finishing("view.html"):
                report["bytes"]["view"], page = folder.write_view(result.splats, seen, colour)
        folder.write_report(report)
    of_photos = job.config.recover.from_points  # such points are no scene to compare with
    write_table(run, report, why_large(result.splats) if of_photos else "")
    for line in told(report, verbose=run.verbose):
        run.say(line)
    say_views(run, report["views"], job.config.select.views_count is not None)
    if not of_photos:
        say_weight(run, source, folder.scene, result.splats, lifted=job.prior if job.lifted else None)
    run.say(
        f"scene: {folder.scene} ({folder.scene.stat().st_size / 1e6:.2f} MB)\n"
        f"picture: {folder.path / 'preview.png'}\n"
        f"report: {folder.path / 'report.html'}, {folder.path / 'report.json'}"
        + (f"\n{page}" if page else "")
    )
    return result, report


def _seconds(before: dict[str, float], stages: dict[str, float], elapsed: float) -> dict[str, float]:
    """Return the seconds by stage, with the scores as the rest of `elapsed`, and their total.

    >>> _seconds({"prepare": 4.0}, {"simplify": 2.0, "recover": 9.0, "resumed": 3.0}, 10.0)
    {'prepare': 4.0, 'simplify': 2.0, 'recover': 9.0, 'resumed': 3.0, 'score': 2.0, 'total': 17.0}
    """
    resumed = stages.get("resumed", 0.0)
    measured = sum(stages.values()) - resumed
    found = {**before, **stages, "score": elapsed + resumed - measured}
    return {**found, "total": sum(before.values()) + elapsed + resumed}


def _photos(job: DistillJob) -> list[Path]:
    """Return the photos and masks that the job reads."""
    views = (job.views.train.cameras, job.views.test)
    paths = (path for cameras in views for path in (*cameras.image_paths, *cameras.mask_paths))
    return list(dict.fromkeys(path for path in paths if path is not None)) if job.reads_photos else []


def _scored(run: Run, job: DistillJob, result: Distilled, folder: RunFolder) -> dict[str, Any]:
    """Return the report, with scores of the file read back if it is packed."""
    from g2ard.jobs.packing import score_file
    from g2ard.jobs.score import report_of

    report = report_of(job, result)
    report["bytes"]["file"] = folder.scene.stat().st_size
    if folder.scene.name != "scene.ply":
        colour = job.config.recover.background
        report["packed"] = score_file(folder.scene, job.held_out, colour, run.progress)
    return report


def _write_pages(
    run: Run, source: Path, job: DistillJob, result: Distilled, report: dict[str, Any], folder: Path
) -> None:
    """Write report.html and preview.png."""
    from g2ard.report.distilled import distill_report, preview

    scenes = [("simplified", result.simplified), ("recovered", result.splats)]
    title = f"{source.name}: {len(job.prior):,} → {len(result.splats):,}"
    targets = [job.held_out] if job.apart is None else [job.held_out, job.apart]
    colour = job.config.recover.background
    with run.finishing("report.html"):
        distill_report(folder / "report.html", title, scenes, targets, report, colour, told=told(report))
    with run.finishing("preview.png"):
        preview(folder / "preview.png", job.held_out, scenes, colour)
