"""Options that several commands share; budgets are in `budget_options`."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.budget_options import Count
from g2ard.config.choices import (
    BLACK,
    Alpha,
    Convention,
    FormatName,
    PaperPresetName,
    PresetName,
    ViewFormat,
    is_given,
)
from g2ard.errors import require_torch
from g2ard.io.detect import suffixes

if TYPE_CHECKING:
    from g2ard.cli.run import Run
    from g2ard.io import Source

SceneArgument = Annotated[
    Path,
    typer.Argument(
        metavar="SCENE",
        help=f"Scene: {suffixes('splats')}, a SOG folder or a run.",
    ),
]
OthersArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="[SCENE…]",
        help="Further scenes or point clouds of the same place. A folder of point clouds is one, too.",
        show_default=False,
    ),
]
ViewsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="VIEWS",
        help="Cameras: COLMAP folder, transforms.json, cameras.json, training run or g2ard's .json.",
    ),
]


def _views_or_made(text: str) -> Path | str:
    """Read a path, or the word "made"; a folder of that name is ./made."""
    return "made" if text == "made" else Path(text)


ViewsOrMadeOption = Annotated[
    Path | None,
    typer.Option(
        parser=_views_or_made,
        metavar="VIEWS|made",
        help="Cameras: COLMAP folder, transforms.json, cameras.json, training run or g2ard's .json. "
        "By default those found beside the scene; 'made' generates views.",
    ),
]
ImagesOption = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder of the photos of the views, if they are elsewhere."),
]
AlphaOption = Annotated[
    Alpha,
    typer.Option(
        help="Photos with alpha: composite them over the background, or mask what is transparent."
    ),
]


def with_images(views: Path | None, folder: Path | None, alpha: Alpha = "composite") -> Any:
    """Return --views together with the options for its photos."""
    given = is_given(views)
    if folder is not None and not given:
        raise typer.BadParameter("--images goes with --views VIEWS")
    if not given or (folder is None and alpha == "composite"):
        return views
    from g2ard.io.types import ViewFiles

    return ViewFiles(Path(str(views)), folder, alpha)


LookOption = Annotated[
    Path, typer.Option(metavar="VIEWS", help="Cameras, with photos unless --teacher is given.")
]
OutputOption = Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Output file.")]


def picture(text: str) -> Path:
    """Read the name of an output picture."""
    if Path(text).suffix.lower() != ".png":
        raise typer.BadParameter(f"expected a name that ends in .png, got {text!r}")
    return Path(text)


class Triple(tuple[float, float, float]):
    """Three numbers in one argument. Typer would read a plain tuple as several arguments."""


def _colour(text: str) -> Triple:
    named = {"black": Triple(BLACK), "white": Triple((1.0, 1.0, 1.0))}
    if text in named:
        return named[text]
    found = _floats(text)
    if len(found) != 3 or not all(0 <= v <= 1 for v in found):
        raise typer.BadParameter(
            f"expected black, white or R,G,B in [0, 1] such as 0.2,0.3,0.4, got {text!r}"
        )
    return Triple(found)


def numbers(option: str, text: str, count: int) -> list[float]:
    """Read `count` finite numbers, separated by commas or spaces.

    >>> numbers("--box", "0, 0,0 1,1,1e1", 6)
    [0.0, 0.0, 0.0, 1.0, 1.0, 10.0]
    """
    found = _floats(text)
    if len(found) != count:
        raise typer.BadParameter(
            f"{option}: expected {count} comma-separated numbers, got {text!r}"
        )
    return found


def _floats(text: str) -> list[float]:
    """Read numbers separated by commas or spaces; return [] if a word is not a finite number."""
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return []
    return found if all(map(math.isfinite, found)) else []


def _direction(text: str) -> Triple:
    found = _floats(text)
    if len(found) != 3 or not any(found) or max(map(abs, found)) > 1e30:
        raise typer.BadParameter(f"expected a direction such as 0,0,1 or 0,-1,0, got {text!r}")
    return Triple(found)


def choose_points(run: Run, source: Source | None) -> None:
    """Make a source read only the points of --box and --where, in the colours of --color."""
    from g2ard.jobs.chosen_points import PointChoice

    box, where, color = (run.shared[name] for name in ("box", "where", "color"))
    with run.usage():
        choice = PointChoice(None if box is None else numbers("--box", box, 6), where, color)
        choice.narrow(source, run.progress)


UpOption = Annotated[
    Triple | None,
    typer.Option(
        parser=_direction,
        metavar="X,Y,Z",
        help="Up direction for generated views; estimated by default.",
    ),
]


SplitOption = Annotated[
    str,
    typer.Option(
        metavar="train|test|all", help="Views to use; every 8th is test unless a split is given."
    ),
]
FormatOption = Annotated[
    FormatName, typer.Option(case_sensitive=False, help="Format of the scene in RUN.")
]
ViewFormatOption = Annotated[
    ViewFormat | None,
    typer.Option(
        case_sensitive=False,
        help="Format of OUT; by default that of its name: cameras.json is INRIA's, transforms.json "
        "nerfstudio's, another .json g2ard's, a folder COLMAP text.",
    ),
]
ViewsFormatOption = Annotated[
    ViewFormat,
    typer.Option(
        case_sensitive=False,
        help="Also write generated views as cameras.json (inria), transforms.json (nerfstudio) or colmap/.",
    ),
]
UNWRITTEN = Path("dry-run")
"""Output of a dry run without -o."""


def _need_no_output(ctx: typer.Context, dry_run: bool) -> bool:
    if dry_run:
        ctx.default_map = {"output": str(UNWRITTEN), **(ctx.default_map or {})}
    return dry_run


DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        callback=_need_no_output,
        is_eager=True,
        help="Print the counts and rough memory, then exit; needs no -o.",
    ),
]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")]
SizeOption = Annotated[
    int | None,
    typer.Option(
        min=16, metavar="PIXELS", help="Longer side of the images; photos only shrink to it."
    ),
]


class Shape(tuple[int, ...]):
    """A longer side, or a width and height, in one argument."""

    def __str__(self) -> str:
        return "x".join(map(str, self))


def _shape(text: str) -> Shape:
    """Read 1920 or 1920x1080.

    >>> _shape("1920"), _shape("1920x1080")
    ((1920,), (1920, 1080))
    """
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) > 2 or not all(part.strip().isdecimal() and int(part) >= 16 for part in parts):
        raise typer.BadParameter(
            f"expected pixels, at least 16, such as 1920 or 1920x1080 (width, height), got {text!r}"
        )
    return Shape(map(int, parts))


ShapeOption = Annotated[
    Shape | None,
    typer.Option(
        parser=_shape,
        metavar="PIXELS|WxH",
        help="Longer side of the images, or width and height of generated views; photos only shrink.",
    ),
]


def duration(text: str) -> float:
    """Parse a time into seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|m|min|h)?", text.strip())
    if match is None or not float(match[1]) > 0:
        raise typer.BadParameter(f"expected a time such as 90s, 2m or 1h, got {text!r}")
    return float(match[1]) * {"s": 1, "m": 60, "min": 60, "h": 3600}[match[2] or "s"]


