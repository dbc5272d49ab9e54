"""Options of a command that works in tiles, and the folder that holds its work."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from g2ard.cli.budget_options import TILES
from g2ard.cli.run import Run
from g2ard.config.choices import is_given
from g2ard.errors import G2ardError, OutputError
from g2ard.io.atomic import drop_empty, hidden_name, parents_made
from g2ard.io.lock import check_unlocked, locked

if TYPE_CHECKING:
    from g2ard.io import Source
    from g2ard.jobs.inputs import Views
    from g2ard.jobs.tile_options import Tiling


_WORK_NAME = re.compile(r"tiles|steps|(cleaned|merged|level|written)-[0-9a-f]{16}")
"""Names that commands create in the work folder."""


def read_tiling(run: Run, source: Source | None, output: Path) -> Tiling:
    """Check the options and return them as a `Tiling`."""
    from g2ard.jobs.memory import parse_bytes
    from g2ard.jobs.tile_options import Tiling

    tile_rows, memory, workers, scheduler, work = (run.shared.get(name) for name in TILES)
    rows = None if tile_rows is None else int(tile_rows.value)
    if rows is not None and source is not None:
        _check_rows(source, rows)
    with run.usage():
        size = None if memory is None else parse_bytes(memory)
    if scheduler is not None and scheduler != "local" and "://" not in scheduler:
        raise typer.BadParameter(
            f"--scheduler: expected tcp://HOST:PORT or local, got {scheduler!r}"
        )
    folder = work or _place_beside(output)
    run.claim("--work", folder, folder=True)
    cores = run.threads or None
    renew = work is None or run.overwrite
    return Tiling(
        rows, size, workers, cores, scheduler, folder, keep=work is not None, overwrite=renew
    )


def _place_beside(output: Path) -> Path:
    """Return the default folder for tiles: beside the output, outside folders with {ratio} or {count}.

    >>> [_place_beside(Path(name)).as_posix() for name in ("a/b.ply", "a/{ratio}x/run", "a/meta.json")]
    ['a/.b.ply.tiles', 'a/.ratiox.tiles', '.a.tiles']
    """
    if output.name == "meta.json":  # a SOG folder
        output = output.parent
    while "{" in str(output.parent):
        output = output.parent
    name = output.name.replace("{", "").replace("}", "")
    return output.with_name(hidden_name(name, ".tiles"))


def _check_rows(source: Source, rows: int) -> None:
    """Raise a usage error if a folder of tiles was written with another --tile-rows."""
    from g2ard.jobs.tile_options import cut_into

    if source.store is not None and (made := source.store.settings.get("tile_rows")) != rows:
        held = f"already has tiles of {made:,}" if made else "already has tiles"
        other = cut_into(source.path, rows)
        raise typer.BadParameter(f"--tile-rows: {source} {held}; to change them, run {other}")


@contextmanager
def work_folder(
    run: Run, tiling: Tiling | None, *views: Views | None, again: str = ""
) -> Iterator[None]:
    """Hold `tiling.folder`, created if absent, while a command works on tiles there; do nothing for None.

    Finished tasks in it are not computed again, with or without --resume and --overwrite: their names hash
    all that they depend on. Success removes the folder unless the user named it. An error removes it if this
    command created it and a resumed run would find nothing in it: no finished task and, after errors of the
    output, no tiles either.

    Args:
        views: given to the command; they are read now, and the scheduler is tried, because writing tiles
            takes long.
        again: option with which the same command continues.
    """
    if tiling is None:
        yield
        return
    folder = tiling.folder
    _check_folder(folder)
    _check_given(tiling, views)
    made = not folder.exists()
    above = parents_made(folder)
    try:
        folder.mkdir(exist_ok=True)
        with locked(folder):
            try:
                yield
            except Exception as error:  # usage errors too, which the command line raises
                if made and not _worth_keeping(folder, error):
                    shutil.rmtree(folder, ignore_errors=True)
                elif not tiling.keep and isinstance(error, G2ardError):
                    run.kept.insert(0, f"finished work is kept in {folder}")
                raise
            except KeyboardInterrupt:
                left = f"finished steps are in {folder}"
                # checkpoints of recovery name the way themselves
                if not any("to continue" in text for text in run.kept):
                    left += f"; run the same command{again} to continue"
                run.kept.insert(0, left)
                raise
            if not tiling.keep:
                shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):
            folder.rmdir()  # where the lock had to go first
    finally:
        drop_empty(above)


def drop_work(tiling: Tiling) -> None:
    """Remove the tiles and steps of a run that was killed after its last output."""
    if not tiling.keep and tiling.folder.exists():
        _check_folder(tiling.folder)
        check_unlocked(tiling.folder)
        shutil.rmtree(tiling.folder, ignore_errors=True)


def _check_folder(folder: Path) -> None:
    """Reject a folder that holds anything but tiled work."""
    try:
        names = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror}; choose another folder", path=folder
        ) from error
    from g2ard.tiles.writer import is_tile_file

    of_tiles = [name for name in names if is_tile_file(name)]
    others = [name for name in names if not name.startswith(".")]
    if of_tiles or (others and not any(map(_WORK_NAME.fullmatch, names))):
        raise OutputError(
            f"holds {(of_tiles or others)[0]} and is not a work folder; choose another folder",
            path=folder,
        )


def _check_given(tiling: Tiling, views: Sequence[Views | None]) -> None:
    from g2ard.jobs.inputs import load_view_sets
    from g2ard.tiles.executor import executor

    for given in views:
        if given is not None and is_given(given):
            load_view_sets(given, [], None, unpictured=True)
    if tiling.scheduler not in (None, "local"):
        with executor(scheduler=tiling.scheduler):
            pass


def _worth_keeping(folder: Path, error: Exception) -> bool:
    """Return whether a command that resumes after this error finds something done."""
    if any((folder / "steps").glob("[!.]*.npz")):
        return True
    return isinstance(error, OutputError) and any(
        path.name != "tiles" for path in folder.glob("[!.]*/[!.]*")
    )
