"""`g2ard adapt`."""

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
from g2ard.pipeline.presets import configure
from g2ard.progress import plural

_FIELDS = "steps tolerance schedule prior_views sh_degree engine background seed"


@command(
    "adapt",
    example="g2ard adapt small.ply --views winter/ -o winter.ply",
    settings="g2ard.pipeline.adapt:AdaptConfig",
    fields=tuple(f"adapt.{name}" for name in _FIELDS.split()),
    scenes=True,
)
def adapt(
    run: Run,
    compact: Annotated[Path, typer.Argument(metavar="COMPACT", help="Scene to adapt.")],
    views: opt.LookOption,
    output: opt.OutputOption,
    images: opt.ImagesOption = None,
    alpha: opt.AlphaOption = "composite",
    teacher: opt.TeacherOption = None,
    photos: opt.PhotosOption = False,
    resume: opt.ResumeOption = False,
    split: opt.SplitOption = "train",
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    preset: opt.PaperOption = None,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Refit colours and opacities to new images; means, rotations and scales stay fixed."""
    from g2ard.jobs.cost import cost_of_recovery
    from g2ard.jobs.inputs import load_scene
    from g2ard.jobs.teaching import Teaching, read_views
    from g2ard.pipeline.adapt import AdaptConfig
    from g2ard.pipeline.adapt import adapt as refit

    if teacher is not None and not photos:
        run.refuse_typed("with --teacher, unless --photos is given", "images", "alpha")
    background = opt.background_of(run, background, compact)
    settings, _ = run.settle(AdaptConfig(), preset)
    opt.check_engine(settings.get("adapt.engine"))
    config = configure(AdaptConfig(), preset or "auto", settings)
    work = place_checkpoint(output, ".work")
    if not dry_run:
        check_scene_run(run, work, resume, output)
    splats = run.load(compact)
    if output != opt.UNWRITTEN:
        check_positions(output, splats)
    dense = None if teacher is None else load_scene(teacher, run.say, run.render_model)
    teaching = Teaching.by(
        dense,
        config.background,
        chosen=background is not None,
        insisted=photos,
        rough=dry_run,
        say=run.say,
    )
    given = read_views(teaching, splats, opt.with_images(views, images, alpha), split, size)
    targets = teaching.targets(given.train.cameras, run.say)
    count = len(targets.cameras)
    most = config.most_steps(count)
    first = config.stretches(count)[0]
    cost = cost_of_recovery(splats, [targets.cameras], most, dense)
    if dry_run:
        tell_plan(run, len(splats), cost)
        return
    stops = first < most and config.tolerance > 0
    least = f"{first:,} to " if stops else ""
    run.say(
        f"{plural(count, 'image')}: {least}{plural(most, 'step')}{', as long as they gain' * stops}"
    )
    with stoppable(run, work, resume, output):
        work.mkdir(parents=True, exist_ok=True)
        result = refit(splats, targets, config, work=work, progress=run.progress)
        run.write(output, result.splats)
    gain = result.report.psnr
    end = "converged" if result.report.converged else "all steps taken"
    if result.report.exposure is not None:
        run.say(str(result.report.exposure))
    run.say(
        f"{output}: {plural(len(splats), 'Gaussian')}, {plural(result.report.steps, 'step')} ({end}), "
        f"{opt.trained_on(split)} {targets.cameras.size_text}: {gain.before:.2f} → {gain.after:.2f} dB"
    )
    run.result({**result.report.as_dict(), "output": str(output), "settings": listed(config)})
