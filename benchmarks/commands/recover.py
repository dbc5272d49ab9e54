"""`python -m benchmarks recover`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.commands.group import bench
from g2ard.cli.budget_options import parse_ratio
from g2ard.cli.frame import Run, command
from g2ard.cli.options import BackgroundOption, ProtocolOption, RecoveryTimeOption, SizeOption, ViewsOption
from g2ard.cli.resume import rows_kept

if TYPE_CHECKING:
    from benchmarks.recover import Look


@command(
    "recover", parent=bench, example="python -m benchmarks recover scene.ply --study curves --csv figures.csv"
)
def recover(
    run: Run,
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE|CLOUD", help="A trained scene, or a coloured cloud.")
    ],
    study: Annotated[
        str,
        typer.Option(help="curves, regularizers, rounds, multiplier, endurance or paper."),
    ] = "curves",
    ratios: Annotated[str, typer.Option(help="Comma-separated.")] = "10",
    views: ViewsOption = None,
    held_out: Annotated[
        Path | None,
        typer.Option(
            metavar="VIEWS",
            help="Score on these; --views is then for recovery, but for what it holds out itself.",
        ),
    ] = None,
    photos: Annotated[
        bool | None,
        typer.Option("--photos/--renders", help="Targets; photos for a cloud, else the scene's renders."),
    ] = None,
    steps: Annotated[str, typer.Option(help="Horizons of the default schedule.")] = "100,300,1000",
    protocol: ProtocolOption = "pool",
    recovery_time: RecoveryTimeOption = None,
    seeds: Annotated[str, typer.Option(help="Comma-separated.")] = "0",
    variants: Annotated[str | None, typer.Option(help="Some of the study's; all if not given.")] = None,
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; whole runs are not redone.")
    ] = Path("bench_recover.csv"),
    size: SizeOption = None,
    background: BackgroundOption = None,
) -> None:
    """Recovery on unseen views against seconds.

    curves: the default's horizons beside the paper's schedule at a tenth, with and without a decay.
    paper: beside all of it. regularizers: with and without each. rounds: against one shot in equal time
    (--recovery-time). multiplier: of the rates. endurance: 5,000 steps.

    With --protocol standing runs are scored from near and from where people stand: on the views of a
    standing.json beside the scene, else on made ones that no run sees.
    """
    from benchmarks.recover import RecoverBench, bench_recover
    from benchmarks.simplify import machine
    from benchmarks.speedup import speedups

    colour = background or (0.0, 0.0, 0.0)
    with rows_kept(run, csv, goes_on=True):
        looks = bench_recover(
            RecoverBench(scene, views, held_out, photos, size, colour, protocol=protocol),
            study,
            csv,
            ratios=[parse_ratio(part) for part in ratios.split(",")],
            seeds=_whole_numbers("seeds", seeds),
            steps=_whole_numbers("steps", steps),
            seconds=recovery_time or 30.0,
            variants=[part.strip() for part in variants.split(",")] if variants else None,
            progress=run.progress,
        )
    columns = ["scene", "ratio", "variant", "views", "seed", "steps", "seconds", "CPU s", "PSNR", "SSIM"]
    run.console.table(
        f"{machine()}; unseen views at the end of each run",
        [*columns, "Drift95", "needles", "rank p1", "regularisers"],
        [_result(look) for look in looks if look.final],
    )
    faster = speedups(looks)
    if faster:
        run.console.table(
            "The default's seconds to the other's PSNR",
            ["scene", "ratio", "against", "views", "PSNR", "seconds", "default's", "share"],
            [
                [
                    s.scene,
                    f"{s.ratio:g}",
                    s.against,
                    s.views_kind,
                    f"{s.psnr:.2f}",
                    f"{s.seconds:.1f}",
                    "never" if s.reached_s is None else f"{s.reached_s:.1f}",
                    "–" if s.share is None else f"{s.share:.3f}",
                ]
                for s in faster
            ],
        )
    run.result(
        {
            "machine": machine(),
            "rows": [asdict(look) for look in looks],
            "speedups": [{**asdict(s), "share": s.share} for s in faster],
        }
    )


def _whole_numbers(name: str, text: str) -> list[int]:
    try:
        values = [int(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or min(values) < 0:
        raise typer.BadParameter(f"--{name}: whole numbers such as 1,2,3, not {text!r}")
    return values


def _result(look: Look) -> list[str]:
    assert look.drift95 is not None
    assert look.reg_share is not None
    return [
        look.scene,
        f"{look.ratio:g}",
        look.variant,
        look.views_kind,
        str(look.seed),
        str(look.step),
        f"{look.seconds:.1f}",
        f"{look.cpu_s:.1f}",
        f"{look.psnr:.2f}",
        f"{look.ssim:.4f}",
        f"{look.drift95:.2f}",
        f"{look.needle:.3%}",
        f"{look.rank_p1:.3f}",
        f"{look.reg_share:.2%}",
    ]
