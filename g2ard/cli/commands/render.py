"""`g2ard render`."""

from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from g2ard.cli import options as opt
from g2ard.cli.budget_options import Count, LooksOption, RatioOption, one_budget
from g2ard.cli.frame import Run, command
from g2ard.config.choices import BLACK, Method, is_made
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_folder, check_output
from g2ard.io.paths import output_names
from g2ard.progress import plural

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.rendering.renderer import Rendered
    from g2ard.scene.splats import Splats

_NO_FOLDER = (".png", ".jpg", ".jpeg", ".avi", ".mov", ".mkv", ".webm")
"""Suffixes of files that `render` does not write as -o."""

Color = Literal["scene", "flags", "cells", "parents"]


@command(
    "render",
    example="g2ard render scene.ply -n 4 --sheet look.png",
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
            help="Folder for PNGs, or an animation of the views in order: .gif, .webp, .mp4 (needs ffmpeg).",
        ),
    ] = None,
    views: opt.ViewsOrMadeOption = None,
    images: opt.ImagesOption = None,
    turn: Annotated[
        int | None,
        typer.Option("--orbit", min=1, metavar="N", help="Render N views on a circle around the scene."),
    ] = None,
    fps: Annotated[float, typer.Option(min=0.1, help="Images a second of an animation.")] = 25.0,
    sheet: Annotated[
        Path | None,
        typer.Option(parser=opt.picture, metavar="FILE.png", help="Write all views as one contact sheet."),
    ] = None,
    depth: Annotated[
        bool, typer.Option("--depth", help="Also write NAME.depth.npy, in scene units.")
    ] = False,
    color: Annotated[
        Color,
        typer.Option(help="Colour by scene, or by simplification to -n or -r: flags, cells or parents."),
    ] = "scene",
    count: LooksOption = None,
    ratio: RatioOption = None,
    method: Annotated[Method, typer.Option(help="Method of --color parents.")] = "default",
    parents: Annotated[
        Path | None,
        typer.Option(metavar="FILE.npy", help="With --color parents: file from `simplify --parents`."),
    ] = None,
    convention: opt.ConventionOption = "gsplat",
    split: opt.SplitOption = "all",
    size: opt.SizeOption = None,
    background: opt.BackgroundOption = None,
    up: opt.UpOption = None,
) -> None:
    """Render views of a scene as PNG, or show how it would be simplified."""
    from g2ard.io.animation import write_animation
    from g2ard.io.images import to_bytes
    from g2ard.jobs.inputs import load_views
    from g2ard.jobs.turntable import turntable
    from g2ard.jobs.view_checks import warn_of_sight
    from g2ard.jobs.views import views_or_pool
    from g2ard.rendering.renderer import RasterSettings, Renderer

    if output is None and sheet is None:
        raise typer.BadParameter("give -o DIR, --sheet FILE.png or both")
    if turn is not None and (views is not None or count is not None):
        raise typer.BadParameter("--orbit generates its views, so it excludes --views and -n")
    output, animation = _folder_or_animation(run, output, depth)
    looks = _looks(color, count, ratio, parents, views)
    if views is not None and not is_made(views):
        run.refuse_typed("without generated views", "up")
    if animation is None:
        run.refuse_typed("without an animation", "fps")
    if color != "parents" or parents is not None:
        run.refuse_typed("without --color parents and -n or -r", "method")
    views = opt.with_images(views, images)
    if sheet is not None:
        run.claim("--sheet", sheet)
        check_output(sheet, run.overwrite)
    splats = run.load(scene)
    if parents is not None:
        splats = _by_parents(run, splats, _read_parents(parents, len(splats)))
    elif color != "scene":
        budget = one_budget(count, ratio).of(len(splats), str(scene))
        splats = _painted(run, splats, color, budget, method)
    found: Any
    if turn is not None:
        found = turntable(splats, turn, up=up, seed=run.seed, progress=run.progress, say=run.say)
    else:
        found = views_or_pool(
            splats,
            "made" if looks is not None else views,
            beside=scene,
            count=looks,
            up=up,
            seed=run.seed,
            progress=run.progress,
            say=run.say,
        )
    cameras = load_views(found, split, size, run.say)
    warn_of_sight(splats, cameras, run.say)
    places = output_names(cameras.source or str(views), cameras.names) if output is not None else []
    if output is not None:
        run.claim("--output", *(file for place in places for file in _files(output / place, depth)))
    shown: list[NDArray[np.uint8]] = []
    wanted = sheet is not None or animation is not None
    colour = opt.background_of(run, background, scene) or BLACK
    renderer = Renderer(splats, background=colour, settings=RasterSettings(convention=convention))
    with nullcontext() if output is None else atomic_folder(output, run.overwrite) as folder:
        for view in range(len(cameras)):
            rendered = renderer.render(cameras[view])
            if wanted:
                shown.append(to_bytes(rendered.image))
            if folder is not None:
                _write_view(folder / places[view], rendered, depth)
            run.progress("render", view + 1, len(cameras))
    run.kept += [f"{output} is written"] if output is not None else []
    if animation is not None:
        write_animation(animation, shown, fps=fps, overwrite=run.overwrite)
        run.kept.append(f"{animation} is written")
    if sheet is not None:
        with run.finishing("--sheet"):
            _write_sheet(sheet, shown, cameras.names, run.overwrite)
    written = [str(path) for path in (output, animation, sheet) if path]
    run.say(f"{plural(len(cameras), 'image')} in {' and '.join(written)}")
    run.result({"images": len(cameras), "output": written[0]})


