"""Command `python -m benchmarks synth city`."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.frame import Run, command
from g2ard.cli.options import Triple
from g2ard.progress import plural

__all__ = ["synth"]

synth = typer.Typer(help="Generate data.", no_args_is_help=True)


@synth.callback()
def _root() -> None:
    pass


class _Size(tuple[int, int]):
    """Width and height in one argument."""

    def __str__(self) -> str:
        return f"{self[0]}x{self[1]}"


def _size(text: str) -> _Size:
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip())
    if match is None or not (int(match[1]) and int(match[2])):
        raise typer.BadParameter(f"expected a size such as 800x600, got {text!r}")
    return _Size((int(match[1]), int(match[2])))


def _offset(text: str) -> Triple:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"expected three numbers such as 443000,4428000,1600, got {text!r}"
        ) from None
    return Triple((x, y, z))


@command("city", parent=synth, example="python -m benchmarks synth city -o city/ --points 1M --views 120")
def city(
    run: Run,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder.")],
    points: Annotated[
        Count | None,
        typer.Option(parser=Count.parse, metavar="COUNT", help="Points of the cloud; 500k by default."),
    ] = None,
    views: Annotated[int, typer.Option(min=8, help="Photos in all four splits.")] = 120,
    size: Annotated[
        _Size | None,
        typer.Option(parser=_size, metavar="WxH", help="Size of photos; 800x600 by default."),
    ] = None,
    blocks: Annotated[
        int | None,
        typer.Option(min=1, max=40, help="City blocks per side; 3 by default."),
    ] = None,
    offset: Annotated[
        Triple | None,
        typer.Option(parser=_offset, metavar="X,Y,Z", help="World coordinates of the centre."),
    ] = None,
) -> None:
    """Generate a city: coloured LiDAR point cloud, photos with exact poses, splits train/val/adapt/ood."""
    from benchmarks.synth import CityConfig, write_city

    if points is not None and points.is_share:
        raise typer.BadParameter("--points: expected a count, got a share")
    began = time.monotonic()
    default = CityConfig()
    count = default.points if points is None else points.of(0)
    config = CityConfig(
        points=count,
        views=views,
        size=size or default.size,
        blocks=blocks or default.blocks,
        seed=run.seed,
        offset=offset or default.offset,
    )
    manifest = write_city(output, config, overwrite=run.overwrite, threads=run.threads, progress=run.progress)
    splits = ", ".join(f"{count} {name}" for name, count in manifest["views"].items())
    pixels = f"{config.size[0]}×{config.size[1]}"
    run.say(f"{output}: {plural(config.points, 'point')}, {splits} views of {pixels}")
    run.result({**manifest, "output": str(output), "seconds": time.monotonic() - began})
