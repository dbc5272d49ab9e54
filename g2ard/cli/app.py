"""The typer application, and its commands."""

from importlib import import_module
from typing import Annotated

import typer

COMMANDS = (
    "distill",
    "simplify",
    "recover",
    "adapt",
    "register",
    "lift",
    "ingest",
    "convert",
    "clean",
    "poses",
    "select",
    "render",
    "view",
    "lod",
    "evaluate",
    "compare",
    "info",
)
"""Names of commands in the order of `g2ard --help`; each is a module of `g2ard.cli.commands`."""

app = typer.Typer(
    help="Distil dense 3D Gaussian scenes into compact, standard 3DGS scenes of an exact size.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(show: bool) -> None:
    if show:
        from g2ard._core import __version__

        typer.echo(f"g2ard {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("-V", "--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def register_commands(asked: str | None = None) -> None:
    """Register the command `asked`, or all commands if there is no such command."""
    for name in (asked,) if asked in COMMANDS else COMMANDS:
        import_module(f"g2ard.cli.commands.{name}")
