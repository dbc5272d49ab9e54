"""`g2ard lod`: a scene → levels of detail as streamed SOG or 3D Tiles."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from g2ard.cli import options as opt
from g2ard.cli.budget_options import Ratios
from g2ard.cli.frame import Run, command
from g2ard.cli.tile_options import tiling_of
from g2ard.cli.usage import in_flags
from g2ard.config.choices import BLACK
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.levels import Levels
    from g2ard.jobs.tiled import TiledLevels
    from g2ard.jobs.tiling import Tiling
    from g2ard.levels import Cut
    from g2ard.levels.tree import Level
    from g2ard.scene.splats import Splats


@command("lod", example="g2ard lod scene.ply -r 1,2,4,8,16 -o streamed/", scenes=True, tiles=True)
def lod(
    run: Run,
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE", help="A trained scene of any format, or a folder of tiles (`g2ard ingest`)."
        ),
    ],
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
        bool, typer.Option("--recover/--merge-only", help="Recover each level after merging, or only merge.")
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
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps per level; by default until it converges.")
    ] = None,
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
    resume: opt.ResumeOption = False,
) -> None:
    """Write levels of detail as streamed SOG or 3D Tiles.

    Each level is merged from the one before, then recovered.
    Scenes larger than memory and folders of tiles are processed tile by tile.
    """
    from g2ard.cli.resume import check_stopped, left_at, stoppable
    from g2ard.cli.run_folder import check_same_options, note_options
    from g2ard.errors import InputError
    from g2ard.io import kind as kind_of
    from g2ard.io.atomic import check_output
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.jobs.levels import check_ratios, recovery_settings
    from g2ard.jobs.levels import lod as levels_of
    from g2ard.jobs.tiled import working
    from g2ard.jobs.tiling import LEVELS_TIMES, RECOVERY_TIMES, check_memory, is_tiled
    from g2ard.levels import Cut

    if kind_of(scene) == "points":
        raise typer.BadParameter(
            "a point cloud cannot render training images; distil it first, then run `lod` on the result"
        )
    try:
        check_ratios(ratios)
        rule = Cut(most * 1024, extent, least * 1024)
        spot = None if place is None else _georeference(place)
    except InputError as error:
        raise typer.BadParameter(in_flags(error, run.flags)) from None
    views = opt.with_images(views, images)
    if spot is not None and kind == "sog":
        raise typer.BadParameter("--georeference needs --format 3dtiles")
    if environment and kind != "sog":
        raise typer.BadParameter("--environment needs --format sog")
    meta = output / ("lod-meta.json" if kind == "sog" else "tileset.json")
    stopped = output.with_name(f".{output.name}.unfinished")
    run.spare_inputs(meta)
    tiling = tiling_of(run, scene, output)
    tiled = is_tiled(scene, tiling)
    if environment and tiled:
        raise typer.BadParameter("--environment needs a scene that fits into memory")
    finished = resume and meta.exists() and not run.overwrite and (tiled or not left_at(stopped))
    if finished:
        _check_same(meta, ratios)
    else:
        check_output(output, run.overwrite, folder=True)
    going_on = (finished or not tiled) and check_stopped(run, stopped, resume, meta)
    if tiled:
        options = DistillOptions(
            views=views,
            size=size,
            up=up,
            render_model=run.render_model,
            settings=recovery_settings(steps, background or BLACK, run.seed),
        )
        with working(tiling, views):
            _in_tiles(run, scene, output, ratios, tiling, options, recover, rule, kind, spot)
        return
    check_memory(scene, tiling, LEVELS_TIMES, RECOVERY_TIMES)
    if going_on:
        check_same_options(run, stopped, besides=("most", "extent", "least", "kind", "place"))
    with stoppable(run, stopped, resume):
        note_options(run, stopped)
        levels = levels_of(
            scene,
            ratios=ratios,
            recover=recover,
            views=views,
            steps=steps,
            size=size,
            background=background or BLACK,
            up=up,
            render_model=run.render_model,
            split_sky=environment,
            seed=run.seed,
            work=stopped,
            progress=run.progress,
            say=run.say,
        )
        size_of_all = _save(run, output, levels.splats, rule, kind, spot, up, sky=levels.sky)
    _tell(run, output, levels, size_of_all)


def _in_tiles(
    run: Run,
    scene: Path,
    output: Path,
    ratios: Sequence[float],
    tiling: Tiling,
    options: DistillOptions,
    recover: bool,
    rule: Cut,
    kind: str,
    spot: Any,
) -> None:
    """Write levels tile by tile; finished steps stay in the tiling's folder until the command succeeds."""
    from g2ard.jobs.tiled import lod_in_tiles
    from g2ard.system.memory import peak_rss_of_all

    assert tiling.folder is not None
    run.kept = [f"finished steps are in {tiling.folder}; run the same command to continue"]
    levels = lod_in_tiles(scene, ratios, tiling, options, recover=recover, progress=run.progress, say=run.say)
    begun = tiling.folder / f"written-{levels.key(rule)}"
    begun.mkdir(exist_ok=True)
    size = _save(run, output, levels.scenes, rule, kind, spot, options.up, begun)
    _tell(run, output, levels, size, peak_rss_bytes=peak_rss_of_all())


