"""`g2ard recover`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.cli.resume import check_stopped, left_at, stoppable
from g2ard.cli.run_result import loss
from g2ard.config.paths import listed
from g2ard.config.presets import PRESETS, configured
from g2ard.errors import InputError
from g2ard.io import check_scene_output
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.config.choices import Colour
    from g2ard.report.kinds import KindScore
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.scene.targets import Targets
    from g2ard.stages.recover import Recovered


@command(
    "recover",
    example="g2ard recover small.ply --views poses.json --teacher scene.ply -o better.ply",
    cuda=True,
    settings=True,
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
    photos: Annotated[
        bool,
        typer.Option("--photos", help="With --teacher: use photos where views have them, renders otherwise."),
    ] = False,
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
    from g2ard.jobs.inputs import load_split_views, load_trained, make_targets
    from g2ard.jobs.view_checks import propose_background, warn_of_sight
    from g2ard.scene.targets import kinds_of
    from g2ard.stages.recover import RecoverConfig
    from g2ard.stages.recover import recover as optimize
    from g2ard.stages.recover.anchors import Anchors
    from g2ard.stages.recover.prior import regularizers_for
    from g2ard.stages.recover.report import outcome, unregularized

    background = opt.background_of(run, background, student)
    names = ("schedule", "steps", "recovery_time", "sh_degree", "background", "seed")
    settings = run.settings(RecoverConfig(), *names, preset=preset)
    named = {**PRESETS[preset], **settings}
    if weighted is None:
        weighted = named.get("select.weighted", True)
    if photos and teacher is None:
        raise typer.BadParameter("--photos goes with --teacher; without a teacher, all targets are photos")
    opt.can_be_made(views, teacher)
    views = opt.with_images(views, images, alpha)
    checkpoint = output.parent / f".{output.name}.checkpoint.npz"
    if left_at(checkpoint) or not (resume and output.exists()):
        check_scene_output(output, run.overwrite)
    check_stopped(run, checkpoint, resume, output)
    settings.setdefault("recover.engine", opt.recovery_engine(run))
    splats = run.load(student)
    dense = run.load(teacher) if teacher else None
    views = opt.views_or_teacher(run, views, teacher, dense)
    chosen = load_trained(views, split, size, run.say, unpictured=dense is not None)
    warn_of_sight(splats, chosen.cameras, run.say)
    colour = configured(RecoverConfig(), preset, settings).background
    if dense is None or photos:
        propose_background(chosen.cameras, colour, background is not None, run.say)
    targets = make_targets(chosen.cameras, dense, colour, photos=photos, progress=run.progress, say=run.say)
    run.say(f"{plural(len(chosen.cameras), 'view')} against {kinds_of(targets)}")
    weights = chosen.weights if weighted else None
    if weights is not None:
        run.say(f"sampling {plural(len(weights), 'view')} by weight")
    built = _built(run, anchors, splats) if anchors else None
    settings["recover.regularizers"], why, measured = regularizers_for(
        named.get("recover.regularizers", "auto"),
        dense or built or splats,
        None if dense else chosen.cameras,
        paper=named.get("recover.schedule") == "paper",
    )
    run.say(f"regularisers: {why}" + ("" if dense else "; measured on the student, as there is no teacher"))
    config = configured(RecoverConfig(), preset, settings)
    frozen = Anchors.of(built, config.regularizers.in_plane) if built else None
    with stoppable(run, checkpoint, resume):
        result = optimize(
            splats,
            targets,
            config,
            weights=weights,
            anchors=frozen,
            checkpoint=checkpoint,
            progress=run.progress,
        )
        run.write(output, result.splats)
    if (told := outcome(result.report)) is not None:
        run.say(told)
    if run.verbose and (told := unregularized([[result.report]])) is not None:
        run.say(told)
    kinds: tuple[KindScore, ...] = ()
    pool, _ = load_split_views(views, "all", unpictured=dense is not None)
    tested = [i for i, found in enumerate(pool.splits) if found == "test" and split == "train"]
    if tested:
        cameras = pool.cameras.take(tested).resized(size)
        held_out = make_targets(cameras, dense, colour, photos=photos, lazy=True)
        kinds = _score(run, splats, result, held_out, chosen.cameras, colour)
    gain, count = result.report.psnr, plural(len(splats), "Gaussian")
    run.say(f"{output}: {count}, {opt.trained_on(split)} {gain.before:.2f} → {gain.after:.2f} dB")
    report = {**result.report.as_dict(), "preset": why, "prior": measured.as_dict()}
    report |= {"kinds": [kind.as_dict() for kind in kinds], "settings": listed(config)}
    run.result({**report, "output": str(output)})


def _score(
    run: Run, student: Splats, result: Recovered, held_out: Targets, trained: Cameras, colour: Colour
) -> tuple[KindScore, ...]:
    """Score held-out views, and print the table, losses and likely causes of a poor result."""
    from g2ard.jobs.causes import likely_causes
    from g2ard.jobs.score import scores_by_kind
    from g2ard.report.kinds import COLUMNS, cells
    from g2ard.scene.targets import kinds_of

    kinds = scores_by_kind(student, result.splats, held_out, colour, run.progress)
    title = f"held-out views against {kinds_of(held_out)}, before → after:"
    run.console.table(title, list(COLUMNS), cells(kinds))
    lines = [loss(kind, "the student is better there") for kind in kinds]
    mean = sum(kind.views * kind.psnr.after for kind in kinds) / len(held_out.cameras)
    lines += likely_causes(result.splats, held_out, trained, result.report, mean, colour)
    for line in filter(None, lines):
        run.say(line)
    return kinds


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
