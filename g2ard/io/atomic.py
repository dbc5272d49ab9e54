"""Atomic outputs: written under a temporary name, then renamed."""

import os
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from g2ard.errors import OutputError


def check_output(path: str | Path, overwrite: bool = False, *, folder: bool = False) -> Path:
    """Return `path`, or raise an `OutputError` if an output cannot be written there.

    Args:
        overwrite: whether a file, or a folder that is not empty, may be replaced.
    """
    path = Path(path)
    try:
        _refuse_existing(path, overwrite, folder)
        parent = path.absolute().parent
        there = next(folder for folder in (parent, *parent.parents) if folder.exists())
        if not there.is_dir():
            raise OutputError(f"{there} is a file, not a folder", path=path)
        probe = _beside(there / path.name)
        probe.mkdir()
        probe.rmdir()
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(
            f"cannot write there: {error.strerror}", path=path, hint="give another output"
        ) from error
    return path


def _refuse_existing(path: Path, overwrite: bool, folder: bool) -> None:
    if not path.exists():
        return
    if path.is_dir() and not folder:
        raise OutputError("is a folder", path=path, hint="give the name of a file")
    if folder and not path.is_dir():
        raise OutputError("is a file", path=path, hint="give the name of a folder")
    if not overwrite and (not folder or any(path.iterdir())):
        raise _exists(path)


def _exists(path: Path) -> OutputError:
    return OutputError("exists", path=path, hint="{overwrite=True} replaces it")


def _beside(path: Path) -> Path:
    """Return a hidden name in the same folder, so that renaming is atomic, with the same suffix."""
    path = path.absolute()  # "." has no name
    return path.with_name(f".{path.stem}.{uuid4().hex[:12]}{path.suffix}")


def atomic_output(path: str | Path, overwrite: bool = False) -> AbstractContextManager[Path]:
    """Yield a temporary path with the same suffix, and rename it to `path` on success.

    On failure or Ctrl-C, the temporary file is removed and an existing `path` is kept. Without `overwrite`,
    so is a `path` that another process made in the meantime.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_output(folder / "a.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    >>> [p.name for p in folder.iterdir()]
    ['a.txt']
    """
    return _renamed(check_output(path, overwrite), overwrite, folder=False)


def atomic_folder(path: str | Path, overwrite: bool = False) -> AbstractContextManager[Path]:
    """Yield a temporary folder, and rename it to `path` on success.

    If `path` exists, files of the same name are replaced and other files are kept.
    """
    return _renamed(check_output(path, overwrite, folder=True), overwrite, folder=True)


@contextmanager
def _renamed(path: Path, overwrite: bool, *, folder: bool) -> Iterator[Path]:
    temporary, made = _beside(path), parents_made(path)
    try:
        if folder:
            temporary.mkdir()
        yield temporary
        if folder:
            _refuse_existing(path, overwrite, folder)
            if not path.exists():
                with suppress(FileExistsError):
                    path.mkdir()
            _move_into(temporary, path, overwrite)
        else:
            _move(temporary, path, overwrite)
    except OSError as error:
        elsewhere = error.filename is not None and not str(error.filename).startswith(str(temporary))
        if elsewhere or isinstance(error, OutputError):
            raise
        raise OutputError(f"cannot write: {error.strerror or error}", path=path) from error
    finally:
        if folder:
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)
        drop_empty(made)


def parents_made(path: Path) -> list[Path]:
    """Create missing parent folders and return them, innermost first."""
    absent = [folder for folder in path.absolute().parents if not folder.exists()]
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    return absent


def drop_empty(folders: list[Path]) -> None:
    """Remove those of the folders that are empty."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _move(source: Path, target: Path, overwrite: bool) -> None:
    """Rename a file; without `overwrite`, raise an `OutputError` if the target exists at that moment."""
    if overwrite:
        os.replace(source, target)
        return
    try:
        try:
            os.link(source, target)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            target.touch(exist_ok=False)
            os.replace(source, target)
        else:
            source.unlink()
    except FileExistsError:
        raise _exists(target) from None


def _move_into(source: Path, target: Path, overwrite: bool) -> None:
    for item in sorted(source.rglob("*")):
        place = target / item.relative_to(source)
        if item.is_dir():
            place.mkdir(exist_ok=True)
        else:
            _move(item, place, overwrite)
