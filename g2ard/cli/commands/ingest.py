"""`g2ard ingest`: a scene of any size → tiles."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.budget_options import Count
from g2ard.cli.command import command
from g2ard.cli.outputs import refuse_file
from g2ard.cli.run import Run
from g2ard.progress import plural
from g2ard.system.peak_memory import peak_rss

if TYPE_CHECKING:
    from g2ard.io import Source


@command(
    "ingest",
    example="g2ard ingest city.ply -o tiles/ --tile-rows 2M",
    settings="g2ard.stages.lift:LiftConfig",
    scenes=True,
    points=True,
    without=("seed",),
)
def ingest(
    run: Run,
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENE…", help="Scenes to join, or coloured point clouds to lift.")
    ],
    *,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder for the tiles.")
    ],
    tile_rows: Annotated[
        Count | None,
        typer.Option(
            parser=Count.parse_absolute, metavar="COUNT", help="Maximum Gaussians per tile; 5M by default."
        ),
    ] = None,
    dry_run: opt.DryRunOption = False,
) -> None:
    """Split a scene of any size into tiles."""
    from g2ard.io import Source
    from g2ard.stages.lift import LiftConfig
    from g2ard.tiles.ingest import TILE_ROWS
    from g2ard.tiles.ingest import ingest as into_tiles

    source = Source(scenes[0], run.render_model, scenes[1:])
    opt.choose_points(run, source)
    if dry_run:
        _tell_plan(run, source, tile_rows)
        return
    refuse_file(output, "tiles")
    run.claim("--output", output, folder=True)
    began = time.perf_counter()
    store = into_tiles(
        source,
        output,
        tile_rows=TILE_ROWS if tile_rows is None else int(tile_rows.value),
        lift=run.settled(LiftConfig())[1],
        render_model=run.render_model,
        overwrite=run.overwrite,
        **run.callbacks,
    )
    seconds = time.perf_counter() - began
    run.kept.append(f"{output} is written")
    for note in store.notes:
        run.say(f"{scenes[0]}: {note}")
    halo = sum(tile.halo for tile in store.tiles)
    run.say(
        f"{output}: {store.count:,} Gaussians in {plural(len(store.tiles), 'tile')}, "
        f"{halo / store.count:.1%} more in halos, {store.nbytes / 1e9:,.2f} GB"
    )
    run.result(
        {
            "output": str(output),
            "key": store.key,
            "rows": store.count,
            "tiles": len(store.tiles),
            "halo_rows": halo,
            "margin": store.margin,
            "bytes": store.nbytes,
            "sh_degree": store.sh_degree,
            "render_model": store.render_model,
            "offset": store.offset,
            "notes": {note.code: note.count for note in store.notes},
            "seconds": seconds,
            "peak_rss": peak_rss(),
        }
    )


def _tell_plan(run: Run, source: Source, tile_rows: Count | None) -> None:
    """Print the number of tiles, and the rough memory and disk that writing them takes."""
    from g2ard.jobs.memory import plan_tiles
    from g2ard.jobs.tile_options import Tiling

    stream = source.cloud() if source.kind == "points" else source.scene
    plan = plan_tiles(stream, Tiling(None if tile_rows is None else int(tile_rows.value), workers=1))
    run.answer(
        f"{plan.count:,} rows in {plural(plan.tiles, 'tile')}: roughly {plan.bytes / 1e6:,.0f} MB, and "
        f"{plan.disk / 1e6:,.0f} MB of disk"
    )
    run.say_dry()
    run.result({"rows": plan.count, "tiles": plan.tiles, "bytes": plan.bytes, "disk": plan.disk})