def _folder_or_animation(run: Run, output: Path | None, depth: bool) -> tuple[Path | None, Path | None]:
    """Check the output, and return it as a folder or as an animation's file."""
    from g2ard.io.animation import SUFFIXES, check_animation

    if output is None:
        return None, None
    run.claim("--output", output)
    if output.suffix.lower() not in SUFFIXES:
        if output.suffix.lower() in _NO_FOLDER:
            raise typer.BadParameter(f"-o: expected a folder, .gif, .webp or .mp4, got {output.name!r}")
        check_output(output, run.overwrite, folder=True)
        return output, None
    if depth:
        raise typer.BadParameter("--depth needs a folder; give -o DIR")
    check_output(output, run.overwrite)
    check_animation(output)
    return None, output


def _files(stem: Path, depth: bool) -> list[Path]:
    """Return the files of one view: STEM.png and, with `depth`, STEM.depth.npy."""
    return [stem.with_name(stem.name + suffix) for suffix in (".png", ".depth.npy")[: 1 + depth]]


def _write_view(stem: Path, rendered: Rendered, depth: bool) -> None:
    """Write the files of one view."""
    import numpy as np

    from g2ard.io.images import write_png

    picture, *depths = _files(stem, depth)
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_png(picture, rendered.image)
    for path in depths:
        np.save(path, rendered.depth)


def _write_sheet(
    path: Path, images: list[NDArray[np.uint8]], names: tuple[str, ...], overwrite: bool
) -> None:
    """Write a roughly square grid of all images, captioned by row."""
    from g2ard.io.images import contact_sheet, write_png

    columns = math.ceil(math.sqrt(len(images)))
    rows = [images[i : i + columns] for i in range(0, len(images), columns)]
    captions = [", ".join(names[i : i + columns]) for i in range(0, len(images), columns)]
    write_png(path, contact_sheet(rows, [""] * columns, row_labels=captions), overwrite=overwrite)


def _looks(
    color: Color, count: Count | None, ratio: float | None, parents: Path | None, views: Path | None
) -> int | None:
    """Check -n and -r, and return the number of views to generate if -n gives it."""
    if parents is not None and color != "parents":
        raise typer.BadParameter("--parents goes with --color parents")
    if color != "scene" and parents is None:
        one_budget(count, ratio)
        return None
    if ratio is not None or (parents is not None and count is not None):
        raise typer.BadParameter("-n and -r go with --color flags, cells or parents (without --parents)")
    if count is None:
        return None
    if views is not None and not is_made(views):
        raise typer.BadParameter("-n generates views, so it excludes --views; give one")
    if count.is_share:
        raise typer.BadParameter(
            "-n: expected a number of views to generate; a budget needs --color flags, cells or parents"
        )
    return int(count.value)


def _painted(run: Run, splats: Splats, color: Color, budget: int, method: Method) -> Splats:
    """Colour the scene by protection flags, cells, or the rows that simplification merges."""
    from g2ard.report.paint import cell_labels, flag_colors, label_colors, painted
    from g2ard.stages.simplify import flag, simplify

    if color == "flags":
        flags = flag(splats, budget, progress=run.progress)
        run.say(
            f"flags: {flags.mean():.1%} of {plural(len(splats), 'Gaussian')} are protected, "
            f"over {plural(budget, 'cell')}"
        )
        return painted(splats, flag_colors(flags))
    if color == "cells":
        labels = cell_labels(splats, budget)
        run.say(f"cells: {labels.max() + 1:,}")
        return painted(splats, label_colors(labels))
    return _by_parents(run, splats, simplify(splats, budget, method=method, progress=run.progress).parents)


def _by_parents(run: Run, splats: Splats, parents: NDArray[np.int64]) -> Splats:
    """Colour each Gaussian by its row in the simplified scene."""
    from g2ard.report.paint import label_colors, painted

    gone = int((parents < 0).sum())
    run.say(f"parents: {plural(parents.max() + 1, 'Gaussian')} of {len(splats):,}; {gone:,} dropped (black)")
    return painted(splats, label_colors(parents))


def _read_parents(path: Path, count: int) -> NDArray[np.int64]:
    import numpy as np

    try:
        labels = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"not a NumPy array ({error})", path=path) from None
    if not isinstance(labels, np.ndarray) or labels.dtype.kind not in "iu" or labels.shape != (count,):
        raise InputError(f"expected {count} whole numbers, one per Gaussian of the scene", path=path)
    return labels.astype(np.int64)
