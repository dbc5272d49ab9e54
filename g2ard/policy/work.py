"""The folder of a command in tiles: its alone while it lasts, and gone where it is of no more use."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.errors import G2ardError, OutputError
from g2ard.policy.tiled import Tiling, forget

if TYPE_CHECKING:
    from g2ard.policy.inputs import Views

__all__ = ["working"]

_OURS = re.compile(r"tiles|steps|(student|merged|level|written)-[0-9a-f]{16}")
"""What commands put into the folder."""


@contextmanager
def working(tiling: Tiling, *views: Views | None) -> Iterator[None]:
    """Hold `tiling.folder`, made if it is absent, while a command works on tiles there.

    Success removes it, unless the user named it. A refusal removes it if this command made it and nothing in
    it is worth keeping: that is what any step has made, and after errors of the output what was poured too.

    Args:
        tiling: of the command.
        views: that it is given; with its scheduler they are tried now, for pouring a scene takes long.

    Raises:
        InputError: the views cannot be read, or the scheduler does not answer.
        OutputError: the folder is a file, holds something else, or another process works there.
    """
    from g2ard.io.atomic import drop_empty, parents_made
    from g2ard.io.lock import locked

    folder = tiling.folder
    assert folder is not None
    _check_folder(folder)
    _check_given(tiling, views)
    made = not folder.exists()
    above = parents_made(folder)
    try:
        folder.mkdir(exist_ok=True)
        with locked(folder):
            try:
                yield
            except G2ardError as error:
                if made and not _worth_keeping(folder, error):
                    shutil.rmtree(folder, ignore_errors=True)
                elif not tiling.keep:
                    raise type(error)(f"{error}; {folder} keeps what is done") from error
                raise
            forget(tiling)
        with suppress(OSError):
            folder.rmdir()  # where the lock had to go first
    finally:
        drop_empty(above)


def _check_folder(folder: Path) -> None:
    """Refuse a folder of the user's own."""
    from g2ard.tiles.journal import is_ours

    try:
        names = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise OutputError(f"{folder}: cannot work there: {error.strerror}; name another folder") from error
    of_tiles = [name for name in names if is_ours(name)]
    others = [name for name in names if not name.startswith(".")]
    if of_tiles or (others and not any(map(_OURS.fullmatch, names))):
        raise OutputError(
            f"{folder}: holds {(of_tiles or others)[0]} and is no folder of such work; name another one"
        )


def _check_given(tiling: Tiling, views: tuple[Views | None, ...]) -> None:
    from g2ard.policy.inputs import load_view_sets
    from g2ard.policy.views import is_made

    for given in views:
        if given is not None and not is_made(given):
            load_view_sets(given, [], None, unpictured=True)
    if tiling.scheduler not in (None, "local"):
        from g2ard.tiles.cluster import DaskExecutor

        with DaskExecutor(tiling.scheduler, 1, 1):
            pass


def _worth_keeping(folder: Path, error: G2ardError) -> bool:
    """Whether a command that goes on after this error finds something done."""
    if any((folder / "steps").glob("[!.]*.npz")):
        return True
    return isinstance(error, OutputError) and any(path.name != "tiles" for path in folder.glob("[!.]*/[!.]*"))
