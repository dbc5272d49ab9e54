"""`g2ard evaluate`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer

from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.config.choices import BLACK, LpipsInput
from g2ard.errors import InputError
from g2ard.io import check_scene
from g2ard.io.paths import short_names
from g2ard.progress import plural


@command(
    "evaluate",
    example="g2ard evaluate small.ply --views poses.json --teacher scene.ply --json -",
    scenes=True,
)
def evaluate(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scenes to score.")],
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
        typer.Option(metavar="SCENE", help="The same Gaussians before recovery; adds Drift95."),
    ] = None,
    lpips: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder with LPIPS weights; adds LPIPS.")
    ] = None,
    lpips_input: Annotated[
        LpipsInput,
        typer.Option(help="Scale images to [-1, 1], as LPIPS expects, or feed [0, 1] as 3DGS does."),
    ] = "scaled",
    convention: opt.ConventionOption = "gsplat",
    eight_bit: Annotated[
        bool, typer.Option("--8bit", help="Round renders and targets to 8 bits, as in saved PNGs.")
    ] = False,
    split: opt.SplitOption = "test",
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
) -> None:
    """Score scenes against photos or a teacher's renders: PSNR, SSIM, size, needles, Gaussians per pixel.

    For the evaluation of the original 3DGS, use --convention inria --8bit --lpips-input unscaled.
    """
    from g2ard.io.describe import bytes_of
    from g2ard.jobs.inputs import load_views, make_targets
    from g2ard.jobs.view_checks import check_sight, propose_background
    from g2ard.rendering.lpips import load_lpips
    from g2ard.rendering.renderer import RasterSettings
    from g2ard.rendering.visibility import overdraw
    from g2ard.scene.targets import kinds_of
    from g2ard.stages.evaluate import evaluate as score
    from g2ard.stages.recover.anchors import Anchors, drift95, needle

    if photos and teacher is None:
        raise typer.BadParameter("--photos goes with --teacher; without a teacher, all targets are photos")
    if lpips_input != "scaled" and lpips is None:
        raise typer.BadParameter("--lpips-input goes with --lpips; give --lpips DIR")
    opt.can_be_made(views, teacher)
    views = opt.with_images(views, images, alpha)
    for path in scenes:
        check_scene(path)
    chosen, settings = opt.background_of(run, background, *scenes), RasterSettings(convention=convention)
    colour = chosen or BLACK
    dense = run.load(teacher) if teacher else None
    frozen = run.load(anchors) if anchors else None
    views = opt.views_or_teacher(run, views, teacher, dense)
    cameras = load_views(views, split, size, run.say, unpictured=dense is not None)
    if dense is None or photos:
        propose_background(cameras, colour, chosen is not None, run.say)
    targets = make_targets(
        cameras, dense, colour, photos=photos, settings=settings, progress=run.progress, say=run.say
    )
    networks = load_lpips(lpips, scaled=lpips_input == "scaled") if lpips else None
    rows: list[dict[str, Any]] = []
    for path in scenes:
        splats = run.load(path)
        check_sight(splats, cameras, run.say)
        scored = score(
            splats,
            targets,
            background=colour,
            lpips=networks,
            settings=settings,
            eight_bit=eight_bit,
            progress=run.progress,
            stage=path.name,
        )
        row = {"scene": str(path), **scored.as_dict(), "drift95": None, "needle": needle(splats.scales)}
        row["file_bytes"] = bytes_of(path)
        row["overdraw"] = overdraw(splats, cameras, run.progress)
        if frozen is not None:
            if len(frozen) != len(splats):
                raise InputError(f"has {len(frozen):,} Gaussians, {path} has {len(splats):,}", path=anchors)
            row["drift95"] = drift95(Anchors.of(frozen), splats.means)
        rows.append(row)
    protocol = f"{convention}'s conventions, {'8-bit' if eight_bit else 'float'} renders"
    _table(run, f"{plural(len(cameras), 'view')}, against {kinds_of(targets)}; {protocol}", rows)
    counts = Counter(view["against"] for view in rows[0]["views"])
    single = {"photo": "photos", "teacher": "teacher"}
    against = counts if len(counts) > 1 else single[next(iter(counts))]
    followed = {"convention": convention, "8bit": eight_bit, "lpips_input": lpips_input if lpips else None}
    run.result({"against": against, "protocol": followed, "scenes": rows})


def _table(run: Run, title: str, rows: list[dict[str, Any]]) -> None:
    columns = {
        "scene": short_names([Path(r["scene"]) for r in rows]),
        "Gaussians": [f"{r['count']:,}" for r in rows],
        "file MB": [f"{r['file_bytes'] / 1e6:.2f}" for r in rows],
        "PSNR": [f"{r['psnr']:.2f}" for r in rows],
        "SSIM": [f"{r['ssim']:.4f}" for r in rows],
        "needles": [f"{r['needle']:.1%}" for r in rows],
        "Gaussians/px": [f"{r['overdraw']:.1f}" for r in rows],
    }
    if all(r["lpips"] for r in rows):
        columns["LPIPS"] = [" ".join(f"{net} {value:.4f}" for net, value in r["lpips"].items()) for r in rows]
    if all(r["drift95"] is not None for r in rows):
        columns["Drift95"] = [f"{r['drift95']:.3g}" for r in rows]
    cells = [list(row) for row in zip(*columns.values(), strict=True)]
    run.console.table(title, list(columns), cells, stdout=run.json != "-")
