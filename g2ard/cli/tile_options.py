"""Options for scenes larger than memory: --tile-rows, --memory, --workers, --scheduler, --work."""

from pathlib import Path
from typing import Any

import typer

from g2ard.cli.budget_options import Count

TILES: dict[str, tuple[Any, ...]] = {
    "tile_rows": (
        Count | None,
        typer.Option(
            parser=Count.parse_absolute,
            metavar="COUNT",
            help="Maximum Gaussians per tile; larger scenes are processed in tiles. 5M by default.",
        ),
    ),
    "memory": (
        str | None,
        typer.Option(metavar="SIZE", help="Memory limit for all workers together, such as 4GB."),
    ),
    "workers": (
        int | None,
        typer.Option(min=1, help="Processes for tiles; by default as many as cores and memory allow."),
    ),
    "scheduler": (
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler for tiles: tcp://HOST:PORT or local (needs the extra `distributed`).",
        ),
    ),
    "work": (
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Keep tiles and finished steps here, for other budgets; by default in .NAME.tiles beside "
            "the output, until the command succeeds.",
        ),
    ),
}
"""Options of commands that work in tiles, see `g2ard.cli.frame.command`: name → type and option."""
