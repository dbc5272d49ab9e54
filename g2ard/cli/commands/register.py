"""`g2ard register`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.config.choices import Keep
from g2ard.config.schema import listed
from g2ard.errors import InputError
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.stages.register import PoseError


@command(
    "register",
    example="g2ard register small.ply --images new/ --focal 1200 --poses coarse.txt -o poses.json",
    settings="g2ard.stages.register:RegisterConfig",
    fields=tuple(f"register.{name}" for name in ("size", "matcher", "refine", "passes", "accept")),
    scenes=True,
    outputs=("output", "report"),
)
def register(
    run: Run,
    scene: opt.SceneArgument,
    photos: Annotated[
        Path,
        typer.Option(
            "--images",
            metavar="DIR|VIEWS",
            help="Photos to register: a folder, or views with photos and intrinsics. By default their own "
            "poses are the start.",
        ),
    ],
    output: opt.OutputOption,
    format: opt.ViewFormatOption = None,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Initial poses: views in any format, or ACE text."),
    ] = None,
    pool: Annotated[
        str | None,
        typer.Option(
            metavar="VIEWS|N",
            help="For photos without a pose: start from the most similar of these, best the scene's training "
            "views, or of N generated views.",
        ),
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            metavar="VIEWS", help="Intrinsics for a folder of photos: by name, or one for all."
        ),
    ] = None,
    focal: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            min=1,
            help="Focal length for a folder of photos, pixels; by default their EXIF's.",
        ),
    ] = None,
    keep: Annotated[
        Keep,
        typer.Option(
            help="Photos to write; with all, photos without a pose keep their initial one."
        ),
    ] = "registered",
    truth: Annotated[
        Path | None,
        typer.Option(metavar="VIEWS", help="True poses to compare with; not used otherwise."),
    ] = None,
    split: Annotated[
        str, typer.Option(metavar="train|test|all", help="Split of --images VIEWS.")
    ] = "all",
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Also write a page of renders overlaid on photos."),
    ] = None,
    alpha: opt.AlphaOption = "composite",
    background: opt.BackgroundOption = None,
) -> None:
    """Estimate camera poses of photos by matching them with renders of a scene.

    Each photo is registered, uncertain or refused; OUT gets the registered ones as views.
    """
    from g2ard.jobs.register import prepare
    from g2ard.report.registered import write_registration_report
    from g2ard.stages.register import RegisterConfig
    from g2ard.stages.register.report import KEPT

    config = run.settle(RegisterConfig())[1]
    if config.matcher == "direct":
        run.refuse_typed("with --matcher direct, which matches no features", "refine", "passes")
    if intrinsics is not None and focal is not None:
        raise typer.BadParameter("--intrinsics and --focal exclude each other; give one")
    run.claim_views(output, format)
    run.claim_file("--report", report, page=True)
    job = prepare(
        scene,
        photos,
        poses=poses,
        pool=pool,
        truth=truth,
        config=config,
        keep=keep,
        split=split,
        intrinsics=intrinsics,
        focal=focal,
        alpha=alpha,
        background=opt.background_of(run, background, scene),
        render_model=run.render_model,
        seed=run.seed,
        **run.callbacks,
    )
    found = job.run()
    rows = found.report.photos
    counts: dict[str, int] = {status: found.report.count(status) for status in KEPT["all"]}
    told = f"{plural(len(rows), 'photo')}: "
    told += ", ".join(f"{count} {status}" for status, count in counts.items())
    if truth is not None:
        before = _describe_median([row.start_error for row in rows])
        after = _describe_median([row.error for row in rows])
        told += f"; median error against --truth: {before} at the start, {after} found"
    run.say(told)
    if len(found.cameras):
        run.write_views(output, found.cameras, format)
    if report is not None:
        from g2ard.report.labels import name_scenes

        title = f"Photos in {name_scenes([scene])[0]}"
        with run.showing("--report"):
            write_registration_report(
                report,
                title,
                job.scene,
                job.photos,
                found,
                job.starts,
                config.size,
                told,
                job.background,
                overwrite=run.overwrite,
            )
    written = str(output) if len(found.cameras) else None
    result = {
        **found.report.as_dict(),
        "summary": {"photos": len(rows), **counts},
        "output": written,
    }
    run.result({**result, "settings": listed(config)})
    if not len(found.cameras):
        first = next(row for row in rows if row.status != "registered")
        raise InputError(
            f"none of {plural(len(rows), 'photo')} was registered; {first.name}: {first.reason}",
            hint="start closer: give rough poses with {poses=FILE}, or as {pool=VIEWS} views taken like the "
            "photos, such as the scene's training views",
        )
    run.say(f"{output}: {len(found.cameras)} of {plural(len(rows), 'photo')}")


def _describe_median(errors: Sequence[PoseError | None]) -> str:
    known = [(error.position, error.rotation) for error in errors if error is not None]
    if not known:
        return "none"
    position, rotation = map(median, zip(*known, strict=True))
    return f"{position:.3g} units / {rotation:.3g}° of {plural(len(known), 'photo')}"
