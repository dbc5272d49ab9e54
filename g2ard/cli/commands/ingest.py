"""`g2ard ingest`: a scene of any size → tiles."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.outputs import refuse_file
from g2ard.cli.run import Run
from g2ard.cli.work_folder import read_tiling
from g2ard.progress import plural
from g2ard.system.peak_memory import peak_rss_of_all

if TYPE_CHECKING:
    from g2ard.jobs.memory import TilePlan

_FEW_ROWS = 500_000
"""Rows below which processes take longer to start than they save."""


@command(
    "ingest",
    example="g2ard ingest city.ply -o tiles/ --tile-rows 2M",
    settings="g2ard.stages.lift:LiftConfig",
    scenes=True,
    points=True,
    tiles=True,
    without=("seed", "work"),
)
def ingest(
    run: Run,
    scenes: Annotated[
        list[Path],
        typer.Argument(metavar="SCENE…", help="Scenes to join, or coloured point clouds to lift."),
    ],
    *,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder for the tiles.")
    ],
    dry_run: opt.DryRunOption = False,
) -> None:
    """Split a scene of any size into tiles."""
    from g2ard.io import Source
    from g2ard.jobs.memory import WRITING_TIMES, plan_tiles
    from g2ard.stages.lift import LiftConfig
    from g2ard.tiles.executor import executor
    from g2ard.tiles.ingest import ingest as into_tiles

    if not dry_run:
        refuse_file(output, "tiles")
    source = Source(scenes[0], run.render_model, scenes[1:])
    opt.choose_points(run, source)
    tiling = read_tiling(run, None, output)
    stream = source.cloud() if source.kind == "points" else source.scene
    if tiling.workers is None and tiling.scheduler is None and stream.count < _FEW_ROWS:
        tiling = replace(tiling, workers=1)
    plan = plan_tiles(stream, tiling, WRITING_TIMES)
    if dry_run:
        _tell_plan(run, plan)
        return
    run.claim("--output", output, folder=True)
    began = time.perf_counter()
    with executor(
        plan.workers, max(1, tiling.usable_cores // plan.workers), tiling.scheduler
    ) as runs:
        store = into_tiles(
            source,
            output,
            tile_rows=tiling.most_rows,
            lift=run.settle(LiftConfig())[1],
            render_model=run.render_model,
            overwrite=run.overwrite,
            runs=runs,
            **run.callbacks,
        )
    seconds = time.perf_counter() - began
    run.note_written(output)
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
            "peak_rss": peak_rss_of_all(),
        }
    )


def _tell_plan(run: Run, plan: TilePlan) -> None:
    """Print the number of tiles, and the rough memory and disk that writing them takes."""
    run.answer(
        f"{plan.count:,} rows in {plural(plan.tiles, 'tile')}, {plan.workers} at a time: roughly "
        f"{plan.bytes / 1e6:,.0f} MB, and {plan.disk / 1e6:,.0f} MB of disk"
    )
    run.say_dry()
    run.result(
        {
            "rows": plan.count,
            "tiles": plan.tiles,
            "workers": plan.workers,
            "bytes": plan.bytes,
            "disk": plan.disk,
        }
    )
