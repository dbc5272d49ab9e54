"""Outputs that are there whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from g2ard.errors import OutputError


def check_output(path: str | Path, overwrite: bool = False, *, folder: bool = False) -> Path:
    """Refuse an output that cannot be written, before hours of work rather than after.

    Args:
        path: where the output is to go.
        overwrite: whether a file, or a folder that is not empty, may be replaced.
        folder: whether the output is a folder.

    Returns:
        `path` as a Path.

    Raises:
        OutputError: it exists and may not be overwritten, is of the other kind, or its folder is not
            writable. A folder that is absent is made when the output is written.
    """
    path = Path(path)
    try:
        _refuse_existing(path, overwrite, folder)
        parent = path.absolute().parent
        there = next(folder for folder in (parent, *parent.parents) if folder.exists())
        if not there.is_dir():
            raise OutputError(f"{there} is a file; a folder is needed there", path=path)
        probe = _beside(there / path.name)
        probe.mkdir()
        probe.rmdir()
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write there: {error.strerror}; name another place", path=path) from error
    return path


def _refuse_existing(path: Path, overwrite: bool, folder: bool) -> None:
    if not path.exists():
        return
    if path.is_dir() and not folder:
        raise OutputError("is a folder; a file is to be written there: name one in it", path=path)
    if folder and not path.is_dir():
        raise OutputError("is a file; a folder is to be written there: name another", path=path)
    if not overwrite and (not folder or any(path.iterdir())):
        raise OutputError("exists", path=path, hint="{overwrite=True} replaces it")


def _beside(path: Path) -> Path:
    """A hidden name in the same folder, so that the rename stays on one disk; the suffix is kept for
    writers that choose a format by it."""
    path = path.absolute()  # "." has no name
    return path.with_name(f".{path.stem}.{uuid4().hex[:12]}{path.suffix}")


@contextmanager
def atomic_output(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path to write to; on success it becomes `path` in one step.

    On any failure, Ctrl-C included, the temporary file goes and what was at `path` stays.

    Args:
        path: the file to write.
        overwrite: whether an existing file may be replaced.

    Yields:
        A path in the same folder, with the same suffix, where nothing exists yet.

    Raises:
        OutputError: see `check_output`; or the disk refuses while writing.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_output(folder / "a.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    >>> [p.name for p in folder.iterdir()]
    ['a.txt']
    """
    path = check_output(path, overwrite)
    temporary, made = _beside(path), parents_made(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if isinstance(error, OutputError) or error.filename not in (None, str(temporary), temporary):
            raise
        raise OutputError(f"cannot write: {error.strerror or error}", path=path) from error
    finally:
        temporary.unlink(missing_ok=True)
        drop_empty(made)


@contextmanager
def atomic_folder(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder to fill; on success it becomes `path`.

    Where `path` already is a folder (and `overwrite` allows it) files of the same name are replaced one by
    one and others are left alone: a mistyped output folder loses nothing of its own.

    Raises:
        OutputError: see `check_output`; or the disk refuses while writing.
    """
    path = check_output(path, overwrite, folder=True)
    temporary, made = _beside(path), parents_made(path)
    try:
        temporary.mkdir()
        yield temporary
        if path.is_dir():
            _move_into(temporary, path)
        else:
            os.replace(temporary, path)
    except OSError as error:
        if isinstance(error, OutputError) or not str(error.filename or "").startswith(str(temporary)):
            raise
        raise OutputError(f"cannot write: {error.strerror or error}", path=path) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        drop_empty(made)


def parents_made(path: Path) -> list[Path]:
    """Make the folders above `path` that are absent; those made, innermost first."""
    absent = [folder for folder in path.absolute().parents if not folder.exists()]
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    return absent


def drop_empty(folders: list[Path]) -> None:
    """Nothing came of an output: the folders made for it go again."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _move_into(source: Path, target: Path) -> None:
    for item in sorted(source.rglob("*")):
        place = target / item.relative_to(source)
        if item.is_dir():
            place.mkdir(exist_ok=True)
        else:
            os.replace(item, place)
