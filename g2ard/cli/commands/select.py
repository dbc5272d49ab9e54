"""`g2ard select`."""

from __future__ import annotations

from typing import Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    Count,
    OutputOption,
    PolicyOption,
    SceneArgument,
    ViewsOption,
    can_judge,
    views_count,
)


@command("select", example="g2ard select scene.ply --views poses.json -k 100 -o chosen.json")
def select(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    k: Annotated[
        Count,
        typer.Option(
            "-k", parser=views_count, metavar="K", help="How many: 100, 25%, or auto (where the curve bends)."
        ),
    ],
    views: ViewsOption = None,
    policy: PolicyOption = "auto",
    cells: Annotated[int, typer.Option(min=1, help="Surface cells, of directional and coverage.")] = 300_000,
) -> None:
    """Choose the views worth having, best first, with a weight for how often to draw each."""
    from g2ard.cli.scenes import load_scene, load_views
    from g2ard.io import check_views_output, write_views
    from g2ard.select import CoverageOptions
    from g2ard.select import select as choose

    if views is None:
        raise typer.BadParameter("--views VIEWS: the candidates to select from")
    can_judge(k, policy)
    check_views_output(output, run.overwrite)
    splats = load_scene(run, scene)
    cameras = load_views(run, views, "all", None)
    chosen = choose(
        splats,
        cameras,
        k.of(len(cameras)) if isinstance(k, Count) else "auto",
        policy=policy,
        seed=run.seed,
        options=CoverageOptions(cells=cells),
        progress=run.progress,
    )
    kept = cameras.take(chosen.order)
    write_views(output, kept, weights=chosen.weights, overwrite=run.overwrite)
    if len(chosen.refused):
        run.say(f"{len(chosen.refused)} views refused: they see nothing of the scene, or stand within it")
    run.say(
        f"{output}: {len(kept)} of {len(cameras)} views by {policy};"
        f" those left out would add {100 * chosen.left_out:.1f} %"
    )
    run.result(
        {
            "policy": policy,
            "views": [
                {"name": name, "gain": gain, "weight": weight}
                for name, gain, weight in zip(
                    kept.names, chosen.gains.tolist(), chosen.weights.tolist(), strict=True
                )
            ],
            "left_out": chosen.left_out,
            "curve": chosen.curve.tolist(),
            "refused": [cameras.names[i] for i in chosen.refused],
            "evaluations": chosen.evaluations,
            "seconds": chosen.seconds,
        }
    )