def _save(
    run: Run,
    output: Path,
    levels: Sequence[Level],
    rule: Cut,
    kind: str,
    spot: Any,
    up: Sequence[float] | None,
    work: Path | None = None,
    sky: Splats | None = None,
) -> int:
    """Write the output folder and return its bytes."""
    from g2ard.jobs.levels import tileset_up
    from g2ard.levels import Georeference, save_levels, save_tileset

    common: dict[str, Any] = {
        "cut": rule,
        "overwrite": run.overwrite,
        "work": work,
        "progress": run.progress,
    }
    if kind == "sog":
        return save_levels(output, levels, environment=sky, **common)
    if spot is not None and not isinstance(spot, Georeference):
        spot = Georeference.of_map(spot, levels[0].offset)
        run.say(f"longitude {spot.longitude:.6f}, latitude {spot.latitude:.6f}, heading {spot.heading:.3f}")
    axis = tileset_up(levels, up)
    rounded = ", ".join(f"{round(value, 3) + 0.0:g}" for value in axis)
    run.say(f"up is {rounded}" + ("" if up else "; --up X,Y,Z changes it"))
    return save_tileset(output, levels, up=axis, place=spot, **common)


def _georeference(text: str) -> Any:
    """Return the place, or the map system in which the scene's offset is the place."""
    from g2ard.cli.options import numbers
    from g2ard.levels import Georeference
    from g2ard.levels.tileset import map_system

    if text[:1].isalpha():
        return map_system(text)
    return Georeference(*numbers("--georeference", text, 4 if text.count(",") == 3 else 3))


def _check_same(meta: Path, ratios: Sequence[float]) -> None:
    """Raise an error if a finished folder holds levels of other ratios."""
    from g2ard.errors import OutputError

    content = json.loads(meta.read_text(encoding="utf-8"))
    counts = {**content.get("extras", {}), **content}.get("counts") or [0]
    wanted = [counts[0] * ratios[0] / ratio for ratio in ratios]
    if len(counts) != len(wanted) or any(abs(c - w) > ratios[0] for c, w in zip(counts, wanted, strict=True)):
        levels = ", ".join(f"{count:,}" for count in counts)
        raise OutputError(
            f"was written with another -r (levels of {levels} Gaussians); -w replaces it", path=meta
        )


def _tell(run: Run, output: Path, levels: Levels | TiledLevels, size: int, **more: Any) -> None:
    for number, report in enumerate(levels.reports):
        figures = [
            f"{psnr:.2f} dB {what}"
            for what, psnr in (("merged", report.simplified), ("recovered", report.recovered))
            if psnr is not None
        ]
        told = f" ({', '.join(figures)}, in held-out views of {report.size} pixels)" if figures else ""
        run.say(f"level {number}: {plural(report.count, 'Gaussian')}{told}")
    run.say(f"{output}: {plural(len(levels.reports), 'level')}, {size / 1e6:.2f} MB")
    result: dict[str, Any] = {"output": str(output), "bytes": size}
    run.result({**result, "levels": [report.as_dict() for report in levels.reports], **more})
