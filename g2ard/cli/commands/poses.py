"""`g2ard poses`: scene → cameras to look at it from."""

from __future__ import annotations

import re
from typing import Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import OutputOption, SceneArgument, UpOption
from g2ard.config.choices import PoolKind
from g2ard.progress import plural

_FEW = 0.005
"""Share of the scene that rounds to nothing."""


class _Size(tuple[int, int]):
    """Width and height in one argument (see `g2ard.cli.options.Triple`)."""

    def __str__(self) -> str:
        return f"{self[0]}x{self[1]}"


def _size(text: str) -> _Size:
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip())
    if match is None or not all(16 <= int(side) <= 16384 for side in match.groups()):
        raise typer.BadParameter(f"width x height in pixels from 16 to 16384, such as 800x600, not {text!r}")
    return _Size((int(match[1]), int(match[2])))


@command("poses", example="g2ard poses scene.ply --count 128 -o poses.json")
def poses(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    kind: Annotated[
        PoolKind,
        typer.Option(
            help="Around, through rooms and streets, from the air, within rooms, where it is sharp."
        ),
    ] = "auto",
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="How many poses.")] = 128,
    size: Annotated[
        _Size | None,
        typer.Option(parser=_size, metavar="WxH", help="Pixels; 800x600 unless given."),
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(min=1, max=170, help="Horizontal field of view, degrees; 50 unless given, 70 in rooms."),
    ] = None,
    up: UpOption = None,
) -> None:
    """Make a pool of candidate views for a scene without photos: poses in free space that see it well."""
    from g2ard.io import check_views_output, write_views
    from g2ard.policy.inputs import load_scene
    from g2ard.poses import plan_pool
    from g2ard.scene.splits import splits_of

    check_views_output(output, run.overwrite)
    splats = load_scene(scene, run.say)
    pool = plan_pool(
        splats,
        count,
        kind=kind,
        size=size or (800, 600),
        fov=fov,
        up=up,
        seed=run.seed,
        progress=run.progress,
    )
    splits = splits_of(None, pool.cameras.names)
    write_views(output, pool.cameras, splits=splits, overwrite=run.overwrite)
    direction = ", ".join(f"{v:.2f}" for v in pool.up)
    run.say(f"{output}: {plural(count, 'pose')}, {pool.kind} ({pool.why}; up is {direction})")
    shares = (("no pose sees", pool.unseen), ("poses see only under a pixel", pool.coarse))
    if told := [f"{what} {share:.0%} of the scene's matter" for what, share in shares if share > _FEW]:
        run.say("; ".join(told))
    run.result(
        {
            "count": count,
            "kind": pool.kind,
            "why": pool.why,
            "up": pool.up.tolist(),
            "unseen": pool.unseen,
            "coarse": pool.coarse,
        }
    )
