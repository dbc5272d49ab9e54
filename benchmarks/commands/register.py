"""`python -m benchmarks register`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.group import bench
from g2ard.cli.budget_options import parse_ratio
from g2ard.cli.frame import Run, command
from g2ard.cli.resume import rows_kept


@command(
    "register",
    parent=bench,
    example="python -m benchmarks register scene.ply --photos views/ --ratios 1,10 --starts B --seeds 1",
)
def register(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Maps to register against.")],
    photos: Annotated[
        Path,
        typer.Option(
            metavar="VIEWS", help="Photos with true poses: the test split is registered, train is the pool."
        ),
    ],
    ratios: Annotated[
        str, typer.Option(help="Comma-separated: merged to, not recovered; 1 is the scene as it is.")
    ] = "1,5,10,20,30",
    matchers: Annotated[
        str, typer.Option(help="Comma-separated: auto, sift, direct, MODULE:FUNCTION.")
    ] = "auto,direct",
    starts: Annotated[
        str,
        typer.Option(
            help="Comma-separated: A (1 % of the depth, .4°), B (5 %, 5°), C (15 %, 15°), D (pool only)."
        ),
    ] = "A,B,C,D",
    seeds: Annotated[int, typer.Option(min=1, help="Draws of each start.")] = 5,
    size: Annotated[int, typer.Option(min=32, help="Pixels of the photos' longer side.")] = 1000,
    metres_per_unit: Annotated[
        float | None, typer.Option("--metres-per-unit", min=1e-9, help="For centimetres and recalls.")
    ] = None,
    csv: Annotated[Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here.")] = Path(
        "bench_register.csv"
    ),
) -> None:
    """Poses of photos from known starts, against maps of any size; the starts' own errors stand beside."""
    from dataclasses import asdict

    from benchmarks.register import bench_register
    from benchmarks.simplify import machine
    from g2ard.io import check_output, read_view_set
    from g2ard.policy.register import photos_of
    from g2ard.stages.register import RegisterConfig

    check_output(csv, run.overwrite)
    names = [part.strip() for part in starts.split(",")]
    taken = photos_of(photos, split="test", say=run.say)
    with rows_kept(run, csv, goes_on=False):
        cells = bench_register(
            scenes,
            taken,
            csv,
            pool=read_view_set(photos, split="train", unpictured=True).cameras,
            ratios=[parse_ratio(part) for part in ratios.split(",")],
            matchers=[part.strip() for part in matchers.split(",")],
            starts=names,
            seeds=seeds,
            metres_per_unit=metres_per_unit,
            config=RegisterConfig(size=size),
            progress=run.progress,
        )
    unit = "units" if metres_per_unit is None else "cm"
    found = ["registered", f"{unit} / °", "worst", "≤ 10 cm", "≤ 5 cm"]
    run.console.table(
        f"{machine()}; medians of those registered, shares of all photos, the starts' beside",
        ["scene", "Gaussians", "MB", "matcher", "start", f"start's {unit} / °", "≤ 10 cm", *found, "s"],
        [
            [
                *(c.scene, f"{c.count:,}", f"{c.bytes / 1e6:.2f}", c.matcher, f"{c.start}{c.seed}"),
                *(f"{_said(c.start_position)} / {_said(c.start_rotation)}", _said(c.start_10, ".0%")),
                *(f"{c.registered} of {c.photos}", f"{_said(c.position)} / {_said(c.rotation)}"),
                *(_said(c.worst), _said(c.found_10, ".0%"), _said(c.found_5, ".0%"), f"{c.seconds:.1f}"),
            ]
            for c in cells
        ],
    )
    run.result({"machine": machine(), "rows": [asdict(cell) for cell in cells]})


def _said(value: float | None, form: str = ".3g") -> str:
    return "–" if value is None else format(value, form)
