"""`g2ard bench`: run time against the machine's limits, and against error."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.frame import Run, command, group
from g2ard.cli.options import BackgroundOption, SceneArgument, SizeOption, TimeLimitOption, ViewsOption

if TYPE_CHECKING:
    from g2ard.bench.recover import Look
    from g2ard.bench.simplify import Cell

bench = group("bench", "Measure on this machine.\n\nExample: g2ard bench raster scene.ply --json -")


@command("raster", parent=bench, example="g2ard bench raster scene.ply --json -")
def raster(
    run: Run,
    scene: SceneArgument,
    views: ViewsOption = None,
    counts: Annotated[str, typer.Option(help="Gaussians drawn from the scene, comma-separated.")] = (
        "20k,100k,300k"
    ),
    every_isa: Annotated[
        bool, typer.Option("--every-isa", help="All instruction sets, not the best.")
    ] = False,
    repeats: Annotated[int, typer.Option(min=1, help="Steps timed; the fastest counts.")] = 15,
    size: SizeOption = None,
) -> None:
    """Milliseconds of a recovery step, pass by pass, and the share of the machine's measured limit."""
    from g2ard import _core
    from g2ard.bench.raster import bench_raster
    from g2ard.cli.options import Count
    from g2ard.cli.scenes import load_scene, load_views

    wanted = [Count.parse(part) for part in counts.split(",")]
    splats = load_scene(run, scene)
    found = bench_raster(
        splats,
        load_views(run, views, "all", size) if views else None,
        counts=[count.of(len(splats)) for count in wanted],
        isas=_core.instruction_sets() if every_isa else None,
        repeats=repeats,
        seed=run.seed,
        progress=run.progress,
    )
    passes = ("forward", "backward", "loss", "adam", "total")
    run.console.table(
        f"{found.machine['cpu']}: {found.machine['fma_gflops']:.0f} GFLOP/s, "
        f"{found.machine['read_gb_s']:.1f} GB/s measured; milliseconds",
        ["Gaussians", "size", "isa", "threads", *passes, "share of limit"],
        [
            [
                f"{row.count:,}",
                f"{row.width}×{row.height}",
                row.isa,
                str(row.threads),
                *(f"{row.ms[name]:.1f}" for name in passes),
                f"{row.limit_share:.2f}",
            ]
            for row in found.scenes
        ],
    )
    run.result(found.as_dict())


@command("simplify", parent=bench, example="g2ard bench simplify scene.ply --ratios 10 --csv figures.csv")
def simplify(
    run: Run,
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scenes to reduce.")],
    ratios: Annotated[str, typer.Option(help="Comma-separated.")] = "5,10,20,30",
    methods: Annotated[
        str | None,
        typer.Option(
            help="Some of default, no-views, fast, paper, splat-transform, splat-transform-adaptive, nanogs."
        ),
    ] = None,
    views: ViewsOption = None,
    csv: Annotated[
        Path, typer.Option("-o", "--csv", metavar="FILE", help="Rows go here; those there are not redone.")
    ] = Path("bench_simplify.csv"),
    splat_transform: Annotated[
        Path | None, typer.Option(metavar="PROGRAM", help="Where splat-transform is, if not on PATH.")
    ] = None,
) -> None:
    """Error on unseen views, CPU seconds and memory of every simplifier, each as a whole command.

    Scored are every 8th of 128 poses made for the scene, or the test split of --views; nothing a method used.
    """
    from g2ard.bench.simplify import METHODS, bench_simplify, find_splat_transform, machine
    from g2ard.cli.options import parse_ratio

    program = find_splat_transform(splat_transform)
    chosen = [m.strip() for m in methods.split(",")] if methods else list(METHODS)
    if program is None and any(m.startswith("splat-transform") for m in chosen):
        run.say("splat-transform is not on PATH (--splat-transform PROGRAM): left out")
        chosen = [m for m in chosen if not m.startswith("splat-transform")]
    cells = bench_simplify(
        scenes,
        csv,
        ratios=[parse_ratio(part) for part in ratios.split(",")],
        methods=chosen,
        views=views,
        splat_transform=program,
        seed=run.seed,
        progress=run.progress,
    )
    run.console.table(
        f"{machine()}; PSNR and SSIM on unseen views, CPU seconds and peak MB of the whole command",
        ["scene", "ratio", "method", "Gaussians", "PSNR", "SSIM", "CPU s", "wall s", "MB"],
        [_row(cell) for cell in cells],
    )
    run.result({"machine": machine(), "rows": [asdict(cell) for cell in cells]})


def _row(cell: Cell) -> list[str]:
    head = [cell.scene, f"{cell.ratio:g}", cell.method]
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


@command("recover", parent=bench, example="g2ard bench recover scene.ply --study curves --csv figures.csv")
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
        typer.Option(metavar="VIEWS", help="Score on these; --views is then all for recovery."),
    ] = None,
    photos: Annotated[
        bool | None,
        typer.Option("--photos/--renders", help="Targets; photos for a cloud, else the scene's renders."),
    ] = None,
    steps: Annotated[str, typer.Option(help="Horizons of the default schedule.")] = "100,300,1000",
    time_limit: TimeLimitOption = None,
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
    (--time-limit). multiplier: of the rates. endurance: 5,000 steps.
    """
    from g2ard.bench.recover import RecoverBench, bench_recover, speedups
    from g2ard.bench.simplify import machine
    from g2ard.cli.options import parse_ratio

    colour = background or (0.0, 0.0, 0.0)
    looks = bench_recover(
        RecoverBench(scene, views, held_out, photos, size, colour),
        study,
        csv,
        ratios=[parse_ratio(part) for part in ratios.split(",")],
        seeds=_whole_numbers("seeds", seeds),
        steps=_whole_numbers("steps", steps),
        seconds=time_limit or 30.0,
        variants=[part.strip() for part in variants.split(",")] if variants else None,
        progress=run.progress,
    )
    columns = ["scene", "ratio", "variant", "seed", "steps", "seconds", "CPU s", "PSNR", "SSIM"]
    run.console.table(
        f"{machine()}; unseen views at the end of each run",
        [*columns, "Drift95", "needles", "rank p1", "regularisers"],
        [_result(look) for look in looks if look.final],
    )
    faster = speedups(looks)
    if faster:
        run.console.table(
            "The default's seconds to the other's PSNR",
            ["scene", "ratio", "against", "PSNR", "seconds", "default's", "share"],
            [
                [
                    s.scene,
                    f"{s.ratio:g}",
                    s.against,
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
