"""`python -m benchmarks ship`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.group import bench
from g2ard.cli.budget_options import parse_ratio
from g2ard.cli.frame import Run, command
from g2ard.cli.resume import rows_kept


@command("ship", parent=bench, example="python -m benchmarks ship scene.ply --ratios 1,10 --formats sog,spz")
def ship(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scenes to write.")],
    ratios: Annotated[str, typer.Option(help="Comma-separated; 1 is the scene as it is.")] = "1,10",
    formats: Annotated[
        str, typer.Option(help="Comma-separated: ply, compressed.ply, sog, spz, glb, splat.")
    ] = "ply,compressed.ply,sog,spz,splat",
    csv: Annotated[Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here.")] = Path(
        "bench_ship.csv"
    ),
    splat_transform: Annotated[
        Path | None, typer.Option(metavar="PROGRAM", help="Its SOG is scored beside, if given.")
    ] = None,
) -> None:
    """Megabytes against decibels on unseen views, for every format and ratio."""
    from dataclasses import asdict

    from benchmarks.ship import bench_ship
    from benchmarks.simplify import find_splat_transform, machine
    from g2ard.io import check_output

    check_output(csv, run.overwrite)
    with rows_kept(run, csv, goes_on=False):
        cells = bench_ship(
            scenes,
            csv,
            ratios=[parse_ratio(part) for part in ratios.split(",")],
            formats=[part.strip() for part in formats.split(",")],
            splat_transform=find_splat_transform(splat_transform) if splat_transform else None,
            seed=run.seed,
            progress=run.progress,
        )
    run.console.table(
        f"{machine()}; against the dense scene; `lost` is what the format alone takes",
        [
            "scene",
            "ratio",
            "format",
            "views",
            "Gaussians",
            "MB",
            "bytes each",
            "PSNR",
            "lost",
            "SSIM",
            "CPU s",
        ],
        [
            [c.scene, f"{c.ratio:g}", c.format, c.views_kind]
            + (
                [c.error]
                if c.error
                else [
                    f"{c.count:,}",
                    f"{c.bytes / 1e6:.2f}",
                    f"{c.bytes / c.count:.1f}",
                    f"{c.psnr:.2f}",
                    f"{c.lost:.2f}",
                    f"{c.ssim:.4f}",
                    f"{c.cpu_s:.1f}",
                ]
            )
            for c in cells
        ],
    )
    run.result({"machine": machine(), "rows": [asdict(cell) for cell in cells]})
