"""The typer application that commands register on."""

from __future__ import annotations

from typing import Annotated

import typer

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
