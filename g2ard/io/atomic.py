"""Atomic outputs: written under a temporary name, then renamed.

Links stay, and their targets are replaced. Devices, pipes and open files such as /dev/stdout are written to.
"""

import errno
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import uuid4

from g2ard.errors import OutputError
from g2ard.io.paths import AnyPath, is_special, real_path

_LONGEST_NAME = 255  # bytes of the longest file name of usual file systems


def check_output(
    path: AnyPath,
    overwrite: bool = False,
    *,
    folder: bool = False,
) -> Path:
    """Return `path`, or raise an `OutputError` if an output cannot be written there.

    Args:
        overwrite: whether a file, or a folder that is not empty, may be replaced.
    """
    path = Path(path)
    try:
        if is_stream(path) and not folder:
            _check_stream(path)
            return path
        _refuse_existing(path, overwrite, folder)
        parent = _target(path).absolute().parent
        there = next(folder for folder in (parent, *parent.parents) if folder.exists())
        if not there.is_dir():
            raise OutputError(f"{there} is a file, not a folder", path=path)
        probe = _beside(there / path.name)
        probe.mkdir()
        probe.rmdir()
    except OutputError:
        raise
    except OSError as error:
        text = f"cannot write there: {error.strerror}"
        raise OutputError(text, path=path, hint="give another output") from error
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


def is_taken(path: Path) -> bool:
    """Return whether a file or folder exists that an output would replace."""
    return path.exists() and not is_stream(path)


def is_stream(path: Path) -> bool:
    """Return whether a path is a device, a pipe or an open file of this process, so that it is written to."""
    return _descriptor(path) is not None or is_special(path)


def _descriptor(path: Path) -> int | None:
    """Return the open file of this process that a path or link names, such as 1 for /dev/stdout."""
    for _ in range(_MOST_LINKS):
        folder, name = os.path.split(os.path.abspath(path))
        if folder == "/dev" and name in _STREAMS:
            return _STREAMS[name]
        if folder in ("/dev/fd", "/proc/self/fd", f"/proc/{os.getpid()}/fd") and name.isdecimal():
            return int(name)
        if not os.path.islink(path):
            break
        path = Path(folder, os.readlink(path))
    return None


_STREAMS = {"stdout": 1, "stderr": 2}
_MOST_LINKS = 40  # as Linux follows


def _check_stream(path: Path) -> None:
    if path.is_block_device() or path.is_socket():
        raise OutputError("is a block device or socket", path=path, hint="give the name of a file")
    descriptor = _descriptor(path)
    if descriptor is not None:
        os.fstat(descriptor)
    elif not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def _target(path: Path) -> Path:
    """Return where a link leads, which need not exist."""
    if not path.is_symlink():
        return path
    target = real_path(path)
    if target.is_symlink():
        raise OutputError("is a link to itself", path=path, hint="give another output")
    return target


def _exists(path: Path) -> OutputError:
    return OutputError("exists", path=path, hint="{overwrite=True} replaces it")


def _beside(path: Path) -> Path:
    """Return a hidden name in the same folder, so that renaming is atomic, with the same suffix."""
    path = path.absolute()  # "." has no name
    return path.with_name(_hidden(path, uuid4().hex[:12]))


_ANY = 12 * "_"  # stands for the random part of a hidden name


def _hidden(path: Path, middle: str) -> str:
    return hidden_name(path.stem, f".{middle}{path.suffix}")


def drop_temporaries(folder: Path, *outputs: str) -> None:
    """Remove what killed processes left of outputs in a folder, or of all outputs if none is named.

    The caller holds the lock of the folder or of the outputs.
    """
    names = [re.escape(_hidden(Path(name), _ANY)).replace(_ANY, "[0-9a-f]{12}") for name in outputs]
    pattern = re.compile("|".join(names) or r"\..*\.[0-9a-f]{12}(\.[^.]*)?", re.DOTALL)
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if pattern.fullmatch(path.name):
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def hidden_name(name: str, ending: str) -> str:
    """Return `.NAME` + `ending`, which file systems accept if they accept `name`.

    A name that would exceed 255 bytes is shortened, and a hash of the whole name keeps it unique.

    >>> hidden_name("a.ply", ".tiles"), len(hidden_name(250 * "a", ".tiles"))
    ('.a.ply.tiles', 255)
    """
    room = _LONGEST_NAME - len(os.fsencode(f".{ending}"))
    data = os.fsencode(name)
    if len(data) > room:
        digest = sha256(data).hexdigest()[:16]
        name = data[: max(0, room - len(digest))].decode(errors="ignore") + digest
    return f".{name}{ending}"


