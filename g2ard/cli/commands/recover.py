"""`g2ard recover`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.cli.resume import check_scene_run, stoppable
from g2ard.cli.run_result import loss
from g2ard.config.paths import listed
from g2ard.errors import InputError
from g2ard.pipeline.presets import PRESETS, configured
from g2ard.progress import plural

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.config.choices import Colour
    from g2ard.io.types import ViewSet
    from g2ard.rendering.targets import Targets
    from g2ard.report.kinds import KindScore
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.stages.recover import Recovered


@command(
    "recover",
    example="g2ard recover small.ply --views poses.json --teacher scene.ply -o better.ply",
    cuda=True,
    settings="g2ard.stages.recover:RecoverConfig",
    scenes=True,
)
def recover(
    run: Run,
    student: Annotated[Path, typer.Argument(metavar="STUDENT", help="Simplified scene to recover.")],
    output: opt.OutputOption,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    alpha: opt.AlphaOption = "composite",
    teacher: opt.TeacherOption = None,
    photos: opt.PhotosOption = False,
    anchors: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE",
            help="The student before any recovery, if it was recovered before.",
        ),
    ] = None,
    preset: opt.PresetOption = "auto",
    schedule: opt.ScheduleOption = None,
    steps: opt.StepsOption = None,
    recovery_time: opt.RecoveryTimeOption = None,
    sh_degree: opt.ShDegreeOption = None,
    engine: opt.EngineOption = None,
    resume: opt.ResumeOption = False,
    split: opt.SplitOption = "train",
    weighted: Annotated[
        bool | None,
        typer.Option("--weights/--no-weights", help="Sample views by their weights, if they have any."),
    ] = None,
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
) -> None:
    """Optimise a fixed set of Gaussians against photos or a teacher's renders."""
    from g2ard.cli.teaching import Teaching, check_teacher
    from g2ard.rendering.targets import kinds_of
    from g2ard.stages.recover import RecoverConfig
    from g2ard.stages.recover import recover as optimize
    from g2ard.stages.recover.anchors import Anchors
    from g2ard.stages.recover.auto_preset import regularizers_for

    background = opt.background_of(run, background, student)
    names = ("schedule", "steps", "recovery_time", "sh_degree", "engine", "background", "seed")
    settings = run.settings(RecoverConfig(), *names, preset=preset)
    named = {**PRESETS[preset], **settings}
    check_teacher(views, teacher, photos)
    views = opt.with_images(views, images, alpha)
    checkpoint = output.parent / f".{output.name}.checkpoint.npz"
    check_scene_run(run, checkpoint, resume, output)
    opt.choose_engine(run, settings, "recover.engine")
    splats = run.load(student)
    colour = configured(RecoverConfig(), preset, settings).background
    teaching = Teaching(run, teacher, colour, chosen=background is not None, photos=photos)
    dense, views = teaching.dense, teaching.views(views)
    chosen, targets = teaching.training(splats, views, split, size)
    run.say(f"{plural(len(chosen.cameras), 'view')} against {kinds_of(targets)}")
    weights = _weights(run, chosen, named.get("select.weighted", True) if weighted is None else weighted)
    built = _built(run, anchors, splats) if anchors else None
    settings["recover.regularizers"], why, measured = regularizers_for(
        named.get("recover.regularizers", "auto"),
        dense or built or splats,
        None if dense else chosen.cameras,
        paper=named.get("recover.schedule") == "paper",
    )
    run.say(f"regularisers: {why}" + ("" if dense else "; measured on the student, as there is no teacher"))
    config = configured(RecoverConfig(), preset, settings)
    run.console.expect([("recover", 0.02 * config.horizon), ("scoring", 0.01 * len(chosen.cameras))])
    with stoppable(run, checkpoint, resume, output):
        result = optimize(
            splats,
            targets,
            config,
            weights=weights,
            anchors=Anchors.of(built, config.regularizers.in_plane) if built else None,
            checkpoint=checkpoint,
            progress=run.progress,
        )
        run.write(output, result.splats)
    _tell_outcome(run, result)
    with run.finishing("scoring"):
        held_out = teaching.held_out(views, size) if split == "train" else None
        kinds = _score(run, splats, result, held_out, chosen.cameras, colour) if held_out else ()
    gain, count = result.report.psnr, plural(len(splats), "Gaussian")
    run.say(f"{output}: {count}, {opt.trained_on(split)} {gain.before:.2f} → {gain.after:.2f} dB")
    report = {**result.report.as_dict(), "preset": why, "prior": measured.as_dict()}
    report |= {"kinds": [kind.as_dict() for kind in kinds], "settings": listed(config)}
    run.result({**report, "output": str(output)})


def _weights(run: Run, views: ViewSet, weighted: bool) -> NDArray[np.float64] | None:
    """Return the views' sampling weights if they have any and `weighted` is set."""
    if not weighted or views.weights is None:
        return None
    run.say(f"sampling {plural(len(views.weights), 'view')} by weight")
    return views.weights


def _built(run: Run, path: Path, student: Splats) -> Splats:
    """Read the student as it was built, in its present coordinates."""
    scene = run.load(path)
    if len(scene) != len(student):
        raise InputError(
            f"has {plural(len(scene), 'Gaussian')}, the student has {len(student):,}",
            path=path,
            hint="anchors are the student before any recovery",
        )
    return scene.recentred(student.offset)


def _tell_outcome(run: Run, result: Recovered) -> None:
    """Report an unusual recovery and, with --verbose, idle regularisers."""
    from g2ard.stages.recover.report import outcome, unregularized

    lines = [outcome(result.report), unregularized([[result.report]]) if run.verbose else None]
    for line in filter(None, lines):
        run.say(line)


def _score(
    run: Run, student: Splats, result: Recovered, held_out: Targets, trained: Cameras, colour: Colour
) -> tuple[KindScore, ...]:
    """Score held-out views, and print the table, losses and likely causes of a poor result."""
    from g2ard.jobs.causes import likely_causes
    from g2ard.jobs.score import scores_by_kind
    from g2ard.rendering.targets import kinds_of
    from g2ard.report.kinds import COLUMNS, cells

    kinds = scores_by_kind(student, result.splats, held_out, colour, run.progress)
    title = f"held-out views against {kinds_of(held_out)}, before → after:"
    run.console.table(title, list(COLUMNS), cells(kinds))
    lines = [loss(kind, "the student is better there") for kind in kinds]
    mean = sum(kind.views * kind.psnr.after for kind in kinds) / len(held_out.cameras)
    lines += likely_causes(result.splats, held_out, trained, result.report, mean, colour)
    for line in filter(None, lines):
        run.say(line)
    return kinds
