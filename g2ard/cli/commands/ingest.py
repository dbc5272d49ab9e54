"""`g2ard ingest`: a scene of any size → tiles."""

import time
from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.command import command
from g2ard.cli.outputs import refuse_file
from g2ard.cli.run import Run
from g2ard.progress import plural
from g2ard.system.peak_memory import peak_rss


@command(
    "ingest",
    example="g2ard ingest city.ply -o tiles/ --tile-rows 2M",
    settings="g2ard.stages.lift:LiftConfig",
    scenes=True,
    without=("seed",),
)
def ingest(
    run: Run,
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENE…", help="Scenes to join, or coloured point clouds to lift.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder for the tiles.")
    ],
    tile_rows: Annotated[
        Count | None,
        typer.Option(
            parser=Count.parse_absolute, metavar="COUNT", help="Maximum Gaussians per tile; 5M by default."
        ),
    ] = None,
) -> None:
    """Split a scene of any size into tiles."""
    from g2ard.stages.lift import LiftConfig
    from g2ard.tiles.ingest import TILE_ROWS
    from g2ard.tiles.ingest import ingest as into_tiles

    refuse_file(output, "tiles")
    run.claim("--output", output, folder=True)
    began = time.perf_counter()
    store = into_tiles(
        scenes,
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
