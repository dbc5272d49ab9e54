"""Check the options of a command that works in tiles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from g2ard.cli.budget_options import TILES
from g2ard.cli.frame import Run
from g2ard.io.atomic import hidden_name

if TYPE_CHECKING:
    from g2ard.jobs.tiling import Tiling


def tiling_of(run: Run, scene: Path | None, output: Path) -> Tiling:
    """Check the options and return them as a `Tiling`."""
    from g2ard.jobs.cost import bytes_of
    from g2ard.jobs.tiling import Tiling

    tile_rows, memory, workers, scheduler, work = (run.shared[name] for name in TILES)
    rows = None if tile_rows is None else int(tile_rows.value)
    if rows is not None and scene is not None:
        _check_rows(scene, rows)
    with run.usage():
        size = None if memory is None else bytes_of(memory)
    if scheduler is not None and scheduler != "local" and "://" not in scheduler:
        raise typer.BadParameter(f"--scheduler: expected tcp://HOST:PORT or local, got {scheduler!r}")
    folder = work or _beside(output)
    run.claim("--work", folder, folder=True)
    return Tiling(rows, size, workers, run.threads or None, scheduler, folder, keep=work is not None)


def _beside(output: Path) -> Path:
    """Return the default folder for tiles: beside the output, outside folders with {ratio} or {count}.

    >>> [_beside(Path(name)).as_posix() for name in ("a/b.ply", "a/{ratio}x/run", "a/meta.json")]
    ['a/.b.ply.tiles', 'a/.ratiox.tiles', '.a.tiles']
    """
    if output.name == "meta.json":  # a SOG folder
        output = output.parent
    while "{" in str(output.parent):
        output = output.parent
    name = output.name.replace("{", "").replace("}", "")
    return output.with_name(hidden_name(name, ".tiles"))


def _check_rows(scene: Path, rows: int) -> None:
    """Raise a usage error if a folder of tiles was written with another --tile-rows."""
    from g2ard.io.detect import MANIFEST
    from g2ard.io.tile_store import TileStore
    from g2ard.jobs.tiling import cut_into

    if (scene / MANIFEST).is_file() and (made := TileStore.open(scene).settings.get("tile_rows")) != rows:
        held = f"already has tiles of {made:,}" if made else "already has tiles"
        raise typer.BadParameter(f"--tile-rows: {scene} {held}; to change them, run {cut_into(scene, rows)}")
