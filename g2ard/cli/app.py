"""The typer application, and its commands."""

from importlib import import_module
from typing import Annotated

import typer

COMMANDS = {
    "distill": "Distil a dense scene, or a coloured point cloud, into a compact scene.",
    "simplify": "Reduce a scene to an exact number of Gaussians; no images needed.",
    "recover": "Optimise a fixed set of Gaussians against photos or a teacher's renders.",
    "adapt": "Refit colours and opacities to new images; means, rotations and scales stay fixed.",
    "register": "Estimate camera poses of photos by matching them with renders of a scene.",
    "lift": "Turn a coloured point cloud into surface-aligned Gaussian discs, without training.",
    "ingest": "Split a scene of any size into tiles.",
    "convert": "Convert scenes to another format or other axes, and merge, crop or move them.",
    "clean": "Remove clutter: invisible Gaussians, giants, needles, floaters; haze on request.",
    "poses": "Generate views for a scene: poses in free space that see it well.",
    "select": "Select the most useful views, best first, each with a sampling weight.",
    "render": "Render views of a scene as PNG or as an animation.",
    "view": "Show one scene, or compare two, in the browser; -o writes an HTML page.",
    "lod": "Write levels of detail as streamed SOG or 3D Tiles.",
    "evaluate": "Score scenes against photos or a teacher's renders: PSNR, SSIM, edges, needles, overdraw.",
    "compare": "Compare renders of two scenes: PSNR, SSIM, the worst views, and a page to look at.",
    "info": "Show what a file holds: counts, extents, SH degree, opacities, overdraw, invalid values.",
}
"""Command → its line in `g2ard --help`, in that order; each is a module of `g2ard.cli.commands`."""


def _print_version(show: bool) -> None:
    if show:
        from g2ard._core import __version__

        typer.echo(f"g2ard {__version__}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool,
        typer.Option(
            "-V", "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    pass


def _create_app() -> typer.Typer:
    """Create an application without commands."""
    made = typer.Typer(
        help="Distil dense 3D Gaussian scenes into compact, standard 3DGS scenes of an exact size.",
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback()(_root)
    return made


app = _create_app()


def create_listing() -> typer.Typer:
    """Create an application that only lists the commands, for `g2ard --help`."""
    made = _create_app()
    for name, line in COMMANDS.items():
        made.command(name, help=line)(_do_nothing)
    return made


def _do_nothing() -> None:
    """Stand for a command that is only listed."""


def register_commands(asked: str | None = None) -> None:
    """Register the command `asked`, or all commands if there is no such command."""
    for name in (asked,) if asked in COMMANDS else COMMANDS:
        import_module(f"g2ard.cli.commands.{name}")
