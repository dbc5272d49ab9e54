"""`g2ard poses`: scene → generated views."""

from typing import Annotated

import typer

from g2ard.cli.command import command
from g2ard.cli.options import OutputOption, SceneArgument, ShapeOption, UpOption, ViewFormatOption
from g2ard.cli.run import Run
from g2ard.config.choices import PoolKind
from g2ard.progress import direction, plural

_LEAST_REPORTED_SHARE = 0.005
"""Share of the scene too small to report."""


@command("poses", example="g2ard poses scene.ply -k 128 -o poses.json", scenes=True)
def poses(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    format: ViewFormatOption = None,
    kind: Annotated[
        PoolKind,
        typer.Option(
            help="Orbit the scene, walk through it, look from above, from inside, or at its sharpest part."
        ),
    ] = "auto",
    looks: Annotated[int, typer.Option("-k", min=1, metavar="K", help="Views to generate.")] = 128,
    size: ShapeOption = None,
    fov: Annotated[
        float | None,
        typer.Option(
            min=1,
            max=170,
            help="Horizontal field of view, degrees; by default 50, and 70 in rooms.",
        ),
    ] = None,
    up: UpOption = None,
) -> None:
    """Generate views for a scene: poses in free space that see it well."""
    from g2ard.io.splits import splits_of
    from g2ard.poses import plan_pool

    run.claim_views(output, format)
    width = 800
    height = 600
    if size is not None:
        width = size[0]
        height = size[1] if len(size) > 1 else max(1, round(0.75 * width))
    splats = run.load(scene)
    pool = plan_pool(
        splats,
        looks,
        kind=kind,
        size=(width, height),
        fov=fov,
        up=up,
        seed=run.seed,
        progress=run.progress,
    )
    splits = splits_of(None, pool.cameras.names)
    run.write_views(output, pool.cameras, format, splits)
    run.say(
        f"{output}: {plural(looks, 'pose')}, {pool.kind} ({pool.why}; up is {direction(pool.up)})"
    )
    shares = (("is in no view", pool.unseen), ("is smaller than a pixel in all views", pool.coarse))
    if told := [
        f"{share:.0%} of the scene {what}"
        for what, share in shares
        if share > _LEAST_REPORTED_SHARE
    ]:
        run.say("; ".join(told))
    run.result(
        {
            "count": looks,
            "kind": pool.kind,
            "why": pool.why,
            "up": pool.up.tolist(),
            "unseen": pool.unseen,
            "coarse": pool.coarse,
        }
    )
