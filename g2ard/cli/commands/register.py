"""`g2ard register`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import BackgroundOption, OutputOption, SceneArgument
from g2ard.config.choices import BLACK, Keep, Refinement
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.stages.register.report import Accuracy, Summary


@command(
    "register",
    example="g2ard register small.ply --photos new/ --focal 1200 --poses coarse.txt -o poses.json",
    settings=True,
)
def register(
    run: Run,
    scene: SceneArgument,
    photos: Annotated[
        Path,
        typer.Option(
            metavar="DIR|VIEWS",
            help="Photos to register: a folder, or views that name them and state their lenses. "
            "Without --poses and --pool, the views' own poses are the start.",
        ),
    ],
    output: OutputOption,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Poses to start from: views in any format, or ACE's text."),
    ] = None,
    pool: Annotated[
        str | None,
        typer.Option(
            metavar="VIEWS|N",
            help="For photos without a pose: start from the likest of these views, or of N planned ones.",
        ),
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(metavar="VIEWS", help="Lenses of a folder's photos: by name, or one for all."),
    ] = None,
    focal: Annotated[
        float | None, typer.Option(metavar="PX", min=1, help="Focal length of a folder's photos, pixels.")
    ] = None,
    size: Annotated[
        int | None, typer.Option(min=32, metavar="PIXELS", help="Shrink photos to this longer side, 1000.")
    ] = None,
    matcher: Annotated[
        str | None,
        typer.Option(
            metavar="auto|sift|direct|MODULE:FUNCTION",
            help="What matches photo and render: SIFT, nothing (direct alignment), or a function of yours. "
            "All but direct need the extra `register`; auto, the default, takes it where it is there.",
        ),
    ] = None,
    refine: Annotated[
        Refinement | None,
        typer.Option(
            help="A pose from features as it is, aligned, the mean of both by information, or that polished "
            "by the exact gradient; auto unless given."
        ),
    ] = None,
    passes: Annotated[int | None, typer.Option(min=1, help="Renders to match with, at most; 3.")] = None,
    accept: Annotated[
        float | None,
        typer.Option(min=0.01, max=1, help="ZNCC from which a photo counts as registered, 0.6."),
    ] = None,
    keep: Annotated[
        Keep,
        typer.Option(
            help="Write those that are uncertain as well, or all: what has no pose keeps its start."
        ),
    ] = "registered",
    protocol: Annotated[
        Literal["gs-cpr"] | None,
        typer.Option(
            help="gs-cpr: one pass of matches, no refinement, no fallback, and every photo kept: without a "
            "pose from 6 matches at least, where it started. Needs the extra `register`."
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="VIEWS", help="True poses, to score with: as --poses. They decide nothing."),
    ] = None,
    metres_per_unit: Annotated[
        float | None,
        typer.Option("--metres-per-unit", min=1e-9, help="With --truth: errors in cm, and recalls."),
    ] = None,
    split: Annotated[str, typer.Option(metavar="train|test|all", help="Of --photos VIEWS.")] = "all",
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Also write a page of renders laid on photos.")
    ] = None,
    background: BackgroundOption = None,
) -> None:
    """Find where photos were taken, by matching renders of a scene with them.

    Each photo is registered, uncertain or refused; OUT holds the registered ones as views.
    """
    from g2ard.config.paths import changed, listed
    from g2ard.config.presets import GS_CPR
    from g2ard.errors import InputError
    from g2ard.io import check_views_output, write_views
    from g2ard.io.atomic import check_output
    from g2ard.policy.inputs import load_scene
    from g2ard.policy.register import photos_of, pool_of, poses_for
    from g2ard.stages.register import RegisterConfig
    from g2ard.stages.register import register as find
    from g2ard.stages.register.report import summarize

    names = ("size", "matcher", "refine", "passes", "accept")
    settings = run.settings(RegisterConfig(), *names)
    if protocol == "gs-cpr":
        given = {
            "--passes": passes not in (None, 1),
            "--refine": refine not in (None, "none"),
            "--keep": keep not in ("registered", "all"),
        }
        if contradicted := [name for name, said in given.items() if said] + ["--matcher"] * (
            matcher == "direct"
        ):
            raise typer.BadParameter(f"--protocol gs-cpr decides {contradicted[0]}; leave that out")
        settings, keep = GS_CPR | settings, "all"
        run.config |= {"keep": keep}
    config = changed(RegisterConfig(), settings)
    if metres_per_unit is not None and truth is None:
        raise typer.BadParameter("--metres-per-unit goes with --truth")
    if intrinsics is not None and focal is not None:
        raise typer.BadParameter("--intrinsics and --focal exclude each other; give one")
    check_views_output(output, run.overwrite)
    if report is not None:
        from g2ard.io.paths import real_path

        others = (output, scene, poses, truth, intrinsics, photos)
        if real_path(report) in {real_path(p) for p in others if p}:
            raise typer.BadParameter(f"--report {report} would be written over; name another output")
        if report.suffix.lower() not in (".html", ".htm"):
            raise typer.BadParameter(f"--report {report}: a page is written as .html")
        check_output(report, run.overwrite)
    taken = photos_of(photos, split=split, intrinsics=intrinsics, focal=focal, say=run.say)
    folder = photos.is_dir() and (intrinsics is not None or focal is not None)
    if poses is None and pool is None and folder:
        raise InputError(f"{photos}: photos have no pose to start from; give --poses or --pool")
    starts = {}
    if poses is not None:
        starts = poses_for(poses, taken.names)
    elif pool is None:
        starts = dict(zip(taken.names, taken.viewmats, strict=True))
    true = {} if truth is None else poses_for(truth, taken.names)
    splats = load_scene(scene, run.say)
    places = pool_of(splats, pool, run.seed, run.progress, run.say) if pool is not None else None
    found = find(
        splats,
        taken,
        starts=starts,
        pool=places,
        truth=true,
        config=config,
        keep=keep,
        background=background or BLACK,
        progress=run.progress,
    )
    rows = found.report.photos
    summary = summarize(rows, keep=keep, true=len(true), metres_per_unit=metres_per_unit)
    lines = _told(summary)
    for line in lines:
        run.say(line)
    if report is not None:
        from g2ard.report.registered import registration_report

        colour = background or BLACK
        registration_report(
            report,
            f"Photos in {scene.name}",
            splats,
            taken,
            found.report.photos,
            starts,
            matches=found.matches,
            side=config.size,
            told=lines,
            background=colour,
        )
    if len(found.cameras):
        write_views(output, found.cameras, overwrite=run.overwrite)
    written = str(output) if len(found.cameras) else None
    run.result(
        {
            **found.report.as_dict(),
            "summary": summary.as_dict(),
            "output": written,
            "settings": listed(config),
        }
    )
    if not len(found.cameras):
        first = next(row for row in rows if row.status != "registered")
        raise InputError(f"none of {plural(len(rows), 'photo')} was registered; {first.name}: {first.reason}")
    run.say(f"{output}: {len(found.cameras)} of {plural(len(rows), 'photo')}")


def _told(summary: Summary) -> list[str]:
    counts = f"{summary.registered} registered, {summary.uncertain} uncertain, {summary.refused} refused"
    scored = (("started from", summary.start), ("found", summary.found))
    return [
        f"{plural(summary.photos, 'photo')}: {counts}",
        *(f"{words}: {_said(accuracy, summary)}" for words, accuracy in scored if accuracy is not None),
    ]


def _said(accuracy: Accuracy, summary: Summary) -> str:
    if accuracy.median is None:
        return f"no pose of {summary.true} to score"
    scale, unit = (1.0, "units")
    if summary.metres_per_unit is not None:
        scale, unit = 100 * summary.metres_per_unit, "cm"
    shares = "".join(f", {r.share:.1%} ≤ {100 * r.metres:g} cm/{r.degrees:g}°" for r in accuracy.recalls)
    return (
        f"median {accuracy.median.position * scale:.3g} {unit} / {accuracy.median.rotation:.3g}° "
        f"over {accuracy.photos} of {summary.true}{shares}"
    )
