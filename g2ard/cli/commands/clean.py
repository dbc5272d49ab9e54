"""`g2ard clean`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import SceneArgument, picture
from g2ard.errors import InputError
from g2ard.io import check_scene_output
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.stages.clean import Cleaning

_WORDS = ("blue", "yellow", "pink", "red", "cyan", "green")
_COLORS = {
    "invisible": (0.20, 0.45, 0.95),
    "giant": (0.95, 0.85, 0.10),
    "needle": (0.90, 0.15, 0.75),
    "floater": (0.95, 0.25, 0.10),
    "haze": (0.10, 0.80, 0.85),
    "streak": (0.25, 0.80, 0.20),
}


@command("clean", example="g2ard clean garden.ply -o garden_clean.ply --preview found.png", scenes=True)
def clean(
    run: Run,
    scene: SceneArgument,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT", help="Output scene.")
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="KIND,…",
            help="Kinds to remove: invisible, giant, needle, floater, haze, streak; all by default; or none.",
        ),
    ] = None,
    split_sky: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write sky and far background to this scene, whole, and the rest to OUT."
        ),
    ] = None,
    strength: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Also remove haze and streaks: 0 none, 1 all, otherwise those that float in front of the "
            "surface in more than 1 - STRENGTH of the views that see them.",
        ),
    ] = 0,
    preview: Annotated[
        Path | None,
        typer.Option(
            parser=picture, metavar="FILE.png", help="Picture with the removed Gaussians coloured by kind."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Report what would be removed, write no scene.")
    ] = False,
) -> None:
    """Remove clutter: invisible Gaussians, giants, needles and floaters; haze and streaks on request.

    Visibility is measured from generated views.
    """
    import numpy as np

    from g2ard.jobs.inputs import clutter_seen
    from g2ard.scene.sky import sky_mask
    from g2ard.stages.clean import Cleaning

    kinds = _kinds(only, strength)
    if preview is not None and not kinds:
        raise typer.BadParameter("--preview shows clutter, so that it does not go with --only none")
    if output is None and not dry_run:
        raise typer.BadParameter("give an output with -o, or --dry-run")
    if preview is not None:
        run.check_extra("--preview", preview)
    if split_sky is not None:
        run.check_extra("--split-sky", split_sky)
    if not dry_run:
        for path in filter(None, (output, split_sky)):
            check_scene_output(path, run.overwrite)
    whole = splats = run.load(scene)
    sky = np.zeros(len(whole), bool)
    if split_sky is not None:
        sky = sky_mask(whole)
        splats = whole.take(~sky)
        run.say(f"sky: {plural(int(sky.sum()), 'Gaussian')}" if sky.any() else "the scene has no sky")
    tell = run.answer if dry_run else run.say
    run.console.expect([("visibility", 11), ("depths", 16), ("clutter", 19), ("preview", 1)])  # showroom, s
    found, cameras = Cleaning(np.full(len(splats), -1, np.int8)), None
    if kinds:
        found, cameras = clutter_seen(
            splats, kinds, strength=strength, seed=run.seed, progress=run.progress, say=tell
        )
    kept = int(found.keep.sum())
    if not dry_run and output is not None:
        if not kept:
            raise InputError(
                "every Gaussian would be removed; inspect it with --dry-run --preview", path=scene
            )
        run.write(output, splats.take(found.keep))
        run.say(f"{output}: keeps {kept:,} of {plural(len(splats), 'Gaussian')}")
        if split_sky is not None and sky.any():
            run.write(split_sky, whole.take(sky))
    if preview is not None and cameras is not None:
        with run.finishing("--preview"):
            _paint(preview, splats, found, cameras, run.overwrite)
        run.say(f"picture: {preview}")
    counts = {"input_count": len(whole), "output_count": kept, "found": found.counts}
    run.result(counts if split_sky is None else {**counts, "sky_count": int(sky.sum())})


def _kinds(only: str | None, strength: float) -> tuple[str, ...]:
    """Return the kinds of clutter to remove, after checking that they are known and have a strength."""
    from g2ard.stages.clean import FLOATING, KINDS

    if only is None:
        return KINDS
    kinds = tuple(word.strip() for word in only.split(",") if only != "none")
    if wrong := [word for word in kinds if word not in KINDS]:
        raise typer.BadParameter(f"--only: expected {', '.join(KINDS)}, got {wrong[0]!r}")
    if not strength and (idle := [kind for kind in kinds if kind in FLOATING]):
        raise typer.BadParameter(f"--only {idle[0]} needs --strength, such as 0.5")
    return kinds


def _paint(path: Path, splats: Splats, found: Cleaning, cameras: Cameras, overwrite: bool) -> None:
    """Write up to three views of the scene, its clutter coloured by kind on grey, and the result."""
    import numpy as np

    from g2ard.io.images import contact_sheet, write_png
    from g2ard.rendering.renderer import Renderer
    from g2ard.report.paint import painted
    from g2ard.scene.samples import evenly_spaced

    colors = np.array([*_COLORS.values(), (0.45, 0.48, 0.52)])[found.kind]
    scenes = [splats, painted(splats, colors), splats.take(found.keep)]
    chosen = evenly_spaced(len(cameras), 3, floor=True)
    renderers = [Renderer(scene) for scene in scenes]
    rows = [[r.clipped(cameras[int(view)]) for r in renderers] for view in chosen]
    counts = zip(_WORDS, found.counts.items(), strict=True)
    legend = ", ".join(f"{word}: {count:,} {name}" for word, (name, count) in counts if count)
    labels = [f"before: {len(splats):,}", "removed, in colour", f"after: {len(scenes[2]):,}"]
    sheet = contact_sheet(rows, labels, row_labels=[legend] * len(rows))
    write_png(path, sheet, overwrite=overwrite)
