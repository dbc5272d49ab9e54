"""`python -m benchmarks select`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.group import bench
from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    SizeOption,
)
from g2ard.cli.resume import rows_kept

Gains = dict[str, float | str]


@command("select", parent=bench, example="python -m benchmarks select scene.ply city --csv figures.csv")
def select(
    run: Run,
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENE...", help="Trained scenes, COLMAP folders with photos, or the word city."
        ),
    ],
    pools: Annotated[str, typer.Option(help="Some of biased, even.")] = "biased,even",
    arms: Annotated[
        str | None,
        typer.Option(help="Policies to compare; +weights draws by weight, pool is all candidates."),
    ] = None,
    percents: Annotated[str, typer.Option(help="K as shares of the pool, comma-separated.")] = "10,25,50",
    seeds: Annotated[int, typer.Option(min=1, help="Pools of each kind.")] = 3,
    draws: Annotated[int, typer.Option(min=1, help="Random subsets of each pool.")] = 3,
    steps: Annotated[int, typer.Option(min=1, help="Of each recovery.")] = 250,
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="Gaussians of the student.")] = 10_000,
    candidates: Annotated[int, typer.Option(min=8, help="Views of a pool; 420 in the city.")] = 160,
    size: SizeOption = 256,
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; those there are not redone.")
    ] = Path("bench_select.csv"),
    cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep rendered targets, for going on later.")
    ] = None,
) -> None:
    """What views chosen by each policy are worth: equal recovery, unseen views in and out of distribution."""
    from benchmarks.select import ARMS, bench_select, summary
    from benchmarks.select_workspaces import Size
    from benchmarks.simplify import machine

    with rows_kept(run, csv, goes_on=True):
        trials = bench_select(
            scenes,
            csv,
            pools=[p.strip() for p in pools.split(",")],
            arms=[a.strip() for a in arms.split(",")] if arms else ARMS,
            percents=[_percent(p) for p in percents.split(",")],
            seeds=seeds,
            draws=draws,
            steps=steps,
            size=Size(count, size or 256, candidates),
            cache=cache,
            progress=run.progress,
        )
    gains = summary(trials)
    run.console.table(
        f"{machine()}; dB over mean random (random: PSNR), ± over pools; in and out of distribution",
        ["scene", "pool", "K %", "arm", "in", "±", "out", "±"],
        [_gain(row) for row in gains],
    )
    run.result({"machine": machine(), "gains": gains, "rows": [asdict(trial) for trial in trials]})


def _percent(text: str) -> float:
    try:
        value = float(text.strip().rstrip("%"))
    except ValueError:
        value = 0.0
    if not 0 < value <= 100:
        raise typer.BadParameter(f"shares between 0 and 100, not {text!r}")
    return value


def _gain(row: Gains) -> list[str]:
    figures = [f"{row[key]:.2f}" for key in ("in", "noise_in", "out", "noise_out")]
    return [str(row["scene"]), str(row["pool"]), f"{row['percent']:g}", str(row["arm"]), *figures]
