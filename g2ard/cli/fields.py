"""Flags of settings, by the paths of the settings; `g2ard.cli.command.command` adds them to commands."""

from typing import Annotated

import typer

from g2ard.cli.budget_options import Options
from g2ard.cli.options import duration
from g2ard.config.choices import (
    AdaptSchedule,
    Engine,
    Focus,
    Method,
    Policy,
    Refinement,
    ScheduleName,
)
from g2ard.errors import InputError


class Spot(tuple[float, ...]):
    """Sphere or box as typed."""

    def __str__(self) -> str:
        return ",".join(f"{number:.17g}" for number in self)


def _spot(text: str) -> Spot:
    from g2ard.scene.regions import check_region

    try:
        return Spot(check_region([float(word) for word in text.replace(",", " ").split()]))
    except InputError as error:
        raise typer.BadParameter(error.message) from None
    except ValueError:
        raise typer.BadParameter(f"expected X,Y,Z,R or X,Y,Z,X,Y,Z, got {text!r}") from None


_SH_DEGREE = typer.Option(
    min=0, max=3, help="SH degree of the result; by default that of the scene."
)
ShDegreeOption = Annotated[int | None, _SH_DEGREE]
_ENGINE = typer.Option(
    help="Engine of the steps, with equal results up to rounding: fused (Rust or --device gpu, the "
    "default) or torch (autograd; needs the extra `torch`)."
)
FIELDS: Options = {
    "simplify.method": (Method, typer.Option(help="Simplification method.")),
    "simplify.keep_region": (
        list[Spot],
        typer.Option(
            parser=_spot,
            metavar="X,Y,Z,R|X,Y,Z,X,Y,Z",
            help="Keep more detail in a sphere or box, scene units; repeatable. "
            "--set keep_times=N changes how much (4).",
        ),
    ),
    "select.policy": (Policy, typer.Option(help="Selection criterion.")),
    "select.focus": (
        Focus,
        typer.Option(
            help="Make half of the training views of this kind; far: only the usual ones."
        ),
    ),
    "recover.schedule": (
        ScheduleName,
        typer.Option(
            help="Recovery schedule: fast, default or best (at least 100, 800 or 4,800 steps, more for "
            "photos and rooms), or paper (in rounds)."
        ),
    ),
    "recover.steps": (
        int,
        typer.Option(
            min=1, help="Steps of the last recovery; by default as many as the schedule needs."
        ),
    ),
    "recover.recovery_time": (
        float,
        typer.Option(
            parser=duration, metavar="TIME", help="Time limit for recovery alone: 90s, 2m or 1h."
        ),
    ),
    **{f"{stage}.sh_degree": (int, _SH_DEGREE) for stage in ("recover", "adapt")},
    **{f"{stage}.engine": (Engine, _ENGINE) for stage in ("recover", "adapt")},
    "adapt.steps": (
        int,
        typer.Option(
            min=1, help="Maximum steps; by default 50 per image, at least 250 and at most 7,000."
        ),
    ),
    "adapt.tolerance": (
        float,
        typer.Option(
            min=0,
            help="Stop when PSNR gains less than this, dB; 0.05 by default, 0 runs all steps.",
        ),
    ),
    "adapt.schedule": (AdaptSchedule, typer.Option(help="Learning rates and decay.")),
    "adapt.prior_views": (
        float,
        typer.Option(
            min=0,
            help="Weight of the old appearance, as a number of views; 1 by default, 0 in the paper.",
        ),
    ),
    "register.size": (
        int,
        typer.Option(
            min=32, metavar="PIXELS", help="Shrink photos to this longer side; 1000 by default."
        ),
    ),
    "register.matcher": (
        str,
        typer.Option(
            metavar="auto|sift|direct|MODULE:FUNCTION",
            help="Feature matcher: SIFT, none (direct alignment only), or your own function. "
            "All but direct need the extra `register`; auto, the default, uses SIFT if it is installed.",
        ),
    ),
    "register.refine": (
        Refinement,
        typer.Option(help="How to refine poses from feature matching; auto by default."),
    ),
    "register.passes": (
        int,
        typer.Option(min=1, help="Maximum renders to match per photo; 3 by default."),
    ),
    "register.accept": (
        float,
        typer.Option(min=0.01, max=1, help="Lowest ZNCC of a registered photo; 0.6 by default."),
    ),
}
"""Path of a setting → type and option of its flag."""