def atomic_output(path: AnyPath, overwrite: bool = False) -> AbstractContextManager[Path]:
    """Yield a temporary path with the same suffix, and rename it to `path` on success.

    A link is kept, and its target replaced. A device or pipe is written to.

    On failure or Ctrl-C, the temporary file is removed and an existing `path` is kept. Without `overwrite`,
    so is a `path` that another process made in the meantime.
    """
    path = check_output(path, overwrite)
    if is_stream(path):
        return _copied(path)
    return _renamed(path, overwrite, folder=False)


def atomic_folder(path: AnyPath, overwrite: bool = False) -> AbstractContextManager[Path]:
    """Yield a temporary folder, and rename it to `path` on success.

    If `path` exists, files of the same name are replaced and other files are kept.
    """
    return _renamed(check_output(path, overwrite, folder=True), overwrite, folder=True)


@contextmanager
def _renamed(path: Path, overwrite: bool, *, folder: bool) -> Iterator[Path]:
    target = _target(path)
    temporary = _beside(target)
    made = parents_made(target)
    try:
        if folder:
            temporary.mkdir()
        yield temporary
        if folder:
            _refuse_existing(path, overwrite, folder)
            if not target.exists():
                with suppress(FileExistsError):
                    target.mkdir()
            _move_into(temporary, target, overwrite)
        else:
            _move(temporary, target, overwrite)
    except OSError as error:
        raise _failure(error, path, temporary) from error
    finally:
        _remove(temporary)
        drop_empty(made)


@contextmanager
def _copied(path: Path) -> Iterator[Path]:
    """Yield a temporary path, and copy its content into the device, pipe or open file `path` on success."""
    with TemporaryDirectory(prefix="g2ard-") as folder:
        temporary = Path(folder, path.name)
        try:
            yield temporary
            _pour(temporary, path)
        except OSError as error:
            raise _failure(error, path, temporary) from error


def _failure(error: OSError, path: Path, temporary: Path) -> OSError:
    """Return the `OutputError` of a failed output, or the error itself if it is about another file."""
    own = str(temporary), str(path)
    elsewhere = error.filename is not None and not str(error.filename).startswith(own)
    if elsewhere or isinstance(error, OutputError):
        return error
    return OutputError(f"cannot write: {error.strerror or error}", path=path)


def _pour(source: Path, stream: Path) -> None:
    for text in filter(None, (sys.stdout, sys.stderr)):
        text.flush()  # they may be the stream
    descriptor = _descriptor(stream)
    if descriptor is None:
        opened = os.open(stream, os.O_WRONLY)
    else:
        opened = os.dup(descriptor)  # at its position
    with source.open("rb") as content, open(opened, "wb") as target:
        shutil.copyfileobj(content, target)


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
    if is_stream(target):
        _pour(source, target)
        return
    target = _target(target)
    if overwrite:
        _replace(source, target)
        return
    try:
        try:
            os.link(source, target)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            target.touch(exist_ok=False)
            _replace(source, target)
        else:
            source.unlink()
    except FileExistsError:
        raise _exists(target) from None


def _replace(source: Path, target: Path) -> None:
    """Rename a file, also to another file system, where a link may lead."""
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        with atomic_output(target, overwrite=True) as temporary:
            shutil.copyfile(source, temporary)


def _move_into(source: Path, target: Path, overwrite: bool) -> None:
    """Move files, last those that name others, .json, those in subfolders first."""
    items = sorted(source.rglob("*"))
    for folder in filter(Path.is_dir, items):
        (target / folder.relative_to(source)).mkdir(exist_ok=True)
    files = (item for item in items if not item.is_dir())
    for item in sorted(files, key=lambda item: (item.suffix == ".json", -len(item.parts))):
        _move(item, target / item.relative_to(source), overwrite)
