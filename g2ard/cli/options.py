"""Option types that several commands share; budgets are in `budget_options`."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from g2ard.cli.budget_options import Count
from g2ard.config.choices import (
    BLACK,
    Convention,
    Engine,
    FormatName,
    Method,
    PaperPresetName,
    Policy,
    PresetName,
    ScheduleName,
)
from g2ard.report.window import Crop

if TYPE_CHECKING:
    from g2ard.cli.frame import Run
    from g2ard.scene.splats import Splats

SceneArgument = Annotated[
    Path, typer.Argument(metavar="SCENE", help="A .ply (3DGS), SOG, .spz, .glb, .splat or .compressed.ply.")
]
Protocol = Literal["pool", "standing", "both"]
ProtocolOption = Annotated[
    Protocol,
    typer.Option(
        help="Views that are scored: held out of the pool, or near ones and those where people stand.",
    ),
]
ViewsOption = Annotated[
    Path | None,
    typer.Option(
        "--views",
        metavar="VIEWS",
        help="A COLMAP folder, transforms.json, cameras.json, a trainer's run or g2ard's own .json.",
    ),
]


def _views_or_made(text: str) -> Path | str:
    """A word beside all paths: a folder of that name is ./made."""
    return "made" if text == "made" else Path(text)


def is_made(views: object) -> bool:
    """Whether `--views made` was given."""
    return views == "made"


ViewsOrMadeOption = Annotated[
    Path | None,
    typer.Option(
        "--views",
        parser=_views_or_made,
        metavar="VIEWS|made",
        help="A COLMAP folder, transforms.json, cameras.json, a trainer's run or g2ard's own .json; "
        "what lies beside the scene if not given; made: generated views instead.",
    ),
]
LookOption = Annotated[Path, typer.Option("--views", metavar="VIEWS", help="Where to look from.")]
OutputOption = Annotated[
    Path,
    typer.Option("-o", "--output", metavar="OUT", help="Where the result goes."),
]


def picture(text: str) -> Path:
    """Read the name of a picture that is written."""
    if Path(text).suffix.lower() != ".png":
        raise typer.BadParameter(f"pictures are written as .png, not {text!r}")
    return Path(text)


class Triple(tuple[float, float, float]):
    """Three numbers in one argument; a class, for typer reads a bare tuple as several."""


def _colour(text: str) -> Triple:
    named = {"black": Triple(BLACK), "white": Triple((1.0, 1.0, 1.0))}
    if text in named:
        return named[text]
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(0 <= v <= 1 for v in values):
        raise typer.BadParameter(f"black, white or three numbers in [0, 1] such as 0.2,0.3,0.4, not {text!r}")
    return Triple((values[0], values[1], values[2]))


def numbers(option: str, text: str, count: int) -> list[float]:
    """`count` finite numbers, parted by commas or blanks.

    >>> numbers("--box", "0, 0,0 1,1,1e1", 6)
    [0.0, 0.0, 0.0, 1.0, 1.0, 10.0]
    """
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise typer.BadParameter(f"{option}: expected {count} numbers with commas between, got {text!r}")
    return found


def _direction(text: str) -> Triple:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not (all(abs(v) < 1e30 for v in (x, y, z)) and any((x, y, z))):
        raise typer.BadParameter(f"a direction such as 0,0,1 or 0,-1,0, not {text!r}")
    return Triple((x, y, z))


UpOption = Annotated[
    Triple | None,
    typer.Option(
        parser=_direction,
        metavar="X,Y,Z",
        help="Away from the ground, for generated views; estimated unless given.",
    ),
]


class Spot(tuple[float, ...]):
    """A region as typed."""

    def __str__(self) -> str:
        return ",".join(f"{number:.17g}" for number in self)


def _spot(text: str) -> Spot:
    from g2ard.errors import InputError
    from g2ard.scene.regions import check_region

    try:
        return Spot(check_region([float(word) for word in text.replace(",", " ").split()]))
    except InputError as error:
        raise typer.BadParameter(error.message) from None
    except ValueError:
        raise typer.BadParameter(f"expected X,Y,Z,R or X,Y,Z,X,Y,Z, not {text!r}") from None


KeepRegionOption = Annotated[
    list[Spot] | None,
    typer.Option(
        "--keep-region",
        parser=_spot,
        metavar="X,Y,Z,R|X,Y,Z,X,Y,Z",
        help="More of the budget for a sphere or a box, scene units, as if views stood twice as near "
        "(--set keep_times=4); may be repeated.",
    ),
]
SplitOption = Annotated[
    str, typer.Option(metavar="train|test|all", help="By the views' split file, else every 8th name is test.")
]
ShDegreeOption = Annotated[
    int | None,
    typer.Option("--sh-degree", min=0, max=3, help="Of the result; the scene's own if not given."),
]
FormatOption = Annotated[
    FormatName,
    typer.Option("--format", case_sensitive=False, help="Of the scene's file in RUN."),
]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Resume an interrupted run.")]
SizeOption = Annotated[
    int | None,
    typer.Option(min=16, metavar="PIXELS", help="Shrink views to this longer side."),
]
BackgroundOption = Annotated[
    Triple | None,
    typer.Option(parser=_colour, metavar="COLOUR", help="black (the default), white or R,G,B in [0, 1]."),
]
SkyOption = Annotated[
    Triple | None,
    typer.Option(
        parser=_colour, metavar="COLOUR", help="black, white or R,G,B in [0, 1]; 0.6,0.8,1 if not given."
    ),
]
TeacherOption = Annotated[
    Path | None,
    typer.Option("--teacher", metavar="SCENE", help="Its renders are the targets; without it, the photos."),
]

ConventionOption = Annotated[
    Convention,
    typer.Option(help="The renderer's conventions; inria: near plane 0.2, splats cut to their 3σ tiles."),
]


def _crop(text: str) -> Crop:
    from g2ard.errors import InputError

    try:
        return Crop.parse(text)
    except InputError as error:
        raise typer.BadParameter(error.message) from None


CropOption = Annotated[
    list[Crop] | None,
    typer.Option(
        "--crop",
        parser=_crop,
        metavar="[VIEW:]X,Y,W,H",
        help="Magnify this in the report: left, top, width, height in shares of the image "
        "(front.png:0.4,0.3,0.2,0.2); may be repeated.",
        hidden=True,
    ),
]

PresetOption = Annotated[
    PresetName,
    typer.Option(
        help="Settings by name: regularisers that hold the geometry, measured by auto; or all as in the"
        " paper, except what other options say."
    ),
]
PaperOption = Annotated[
    PaperPresetName | None,
    typer.Option(
        "--preset",
        help="paper, or with a row of its regularisers paper-trained, paper-lift, paper-noisy: all as in the"
        " paper, except what other options say.",
        metavar="[paper|paper-…]",
    ),
]
ScheduleOption = Annotated[
    ScheduleName | None,
    typer.Option(
        help="Rates and horizon: fast, 300 steps, default, 1,000, or best, 6,000; paper also goes by rounds."
    ),
]
StepsOption = Annotated[
    int | None,
    typer.Option(min=1, help="Steps of the last recovery, instead of the schedule's."),
]
MethodOption = Annotated[Method | None, typer.Option(help="How to simplify: default unless given.")]


def _duration(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|m|min|h)?", text.strip())
    if match is None or not float(match[1]) > 0:
        raise typer.BadParameter(f"a time such as 90s, 2m or 1h, not {text!r}")
    return float(match[1]) * {"s": 1, "m": 60, "min": 60, "h": 3600}[match[2] or "s"]


RecoveryTimeOption = Annotated[
    float | None,
    typer.Option(
        "--recovery-time",
        parser=_duration,
        metavar="TIME",
        help="Fit recovery, and no other part, into 90s, 2m or 1h.",
    ),
]


def views_count(text: str) -> Count | str:
    """Read K: a count, a share, or auto."""
    return "auto" if text.strip() == "auto" else Count.parse(text)


PolicyOption = Annotated[Policy | None, typer.Option("--policy", help="What makes views good.")]


def recovery_engine(run: Run) -> Engine:
    """What takes recovery's steps on the device asked for.

    Raises:
        InputError: CUDA was asked for and is not to be had.
    """
    if run.device != "cuda":
        return "fused"
    from g2ard.system.extras import require_torch

    require_torch("--device cuda")
    from g2ard.stages.recover.gsplat_engine import check_cuda

    check_cuda()
    return "gsplat"


def trained_on(split: str) -> str:
    """What to call the views that a command has fitted."""
    return "training views" if split == "train" else f"{split} views"


def can_be_made(views: Path | None, teacher: Path | None) -> None:
    """Usage check: where no views are given, a teacher is there to be looked at."""
    if teacher is None and is_made(views):
        raise typer.BadParameter("--teacher is missing: views that are made have no photos; name a scene")
    if teacher is None and views is None:
        raise typer.BadParameter("give --views, or a --teacher to make views of")


def views_or_teacher(run: Run, views: Path | None, teacher: Path | None, dense: Splats | None) -> Any:
    """The views given, else those beside the teacher, else a pool of it; see `can_be_made`."""
    from g2ard.policy.views import views_or_pool

    if dense is None:
        return views
    return views_or_pool(dense, views, beside=teacher, seed=run.seed, progress=run.progress, say=run.say)
