"""`python -m benchmarks raster`."""

from __future__ import annotations

from typing import Annotated

import typer

from benchmarks.commands.group import bench
from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    SceneArgument,
    SizeOption,
    ViewsOption,
)


@command("raster", parent=bench, example="python -m benchmarks raster scene.ply --json -")
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
    from benchmarks.raster import bench_raster
    from g2ard import _core
    from g2ard.cli.budget_options import Count
    from g2ard.policy.inputs import load_scene, load_views

    wanted = [Count.parse(part) for part in counts.split(",")]
    splats = load_scene(scene, run.say)
    found = bench_raster(
        splats,
        load_views(views, "all", size, run.say) if views else None,
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
