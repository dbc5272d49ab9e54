"""`python -m benchmarks simplify`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.commands.group import bench
from benchmarks.methods import REDUCERS
from g2ard.cli.budget_options import parse_ratio
from g2ard.cli.frame import Run, command
from g2ard.cli.options import ProtocolOption, ViewsOption
from g2ard.cli.resume import rows_kept

if TYPE_CHECKING:
    from benchmarks.simplify import Cell


@command(
    "simplify", parent=bench, example="python -m benchmarks simplify scene.ply --ratios 10 --csv figures.csv"
)
def simplify(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scenes to reduce.")],
    ratios: Annotated[str, typer.Option(help="Comma-separated.")] = "5,10,20,30",
    methods: Annotated[
        str | None,
        typer.Option(help=f"Some of {', '.join(REDUCERS)}."),
    ] = None,
    views: ViewsOption = None,
    protocol: ProtocolOption = "pool",
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; those there are not redone.")
    ] = Path("bench_simplify.csv"),
    splat_transform: Annotated[
        Path | None, typer.Option(metavar="PROGRAM", help="Where splat-transform is, if not on PATH.")
    ] = None,
) -> None:
    """Error on unseen views, CPU seconds and memory of every simplifier, each as a whole command.

    Scored are every 8th of 128 poses made for the scene, or the test split of --views; nothing a method used.
    With --protocol standing every method runs as its user runs it, and is scored from near and from where
    people stand: on the views of a standing.json beside the scene, else on made ones that no method sees.
    """
    from benchmarks.simplify import bench_simplify, find_splat_transform, machine

    program = find_splat_transform(splat_transform)
    chosen = [m.strip() for m in methods.split(",")] if methods else list(REDUCERS)
    if program is None and any(m.startswith("splat-transform") for m in chosen):
        run.say("splat-transform is not on PATH (--splat-transform PROGRAM): left out")
        chosen = [m for m in chosen if not m.startswith("splat-transform")]
    with rows_kept(run, csv, goes_on=True):
        cells = bench_simplify(
            scenes,
            csv,
            ratios=[parse_ratio(part) for part in ratios.split(",")],
            methods=chosen,
            views=views,
            splat_transform=program,
            seed=run.seed,
            protocol=protocol,
            progress=run.progress,
        )
    run.console.table(
        f"{machine()}; PSNR and SSIM on unseen views, CPU seconds and peak MB of the whole command",
        ["scene", "ratio", "method", "views", "Gaussians", "PSNR", "SSIM", "CPU s", "wall s", "MB"],
        [_row(cell) for cell in cells],
    )
    run.result({"machine": machine(), "rows": [asdict(cell) for cell in cells]})


def _row(cell: Cell) -> list[str]:
    head = [cell.scene, f"{cell.ratio:g}", cell.method, cell.views_kind]
    if cell.error:
        return [*head, cell.error, *[""] * 5]
    return [
        *head,
        f"{cell.count:,}",
        f"{cell.psnr:.2f}",
        f"{cell.ssim:.4f}",
        f"{cell.cpu_s:.1f}",
        f"{cell.wall_s:.1f}",
        f"{cell.peak_mb:.0f}",
    ]
