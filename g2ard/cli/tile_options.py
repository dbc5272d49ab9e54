"""Options for scenes larger than memory: --tile-rows, --memory, --workers, --scheduler, --work."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from g2ard.cli.budget_options import Count
from g2ard.cli.usage import in_flags

if TYPE_CHECKING:
    from g2ard.cli.frame import Run
    from g2ard.policy.tiling import Tiling

TileRowsOption = Annotated[
    Count | None,
    typer.Option(
        parser=Count.parse_absolute,
        metavar="COUNT",
        help="A scene of more Gaussians is worked on in tiles of at most so many; 5M if not given.",
        hidden=True,
    ),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(metavar="SIZE", help="Memory that all workers together may take, such as 4GB."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, help="Processes that work on tiles; as many as cores and memory allow if not given."),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Tiles on a Dask cluster: tcp://HOST:PORT, or local (extra distributed).",
        hidden=True,
    ),
]
WorkOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Keep tiles and steps here, for other budgets; else, until all is done, beside the output "
        "in .NAME.tiles.",
        hidden=True,
    ),
]


def tiling_of(
    run: Run,
    scene: Path | None,
    output: Path,
    tile_rows: Count | None,
    memory: str | None,
    workers: int | None,
    scheduler: str | None,
    work: Path | None,
) -> Tiling:
    """The options as the library takes them, after a usage check."""
    from g2ard.errors import InputError
    from g2ard.policy.tiling import Tiling, bytes_of

    if tile_rows is not None and scene is not None:
        _check_rows(scene, tile_rows.of(0))
    try:
        size = None if memory is None else bytes_of(memory)
    except InputError as error:
        raise typer.BadParameter(in_flags(error, run.flags)) from None
    if scheduler is not None and scheduler != "local" and "://" not in scheduler:
        raise typer.BadParameter(f"--scheduler: tcp://HOST:PORT or local, not {scheduler!r}")
    return Tiling(
        None if tile_rows is None else tile_rows.of(0),
        size,
        workers,
        run.threads or None,
        scheduler,
        work or _beside(output),
        keep=work is not None,
    )


def _beside(output: Path) -> Path:
    """Where tiles and steps lie: beside what is made, never within it, nor in a folder that {ratio} or
    {count} names.

    >>> [_beside(Path(name)).as_posix() for name in ("a/b.ply", "a/{ratio}x/run", "a/meta.json")]
    ['a/.b.ply.tiles', 'a/.ratiox.tiles', '.a.tiles']
    """
    if output.name == "meta.json":  # of a folder of SOG
        output = output.parent
    while "{" in str(output.parent):
        output = output.parent
    name = output.name.replace("{", "").replace("}", "")
    return output.with_name(f".{name}.tiles")


def _check_rows(scene: Path, rows: int) -> None:
    """Tiles in a folder have the rows they were made with."""
    from g2ard.policy.tiling import cut_into
    from g2ard.tiles.store import MANIFEST, TileStore

    if (scene / MANIFEST).is_file() and (made := TileStore.open(scene).settings.get("tile_rows")) != rows:
        held = f"is in tiles of {made:,} already" if made else "is in tiles already"
        raise typer.BadParameter(f"--tile-rows: {scene} {held}; {cut_into(scene, rows)} makes others")
