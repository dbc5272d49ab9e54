"""`g2ard lift`: coloured point cloud → Gaussians."""

import time
from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli.command import command
from g2ard.cli.options import OutputOption, choose_points
from g2ard.cli.run import Run
from g2ard.cli.run_result import say_weight
from g2ard.io import Source
from g2ard.io.detect import suffixes
from g2ard.progress import plural


@command("lift", example="g2ard lift stadium.laz -o prior.ply", points=True, without=("seed",))
def lift(
    run: Run,
    cloud: Annotated[
        Path,
        typer.Argument(metavar="CLOUD", help=f"Coloured points: {suffixes('points')} or COLMAP."),
    ],
    output: OutputOption,
    neighbors: Annotated[
        int, typer.Option(help="Nearest points to fit each disc's plane to.")
    ] = 10,
    spread: Annotated[
        float,
        typer.Option(
            help="Width of a disc relative to the standard deviation of its nearest points."
        ),
    ] = 0.94,
    normal_ratio: Annotated[
        float, typer.Option(help="Thickness of a disc relative to its width.")
    ] = 0.1,
    max_anisotropy: Annotated[
        float, typer.Option(help="Largest ratio of a disc's two widths.")
    ] = 4.0,
    opacity: Annotated[float, typer.Option(help="Opacity of every disc, between 0 and 1.")] = 0.5,
) -> None:
    """Turn a coloured point cloud into surface-aligned Gaussian discs, without training."""
    from g2ard.jobs.inputs import find_axes
    from g2ard.stages.lift import isolated
    from g2ard.stages.lift import lift as lift_points

    run.claim_scene("--output", output)
    began = time.perf_counter()
    run.begin("read")
    source = Source(cloud)
    choose_points(run, source)
    found = source.cloud().whole()
    for note in found.notes:
        run.say(f"{cloud}: {note}")
    read = time.perf_counter()
    splats = lift_points(
        found.points.positions,
        found.points.colors,
        neighbors=neighbors,
        spread=spread,
        normal_ratio=normal_ratio,
        max_anisotropy=max_anisotropy,
        opacity=opacity,
        axes=find_axes(found, str(cloud), run.say, run.progress),
        progress=run.progress,
    )
    lifted = time.perf_counter()
    if strays := isolated(splats):
        run.say(f"{cloud}: {strays}")
    run.write(output, splats)
    written = time.perf_counter()
    say_weight(run, cloud, output, splats)
    discs = plural(len(splats), "disc")
    points = plural(len(found.points), "point")
    run.say(f"{output}: {discs} from {points} in {written - began:.1f} s")
    run.result(
        {
            "input_count": len(found.points),
            "output_count": len(splats),
            "notes": {note.code: note.count for note in found.notes},
            "seconds": {
                "read": read - began,
                "lift": lifted - read,
                "write": written - lifted,
                "total": written - began,
            },
        }
    )
