"""`g2ard clean`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.command import command
from g2ard.cli.options import DryRunOption, SceneArgument, picture
from g2ard.cli.run import Run
from g2ard.cli.run_result import describe_memory
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.jobs.clean import Cleaned
    from g2ard.jobs.cost import Cost
    from g2ard.scene.cameras import Cameras

_GREY = (0.45, 0.48, 0.52)
_COLORS = {
    "invisible": ("", _GREY),  # no picture shows them
    "giant": ("yellow", (0.95, 0.85, 0.10)),
    "needle": ("pink", (0.90, 0.15, 0.75)),
    "floater": ("red", (0.95, 0.25, 0.10)),
    "haze": ("cyan", (0.10, 0.80, 0.85)),
    "streak": ("green", (0.25, 0.80, 0.20)),
}
"""Colour of each kind of clutter in the picture, and its name."""


@command(
    "clean",
    example="g2ard clean garden.ply -o garden_clean.ply --preview found.png",
    scenes=True,
    outputs=("output", "split_sky", "preview"),
)
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
            help="Kinds to remove: invisible, giant, needle, floater, and with --strength haze, streak; all "
            "by default; or none.",
        ),
    ] = None,
    split_sky: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write sky and far background to this scene, whole, and the rest to OUT.",
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
            parser=picture,
            metavar="FILE.png",
            help="Picture with the removed Gaussians coloured by kind. Without -o, only this is written.",
        ),
    ] = None,
    dry_run: DryRunOption = False,
) -> None:
    """Remove clutter: invisible Gaussians, giants, needles, floaters; haze on request.

    Visibility is measured from generated views.

    --preview FILE.png without -o shows what would go; --dry-run only estimates memory.
    """
    from g2ard.jobs.clean import choose_kinds
    from g2ard.jobs.clean import clean as remove_clutter
    from g2ard.jobs.cost import cost_of_cleaning

    kinds = (
        None if only is None else tuple(word.strip() for word in only.split(",") if only != "none")
    )
    with run.usage():
        wanted = choose_kinds(kinds, strength)
    if preview is not None and kinds == ():
        raise typer.BadParameter("--preview shows clutter, so that it does not go with --only none")
    if output is None and (preview is None or split_sky is not None):
        raise typer.BadParameter("give an output with -o, or only --preview")
    source = Source(scene, run.render_model)
    if dry_run:
        _tell_plan(run, source.scene.count, cost_of_cleaning(source.scene, wanted))
        return
    run.claim_file("--preview", preview)
    for flag, path in (("--output", output), ("--split-sky", split_sky)):
        if path is not None:
            run.claim_scene(flag, path)
    done = remove_clutter(
        run.load(source),
        only=kinds,
        strength=strength,
        split_sky=split_sky is not None,
        seed=run.seed,
        progress=run.progress,
        say=run.answer if output is None else run.say,
    )
    total = len(done.before)
    kept = int(done.clutter.keep.sum())
    sky_count = 0 if done.sky is None else len(done.sky)
    if output is not None:
        if not kept:
            raise InputError(
                "every Gaussian would be removed; give --preview without -o", path=scene
            )
        run.write(output, done.splats)
        run.say(f"{output}: keeps {kept:,} of {plural(total, 'Gaussian')}")
        if split_sky is not None and done.sky is not None:
            if sky_count:
                run.write(split_sky, done.sky)
            else:
                run.say(f"{split_sky}: not written; {output} is the whole scene")
    if preview is not None and done.cameras is not None:
        with run.showing("--preview"):
            _paint(preview, done, done.cameras, run.overwrite)
            run.say(f"picture: {preview}")
    counts = {"input_count": total + sky_count, "output_count": kept, "found": done.clutter.counts}
    run.result(counts if done.sky is None else {**counts, "sky_count": sky_count})


def _tell_plan(run: Run, count: int, cost: Cost) -> None:
    """Print the rough memory of cleaning `count` Gaussians."""
    views = f", looked at in {cost.views} views" if cost.views else ""
    run.answer(f"{plural(count, 'Gaussian')}{views}: roughly {describe_memory(cost)}")
    run.say_dry()
    if cost.views:
        run.say("--preview FILE.png without -o shows what would go")
    run.result({"count": count, **asdict(cost)})


def _paint(path: Path, done: Cleaned, cameras: Cameras, overwrite: bool) -> None:
    """Write up to three views of the scene, its clutter coloured by kind on grey, and the result."""
    import numpy as np

    from g2ard.io.images import write_png
    from g2ard.jobs.clean import paint
    from g2ard.rendering.renderer import Renderer
    from g2ard.report.sheet import draw_contact_sheet
    from g2ard.scene.samples import evenly_spaced

    colors = np.array([*(color for _, color in _COLORS.values()), _GREY])[done.clutter.kind]
    scenes = [done.before, paint(done.before, colors), done.splats]
    chosen = evenly_spaced(len(cameras), 3, floor=True)
    renderers = [Renderer(scene) for scene in scenes]
    rows = [[r.clipped(cameras[int(view)]) for r in renderers] for view in chosen]
    found = [
        (name, count, _COLORS[name][0]) for name, count in done.clutter.counts.items() if count
    ]
    legend = ", ".join(
        f"{word}: {count:,} {name}" if word else f"{count:,} {name} (nothing to show)"
        for name, count, word in found
    )
    labels = [f"before: {len(scenes[0]):,}", "removed, in colour", f"after: {len(scenes[2]):,}"]
    sheet = draw_contact_sheet(rows, labels, row_labels=[legend] * len(rows))
    write_png(path, sheet, overwrite=overwrite)
