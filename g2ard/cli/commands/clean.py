"""`g2ard clean`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import SceneArgument, picture
from g2ard.progress import plural


@command("clean", example="g2ard clean garden.ply -o garden_clean.ply --preview found.png")
def clean(
    run: Run,
    scene: SceneArgument,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT", help="The scene without what was found.")
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(metavar="KIND,…", help="Of invisible, giant, needle and floater; all if not given."),
    ] = None,
    preview: Annotated[
        Path | None,
        typer.Option(
            parser=picture, metavar="FILE.png", help="A picture with what would go painted by its kind."
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say and show it, write no scene.")] = False,
) -> None:
    """Take out what no picture needs: invisible Gaussians, giants, needles, floaters.

    What is seen is measured from a pool of poses of the scene's own.
    """
    from g2ard import io
    from g2ard.cli.cleaning import paint_clutter
    from g2ard.errors import InputError
    from g2ard.policy.clean import clutter_seen
    from g2ard.policy.inputs import load_scene
    from g2ard.stages.clean import KINDS

    kinds = KINDS if only is None else tuple(word.strip() for word in only.split(","))
    if wrong := [word for word in kinds if word not in KINDS]:
        raise typer.BadParameter(f"--only: {', '.join(KINDS)}, not {wrong[0]!r}")
    if output is None and not dry_run:
        raise typer.BadParameter("name an output with -o, or ask with --dry-run")
    if output is not None and not dry_run:
        io.check_scene_output(output, run.overwrite)
    if preview is not None:
        from g2ard.io.paths import real_path

        if real_path(preview) in {real_path(path) for path in (scene, output) if path}:
            raise typer.BadParameter(f"--preview: {preview} is another file already; name a .png of its own")
        io.check_output(preview, run.overwrite)
    splats = load_scene(scene, run.say)
    found, cameras = clutter_seen(splats, kinds, seed=run.seed, progress=run.progress, say=run.say)
    if preview is not None:
        paint_clutter(preview, splats, found, cameras, run.overwrite)
        run.kept.append(f"{preview} is written")
        run.say(f"picture: {preview}")
    kept = int(found.keep.sum())
    if not dry_run and output is not None:
        if not kept:
            raise InputError(f"{scene}: nothing would be left; look at it with --dry-run --preview")
        io.write_splats(output, splats.take(found.keep), overwrite=run.overwrite)
        run.say(f"{output}: {plural(kept, 'Gaussian')}")
    run.result({"input_count": len(splats), "output_count": kept, "found": found.counts})
