"""`g2ard render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import BackgroundOption, LookOption, SceneArgument, SizeOption, SplitOption


@command("render", example="g2ard render scene.ply --views poses.json -o renders/")
def render(
    run: Run,
    scene: SceneArgument,
    views: LookOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the PNGs.")],
    depth: Annotated[bool, typer.Option("--depth", help="Also write NAME.depth.npy, scene units.")] = False,
    split: SplitOption = "all",
    size: SizeOption = None,
    background: BackgroundOption = None,
) -> None:
    """Render a scene into every view as PNG."""
    import numpy as np

    from g2ard.cli.scenes import load_scene, load_views
    from g2ard.images import write_png
    from g2ard.io.atomic import atomic_folder, check_output
    from g2ard.render import render as rasterize

    check_output(output, run.overwrite, folder=True)
    splats = load_scene(run, scene)
    cameras = load_views(run, views, split, size)
    with atomic_folder(output, overwrite=run.overwrite) as folder:
        for view, name in enumerate(cameras.names):
            rendered = rasterize(splats, cameras, view, background=background or (0.0, 0.0, 0.0))
            stem = folder / Path(name).with_suffix("")
            stem.parent.mkdir(parents=True, exist_ok=True)
            write_png(stem.with_name(stem.name + ".png"), rendered.image)
            if depth:
                np.save(stem.with_name(stem.name + ".depth.npy"), rendered.depth)
            run.progress("render", view + 1, len(cameras))
    run.say(f"{len(cameras)} images in {output}")
    run.result({"images": len(cameras), "output": str(output)})
