"""`g2ard view`: scenes → an HTML page with a viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli import options as opt
from g2ard.cli.frame import Run, command
from g2ard.config.choices import BLACK
from g2ard.io.detect import run_scene
from g2ard.io.paths import short_names
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.scene.splats import Splats


@command("view", example="g2ard view run/ dense.ply -o compare.html", scenes=True)
def view(
    run: Run,
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE|RUN", help="A scene, or the folder of a `distill` run.")
    ],
    output: opt.OutputOption,
    other: Annotated[
        Path | None,
        typer.Argument(metavar="[SCENE|RUN]", help="Second scene to compare with, right of a divider."),
    ] = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="View to open with; by default a typical one with much detail."),
    ] = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
) -> None:
    """Write an HTML page that shows one scene, or compares two, in any browser."""
    from g2ard.jobs.viewer_frame import frame_of
    from g2ard.viewer import check_page_output, write_page

    views = opt.with_images(views, images)
    run.claim("--output", output)
    check_page_output(output, run.overwrite)
    paths = [run_scene(path) for path in (scene, other) if path is not None]
    loaded = [run.load(path) for path in paths]
    if views is None and scene.is_dir() and (scene / "views.json").is_file():
        views = scene / "views.json"
    stand = frame_of(loaded[0], views, start=start, beside=paths[0], up=up, seed=run.seed, **run.callbacks)
    named = zip(short_names(paths), loaded, strict=True)
    labels = [f"{name}: {plural(len(splats), 'Gaussian')}" for name, splats in named]
    run.begin("page")
    written = write_page(
        output,
        [(label, stand.of(splats)) for label, splats in zip(labels, loaded, strict=True)],
        start=stand.start,
        background=opt.background_of(run, background, scene, other) or BLACK,
        overwrite=run.overwrite,
        progress=run.progress,
    )
    run.kept.append(f"{output} is written")
    sizes = " and ".join(f"{size / 1e6:.2f}" for size in written.scenes)
    run.say(f"{output}: {' | '.join(labels)}; {sizes} MB as SOG, {written.bytes / 1e6:.2f} MB in all")
    run.result(
        {
            "output": str(output),
            "bytes": written.bytes,
            "scenes": _told(paths, loaded, written.scenes),
            "start": stand.name,
            "up": stand.up.tolist(),
        }
    )


def _told(paths: list[Path], scenes: list[Splats], sizes: tuple[int, ...]) -> list[dict[str, Any]]:
    return [
        {"scene": str(path), "count": len(splats), "bytes": size}
        for path, splats, size in zip(paths, scenes, sizes, strict=True)
    ]
