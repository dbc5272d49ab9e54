"""`g2ard lod`: a scene → levels of detail as streamed SOG or 3D Tiles."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from g2ard.cli import options as opt
from g2ard.cli.budget_options import Ratios
from g2ard.cli.command import command
from g2ard.cli.outputs import refuse_file
from g2ard.cli.run import Run
from g2ard.cli.work_folder import read_tiling, work_folder
from g2ard.config.choices import BLACK, UNITS, LengthUnit, Named
from g2ard.io.atomic import hidden_name
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.io import Source
    from g2ard.jobs.levels import LevelsJob
    from g2ard.levels import Georeference
    from g2ard.scene.splats import Splats


@command(
    "lod",
    example="g2ard lod scene.ply -r 1,2,4,8,16 -o streamed/",
    scenes=True,
    tiles=True,
    points=True,
)
def lod(
    run: Run,
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE",
            help="A trained scene of any format, or a folder of tiles (`g2ard ingest`).",
        ),
    ],
    others: opt.OthersArgument = None,
    *,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Output folder for lod-meta.json or tileset.json, and its files.",
        ),
    ],
    ratios: Annotated[
        Ratios,
        typer.Option(
            "-r",
            "--ratios",
            parser=Ratios.parse,
            metavar="RATIOS",
            help="Ratio of each level, rising: 4 keeps a quarter of the Gaussians.",
        ),
    ] = "1,2,4,8,16",  # type: ignore[assignment]
    recover: Annotated[
        bool,
        typer.Option(
            "--recover/--merge-only", help="Recover each level after merging, or only merge."
        ),
    ] = True,
    environment: Annotated[
        bool,
        typer.Option(
            "--environment",
            help="Keep sky and far background apart: whole, and always shown (streamed SOG, not in tiles).",
        ),
    ] = False,
    most: Annotated[
        int,
        typer.Option(
            "--chunk-count", min=1, metavar="K", help="Target Gaussians per file, in units of 1024."
        ),
    ] = 512,
    extent: Annotated[
        float,
        typer.Option(
            "--chunk-extent",
            metavar="UNITS",
            help="Largest extent of a chunk, which viewers load as one, in scene units.",
        ),
    ] = 16.0,
    least: Annotated[
        int,
        typer.Option(
            "--chunk-min",
            min=1,
            metavar="K",
            help="Do not split chunks of fewer Gaussians, in units of 1024.",
        ),
    ] = 8,
    kind: Annotated[
        Literal["sog", "3dtiles"],
        typer.Option("--format", help="Streamed SOG, or 3D Tiles 1.1 for CesiumJS."),
    ] = "sog",
    place: Annotated[
        str | None,
        typer.Option(
            "--georeference",
            metavar="LON,LAT,HEIGHT[,HEADING]|EPSG:CODE",
            help="Place 3D Tiles on the globe: longitude, latitude and height of the scene's offset, and the "
            "heading of its y axis (z if -y is up), degrees from north; or its coordinates' map system.",
        ),
    ] = None,
    unit: Annotated[
        LengthUnit | None,
        typer.Option(
            help="Unit of the scene with --georeference; by default the scan's or map system's."
        ),
    ] = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps per level; by default until it converges.")
    ] = None,
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
    resume: opt.ResumeOption = False,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Write levels of detail as streamed SOG or 3D Tiles.

    Each level is merged from the one before, then recovered.
    Scenes larger than memory and folders of tiles are processed tile by tile.
    """
    from g2ard.cli.resume import (
        began_output,
        check_stopped,
        drop_ended,
        is_finished,
        read_record,
        record_finish,
        stoppable,
    )
    from g2ard.io import Source
    from g2ard.io.atomic import check_output
    from g2ard.jobs.inputs import GivenViews
    from g2ard.jobs.levels import (
        check_ratios,
        choose_tileset_up,
        open_levels,
        save_tileset,
        write_level_page,
    )
    from g2ard.jobs.memory import LEVELS_TIMES, RECOVERY_TIMES, check_whole_memory
    from g2ard.jobs.tile_options import is_tiled
    from g2ard.levels import Cut, save_levels
    from g2ard.system.keys import key_of
    from g2ard.system.peak_memory import peak_rss_of_all

    refuse_file(output, "levels of detail")
    source = Source(scene, run.render_model, others or ())
    opt.choose_points(run, source)
    if not recover:
        run.refuse_typed("with --merge-only", "steps")
    with run.usage():
        check_ratios(ratios)
        rule = Cut(most * 1024, extent, least * 1024)
        spot = None if place is None else _parse_georeference(place)
    tiling = read_tiling(run, source, output)
    tiled = is_tiled(source, tiling)
    if spot is not None and kind == "sog":
        raise typer.BadParameter("--georeference needs --format 3dtiles")
    if unit is not None and (spot is None or isinstance(spot, str)):
        raise typer.BadParameter("--unit needs --georeference LON,LAT,HEIGHT")
    if environment and kind != "sog":
        raise typer.BadParameter("--environment needs --format sog")
    if environment and tiled:
        raise typer.BadParameter("--environment needs a scene that fits into memory")
    views = opt.with_images(views, images)
    colour = background or BLACK
    meta = output / ("lod-meta.json" if kind == "sog" else "tileset.json")
    stopped = output.with_name(hidden_name(output.name, ".unfinished"))
    run.spare_inputs(meta)
    run.claim("--output", output, folder=True)
    run.claim("--resume", stopped, folder=True)
    work = tiling.folder if tiled else stopped
    finished = not dry_run and is_finished(run, stopped, resume, meta)
    if not (dry_run or (tiled and tiling.keep)):
        finished |= drop_ended(run, work, resume or tiled, meta)
    if not (finished or dry_run):
        ended = read_record(meta) is not None
        run.overwrite |= (tiled or resume) and not ended and began_output(work, output)
        check_output(output, run.overwrite, folder=True)
    if finished or not (tiled or dry_run):
        check_stopped(run, stopped, resume or finished, meta)
    given: Source | Splats = source
    if not tiled:
        check_whole_memory(source, tiling, LEVELS_TIMES, RECOVERY_TIMES)
        if kind == "3dtiles" and not dry_run:
            from g2ard.levels.tileset import check_tiles

            given = run.load(source)
            check_tiles(output, given, max(ratios), rule)
    how = tiling if tiled else None
    if dry_run or tiled:
        held = work_folder(run, None if dry_run else how, views)
    else:
        held = stoppable(run, stopped, resume, meta)
    noted = record_finish(run, meta) if tiled and not dry_run else nullcontext()
    options: Named = {"ratios": ratios, "recover": recover, "steps": steps, "background": colour}
    options |= {"split_sky": environment, "seed": run.seed, **run.callbacks}
    options |= {"views": views, "size": size, "up": up, "beside": scene, "memory": tiling.memory}
    with held, noted, open_levels(given, how, planned=dry_run, **options) as job:
        if dry_run:
            _tell_costs(run, job)
            return
        if not tiled:
            stopped.mkdir(parents=True, exist_ok=True)
        levels = job.run(tiling.folder / "steps" if tiled else stopped)
        begun = None  # folder for files of these levels that are begun
        if tiled:
            content = [[getattr(one, "key", one) for one in levels.splats], asdict(rule)]
            begun = tiling.folder / f"written-{key_of(content)}"
            begun.mkdir(exist_ok=True)
        run.begin("write")
        common: Named = {"cut": rule, "overwrite": run.overwrite, "work": begun, **run.callbacks}
        axis: Sequence[float] | None = up
        if kind == "sog":
            written = save_levels(output, levels.splats, environment=levels.sky, **common)
        else:
            axis = choose_tileset_up(levels.splats, up, run.say).tolist()
            stated = source.metres_per_unit or 0.0
            unit = unit or next(
                (name for name, metres in UNITS.items() if abs(metres - stated) < 1e-7), None
            )
            written = save_tileset(output, levels.splats, up=axis, place=spot, unit=unit, **common)
        run.note_written(output)
        frame = GivenViews(views, scene, axis)
        with run.showing("the page"):
            written += write_level_page(
                output, levels.splats, kind, frame, background=background, source=source
            )
            query = "" if kind == "sog" else "/?cesium=URL (a folder of CesiumJS)"
            run.say(
                f"page: python -m http.server --directory {output}, then http://localhost:8000{query}"
            )
        peak = {"peak_rss_bytes": peak_rss_of_all()} if tiled else {}
        run.say(f"{output}: {plural(len(levels.reports), 'level')}, {written / 1e6:.2f} MB")
        run.result({"output": str(output), "bytes": written, "levels": levels.reports, **peak})


def _tell_costs(run: Run, job: LevelsJob) -> None:
    """Print the rough memory of each level and of all."""
    from g2ard.cli.run_result import describe_memory, describe_steps

    levels = []
    for number, (ratio, count, size) in enumerate(job.plan()):
        if ratio == 1:
            continue
        cost = job.cost_of(count, size)
        steps = f", {describe_steps(cost)}" if job.job.recovers else ""
        run.answer(
            f"level {number}: {plural(count, 'Gaussian')}{steps}: roughly {describe_memory(cost)}"
        )
        levels.append({"level": number, "count": count, **asdict(cost)})
    most = max((one["bytes"] for one in levels), default=0)
    run.answer(f"all levels: roughly {most / 1e6:,.0f} MB")
    run.say_dry()
    run.result({"levels": levels, "total": {"bytes": most}})


def _parse_georeference(text: str) -> Georeference | str:
    """Return the place, or the name of the map system in which the scene's offset is the place."""
    from g2ard.levels import Georeference
    from g2ard.levels.tileset import map_system

    if text[:1].isalpha():
        map_system(text)  # known?
        return text
    return Georeference(*opt.numbers("--georeference", text, 4 if text.count(",") == 3 else 3))
