"""Command `python -m benchmarks synth city`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.errors import InputError
from g2ard.progress import plural

__all__ = ["synth"]

synth = typer.Typer(help="Generate data.", no_args_is_help=True)


@synth.callback()
def _root() -> None:
    pass


def _numbers(flag: str, text: str, mark: str, count: int, kind: type) -> tuple[Any, ...]:
    """Parse `count` numbers of a type with `mark` between them."""
    try:
        (*values,) = map(kind, text.split(mark))
    except ValueError:
        values = []
    if len(values) != count:
        raise typer.BadParameter(
            f"{flag}: expected {count} numbers with {mark!r} between, got {text!r}"
        )
    return tuple(values)


@command(
    "city", parent=synth, example="python -m benchmarks synth city -o city/ --points 1M --views 120"
)
def city(
    run: Run,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder.")],
    points: Annotated[
        Count | None,
        typer.Option(
            parser=Count.parse_absolute,
            metavar="COUNT",
            help="Points of the cloud; 500k by default.",
        ),
    ] = None,
    views: Annotated[int, typer.Option(help="Photos in all four splits.")] = 120,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of photos.")] = "800x600",
    blocks: Annotated[int, typer.Option(help="City blocks per side.")] = 3,
    tile: Annotated[
        float | None,
        typer.Option(
            min=1, metavar="METRES", help="Write the cloud as .laz tiles of this side, in cloud/."
        ),
    ] = None,
    offset: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="World coordinates of the centre.")
    ] = "0,0,0",
) -> None:
    """Generate a city: coloured LiDAR point cloud, photos with exact poses, splits train/val/adapt/ood."""
    from benchmarks.synth import CityConfig, write_city

    began = time.monotonic()
    width, height = _numbers("--size", size, "x", 2, int)
    x, y, z = _numbers("--offset", offset, ",", 3, float)
    try:
        config = CityConfig(
            points=CityConfig.points if points is None else int(points.value),
            views=views,
            size=(width, height),
            blocks=blocks,
            seed=run.seed,
            offset=(x, y, z),
        )
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    how: dict[str, Any] = {
        "overwrite": run.overwrite,
        "threads": run.threads,
        "progress": run.progress,
    }
    manifest = write_city(output, config, tile=tile, **how)
    splits = ", ".join(f"{count} {name}" for name, count in manifest["views"].items())
    run.say(f"{output}: {plural(config.points, 'point')}, {splits} views of {width}×{height}")
    run.result({**manifest, "output": str(output), "seconds": time.monotonic() - began})


@command("rings", parent=synth, example="python -m benchmarks synth rings -o rings.ply")
def rings(
    run: Run,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CLOUD", help="Output .ply.")],
) -> None:
    """Generate a coloured point cloud: a room, scanned from two places by rings of lasers."""
    from benchmarks.synth.rings import ring_scan
    from g2ard.io import write_points

    points = ring_scan()
    write_points(output, points, overwrite=run.overwrite)
    run.say(f"{output}: {plural(len(points.positions), 'point')}")
    run.result({"points": len(points.positions), "output": str(output)})