TimeOption = Annotated[
    float | None,
    typer.Option(
        parser=duration,
        metavar="TIME",
        help="Time for the whole run, roughly; recovery gets what the rest leaves: 90s, 2m or 1h.",
    ),
]
BackgroundOption = Annotated[
    Triple | None,
    typer.Option(
        parser=_colour,
        metavar="COLOUR",
        help="Background: black (default), white or R,G,B in [0, 1].",
    ),
]


def background_of(run: Run, given: Triple | None, *scenes: Path | None) -> Triple | None:
    """Return --background, otherwise that of the first run among the scenes, for `run.settle` as well.

    None means the default.
    """
    from g2ard.config.choices import colour_text
    from g2ard.io.detect import run_background

    if given is not None:
        return given
    found = ((scene, colour) for scene in filter(None, scenes) if (colour := run_background(scene)))
    scene, colour = next(found, (None, BLACK))
    if colour == BLACK:
        return None
    run.say(f"background: {colour_text(colour)}, as {scene} was made with")
    run.config["background"] = colour
    return Triple(colour)


TeacherOption = Annotated[
    Path | None,
    typer.Option(
        metavar="SCENE", help="Train on or score against renders of this scene instead of photos."
    ),
]
PhotosOption = Annotated[
    bool,
    typer.Option(
        "--photos",
        help="Use the photos of views even if they look unlike the scene; with --teacher, renders of it "
        "where there are none.",
    ),
]
ConventionOption = Annotated[
    Convention,
    typer.Option(help="Renderer to follow; inria has near plane 0.2 and cuts splats at 3σ tiles."),
]

PresetOption = Annotated[
    PresetName,
    typer.Option(
        help="Named settings: regularisers for a trained, lifted or noisy scene (auto measures it), or all "
        "settings of the paper. Other options win."
    ),
]
PaperOption = Annotated[
    PaperPresetName | None,
    typer.Option(
        help="Settings of the paper, or paper-trained, paper-lift, paper-noisy for its regularisers. "
        "Other options win.",
        metavar="[paper|paper-…]",
    ),
]


def views_count(text: str) -> Count | str:
    """Read K: a count, a share, or auto."""
    return "auto" if text.strip() == "auto" else Count.parse(text)


def check_engine(engine: str | None) -> None:
    """Check early that an engine can run."""
    if engine == "torch":
        require_torch("--engine torch")


def trained_on(split: str) -> str:
    """Return the name of the views a command trains on, for messages."""
    return "training views" if split == "train" else f"{split} views"
