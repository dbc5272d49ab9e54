"""`g2ard recover`."""

from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.resume import check_scene_run, place_checkpoint, stoppable
from g2ard.cli.run import Run
from g2ard.cli.run_result import tell_plan
from g2ard.config.schema import listed
from g2ard.io.scene_formats import check_positions
from g2ard.progress import plural

_FIELDS = "schedule steps recovery_time sh_degree engine background seed"


@command(
    "recover",
    example="g2ard recover small.ply --views poses.json --teacher scene.ply -o better.ply",
    settings="g2ard.stages.recover.config:RecoverConfig",
    fields=tuple(f"recover.{name}" for name in _FIELDS.split()),
    scenes=True,
)
def recover(
    run: Run,
    student: Annotated[
        Path, typer.Argument(metavar="STUDENT", help="Simplified scene to recover.")
    ],
    output: opt.OutputOption,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    alpha: opt.AlphaOption = "composite",
    teacher: opt.TeacherOption = None,
    photos: opt.PhotosOption = False,
    anchors: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE", help="The student before any recovery, if it was recovered before."
        ),
    ] = None,
    preset: opt.PresetOption = "auto",
    resume: opt.ResumeOption = False,
    split: opt.SplitOption = "train",
    weighted: Annotated[
        bool | None,
        typer.Option(
            "--weights/--no-weights", help="Sample views by their weights, if they have any."
        ),
    ] = None,
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Optimise a fixed set of Gaussians against photos or a teacher's renders."""
    from g2ard.jobs.recover import prepare
    from g2ard.jobs.teaching import check_teacher
    from g2ard.rendering.targets import kinds_of
    from g2ard.report.run import COLUMNS, describe_loss, list_cells
    from g2ard.stages.recover.config import RecoverConfig
    from g2ard.stages.recover.report import (
        describe_idle_regularizers,
        describe_outcome,
        describe_time_limit,
    )

    if teacher is not None and not photos:
        run.refuse_typed("with --teacher, unless --photos is given", "alpha")
    background = opt.background_of(run, background, student)
    settings, _ = run.settle(RecoverConfig(), preset)
    with run.usage():
        check_teacher(views, teacher)
    checkpoint = place_checkpoint(output, ".checkpoint.npz")
    if not dry_run:
        check_scene_run(run, checkpoint, resume, output)
    opt.check_engine(settings.get("recover.engine"))
    job = prepare(
        student,
        views=opt.with_images(views, images, alpha),
        teacher=teacher,
        photos=photos,
        preset=preset,
        settings=settings,
        split=split,
        size=size,
        weighted=weighted,
        render_model=run.render_model,
        anchors=anchors,
        rough=dry_run,
        **run.callbacks,
    )
    if output != opt.UNWRITTEN:
        check_positions(output, job.student)
    if dry_run:
        tell_plan(run, len(job.student), job.cost)
        return
    with stoppable(run, checkpoint, resume, output):
        result = job.run(checkpoint)
        run.write(output, result.splats)
    exposure = str(result.report.exposure or "")
    lines = [describe_outcome(result.report), describe_time_limit(result.report), exposure]
    lines += [describe_idle_regularizers([[result.report]]) if run.verbose else None]
    for line in filter(None, lines):
        run.say(line)
    with run.finishing("scoring"):
        kinds = job.score(result)
        if job.held_out is not None:
            pixels = job.held_out.cameras.size_text
            title = f"held-out views against {kinds_of(job.held_out)}, {pixels}, start → result:"
            run.console.table(title, list(COLUMNS), list_cells(kinds))
        for line in filter(
            None, (describe_loss(kind, "the student is better there") for kind in kinds)
        ):
            run.say(line)
    gain = result.report.psnr
    count = plural(len(job.student), "Gaussian")
    where = f"{opt.trained_on(split)} {job.targets.train.cameras.size_text}"
    run.say(f"{output}: {count}, {where}: {gain.before:.2f} → {gain.after:.2f} dB")
    report = {**result.report.as_dict(), "preset": job.preset, "prior": job.measures}
    report |= {"kinds": kinds, "settings": listed(job.config)}
    run.result({**report, "output": str(output)})
