"""`g2ard poses`: scene → cameras to look at it from."""

from __future__ import annotations

from typing import Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import OutputOption, SceneArgument

_KINDS = ("auto", "orbit", "walk", "aerial")


def _numbers(text: str, separator: str, count: int) -> tuple[float, ...] | None:
    try:
        values = tuple(float(part) for part in text.lower().split(separator))
    except ValueError:
        return None
    return values if len(values) == count else None


def _size(text: str) -> tuple[int, int]:
    values = _numbers(text.replace("×", "x"), "x", 2)
    if values is None or any(v != round(v) or not 16 <= v <= 16384 for v in values):
        raise typer.BadParameter(f"width x height in pixels from 16 to 16384, such as 800x600, not {text!r}")
    return int(values[0]), int(values[1])


def _direction(text: str) -> tuple[float, float, float]:
    values = _numbers(text, ",", 3)
    if values is None or not all(abs(v) < 1e30 for v in values) or not any(values):
        raise typer.BadParameter(f"a direction such as 0,0,1 or 0,-1,0, not {text!r}")
    return values[0], values[1], values[2]


def _kind(text: str) -> str:
    if text not in _KINDS:
        raise typer.BadParameter(f"one of {', '.join(_KINDS)}, not {text!r}")
    return text


@command("poses", example="g2ard poses scene.ply --count 128 -o poses.json")
def poses(
    run: Run,
    scene: SceneArgument,
    output: OutputOption,
    kind: Annotated[
        str,
        typer.Option(
            parser=_kind,
            metavar="|".join(_KINDS),
            help="Around an object, through rooms and streets, from the air; auto: by the scene's shape.",
        ),
    ] = "auto",
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="How many poses.")] = 128,
    size: Annotated[
        tuple[int, int] | None,
        typer.Option(parser=_size, metavar="WxH", help="Pixels; 800x600 unless given."),
    ] = None,
    fov: Annotated[float, typer.Option(min=1, max=170, help="Horizontal field of view, degrees.")] = 50.0,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            parser=_direction, metavar="X,Y,Z", help="Away from the ground; estimated unless given."
        ),
    ] = None,
) -> None:
    """Make a pool of candidate views for a scene without photos: poses in free space that see it well."""
    from g2ard.cli.scenes import load_scene
    from g2ard.io import check_output, write_views
    from g2ard.poses import plan_pool

    check_output(output, overwrite=run.overwrite)
    splats = load_scene(run, scene)
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
    write_views(output, pool.cameras, overwrite=run.overwrite)
    direction = ", ".join(f"{v:.2f}" for v in pool.up)
    run.say(f"{output}: {count} poses, {pool.kind} ({pool.why}; up is {direction})")
    run.result({"count": count, "kind": pool.kind, "why": pool.why, "up": pool.up.tolist()})
