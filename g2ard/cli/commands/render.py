"""`g2ard render`."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli import options as opt
from g2ard.cli.command import command
from g2ard.cli.run import Run
from g2ard.config.choices import BLACK, is_given, is_made
from g2ard.io.atomic import atomic_folder, check_output
from g2ard.io.paths import output_names
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.arrays import Bytes, Float32
    from g2ard.rendering.renderer import Rendered

_NO_FOLDER = (".jpg", ".jpeg", ".avi", ".mov", ".mkv", ".webm")
"""Suffixes of files that `render` does not write as -o."""

_PANORAMA = 2048
"""Width of a panorama in pixels."""


@command(
    "render",
    example="g2ard render scene.ply -k 4 --sheet look.png",
    scenes=True,
    outputs=("output", "sheet"),
)
def render(
    run: Run,
    scene: opt.SceneArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR|FILE",
            help="Folder for PNGs, one view as .png, or an animation of the views in order: .gif, .webp, "
            ".mp4 (needs ffmpeg).",
        ),
    ] = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    turn: Annotated[
        int | None,
        typer.Option(
            "--orbit", min=1, metavar="N", help="Render N views on a circle around the scene."
        ),
    ] = None,
    around: Annotated[
        bool,
        typer.Option(
            "--panorama",
            help="Render equirectangular panoramas from the views' poses, --size or 2,048 pixels wide.",
        ),
    ] = False,
    fps: Annotated[float, typer.Option(min=0.1, help="Images a second of an animation.")] = 25.0,
    sheet: Annotated[
        Path | None,
        typer.Option(
            parser=opt.picture, metavar="FILE.png", help="Write all views as one contact sheet."
        ),
    ] = None,
    depth: Annotated[
        bool,
        typer.Option(
            "--depth", help="Also write NAME.depth.npy, in scene units (distances with --panorama)."
        ),
    ] = False,
    looks: Annotated[
        int | None,
        typer.Option("-k", min=1, metavar="K", help="Views to generate; by default 128."),
    ] = None,
    convention: opt.ConventionOption = "gsplat",
    split: opt.SplitOption = "all",
    size: opt.ShapeOption = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
) -> None:
    """Render views of a scene as PNG or as an animation."""
    from g2ard.io.animations import write_animation
    from g2ard.io.images import to_bytes, write_png
    from g2ard.jobs.inputs import GivenViews, load_views
    from g2ard.jobs.run_views import (
        choose_looks,
        choose_plan_size,
        find_or_plan_views,
        is_planned,
        orbit,
        resize_views,
    )
    from g2ard.jobs.view_checks import warn_of_sight
    from g2ard.jobs.viewer_frame import choose_backdrop
    from g2ard.rendering.renderer import RasterSettings, Renderer, stations
    from g2ard.rendering.sky import seen_on_sky

    if output is None and sheet is None:
        raise typer.BadParameter("give -o DIR, --sheet FILE.png or both")
    if turn is not None and (views is not None or looks is not None):
        raise typer.BadParameter("--orbit generates its views, so it excludes --views and -k")
    output, file = _check_output(run, output, depth)
    single = file is not None and file.suffix.lower() == ".png"
    if single and views is None and turn is None:
        looks = looks or 1

    def check_single(count: int) -> None:
        if file is not None and single and count > 1:
            raise typer.BadParameter(
                f"-o: {file.name} holds one view, not {count}; give -k 1 or a folder"
            )

    check_single(turn or looks or 1)
    if looks is not None and is_given(views):
        raise typer.BadParameter("-k generates views, so it excludes --views; give one")
    if is_given(views):
        run.refuse_typed("without generated views", "up")
    if file is None or single:
        run.refuse_typed("without an animation", "fps")
    if size is not None and len(size) > 1 and (around or is_given(views)):
        what = "panoramas are twice as wide as high" if around else "given views keep their shape"
        raise typer.BadParameter(f"--size: {what}; give one number, not {size}")
    views = opt.with_images(views, images)
    run.claim_file("--sheet", sheet)
    splats = run.load(scene)
    found: Any
    if turn is not None:
        found = orbit(splats, turn, size=choose_plan_size(size), up=up, beside=scene, say=run.say)
    else:
        beside = None if is_made(views) else scene
        given = GivenViews(views, beside, up, run.seed, choose_plan_size(size), **run.callbacks)
        found = (
            find_or_plan_views(splats, given)
            if looks is None
            else choose_looks(splats, looks, given)
        )
    cameras = load_views(found, split, None, run.say)
    if around:
        cameras = stations(cameras)
    else:
        cameras = resize_views(cameras, size, made=is_planned(found))
        warn_of_sight(splats, cameras, run.say)
    check_single(len(cameras))
    places = output_names(cameras.source or str(views), cameras.names) if output is not None else []
    if output is not None:
        files = (_name_files(output / place, depth) for place in places)
        run.claim("--output", *chain.from_iterable(files))
    shown: list[Bytes] = []
    colour = opt.background_of(run, background, scene) or BLACK
    generated = turn is not None or looks is not None or is_planned(found)
    sky = (
        generated
        and colour == BLACK
        and background is None
        and choose_backdrop(None, [splats]) is None
    )
    renderer = Renderer(splats, background=colour, settings=RasterSettings(convention=convention))

    def draw(folder: Path | None) -> Iterator[Bytes]:
        for view in range(len(cameras)):
            camera = cameras[view]
            rendered: Rendered | None = None
            if around:
                rendered = renderer.panorama(
                    camera, width=2 * max(2, (size[0] if size else _PANORAMA) // 2)
                )
            elif depth or sky:
                rendered = renderer.render(camera)
            image = renderer.image(camera) if rendered is None else rendered.image
            if rendered is not None and sky:
                image = seen_on_sky(rendered)
            if folder is not None:
                _write_view(
                    folder / places[view], image, rendered.depth if rendered and depth else None
                )
            pixels = to_bytes(image)
            if sheet is not None:
                shown.append(pixels)
            run.progress("render", view + 1, len(cameras))
            yield pixels

    if file is not None:
        if single:
            write_png(file, next(draw(None)), overwrite=run.overwrite)
        else:
            write_animation(file, draw(None), fps=fps, overwrite=run.overwrite)
        run.note_written(file)
    else:
        with nullcontext() if output is None else atomic_folder(output, run.overwrite) as folder:
            deque(draw(folder), maxlen=0)
    if output is not None:
        run.note_written(output)
    written = [str(path) for path in (output, file) if path]
    if sheet is not None:
        with run.showing("--sheet") if written else run.finishing("--sheet"):
            _write_sheet(sheet, shown, cameras.names, run.overwrite)
            written.append(str(sheet))
    run.say(f"{plural(len(cameras), 'image')} in {' and '.join(written)}")
    run.result({"images": len(cameras), "output": written[0]})


def _check_output(run: Run, output: Path | None, depth: bool) -> tuple[Path | None, Path | None]:
    """Check the output, and return it as a folder or as the file of a picture or an animation."""
    from g2ard.io.animations import ANIMATIONS, check_animation

    if output is None:
        return None, None
    run.claim("--output", output)
    if output.suffix.lower() not in (".png", *ANIMATIONS):
        if output.suffix.lower() in _NO_FOLDER:
            raise typer.BadParameter(
                f"-o: expected a folder, .png, .gif, .webp or .mp4, got {output.name!r}"
            )
        check_output(output, run.overwrite, folder=True)
        return output, None
    if depth:
        raise typer.BadParameter("--depth needs a folder; give -o DIR")
    check_output(output, run.overwrite)
    if output.suffix.lower() != ".png":
        check_animation(output)
    return None, output


def _name_files(stem: Path, depth: bool) -> list[Path]:
    """Return the files of one view: STEM.png and, with `depth`, STEM.depth.npy."""
    return [stem.with_name(stem.name + suffix) for suffix in (".png", ".depth.npy")[: 1 + depth]]


def _write_view(stem: Path, image: Float32, depth: Float32 | None) -> None:
    """Write the files of one view."""
    import numpy as np

    from g2ard.io.images import write_png

    picture, *depths = _name_files(stem, depth is not None)
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_png(picture, image)
    if depth is not None:
        np.save(depths[0], depth)


def _write_sheet(path: Path, images: list[Bytes], names: tuple[str, ...], overwrite: bool) -> None:
    """Write a roughly square grid of all images, captioned by row."""
    from g2ard.io.images import write_png
    from g2ard.report.sheet import draw_contact_sheet

    columns = math.ceil(math.sqrt(len(images)))
    rows = [images[i : i + columns] for i in range(0, len(images), columns)]
    captions = [", ".join(names[i : i + columns]) for i in range(0, len(images), columns)]
    write_png(
        path, draw_contact_sheet(rows, [""] * columns, row_labels=captions), overwrite=overwrite
    )
