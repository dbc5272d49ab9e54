"""One process at a time in a folder: a lock that the operating system takes back when its holder dies."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from g2ard.errors import OutputError

LOCK = ".lock"
"""The file in the folder; it names the process, which removes it. One of a killed process is used again."""

if sys.platform == "win32":
    import msvcrt

    _FAR = 1 << 30
    """The byte that is locked: behind the text, which could not be read under a lock."""

    def _lock(file: int) -> None:
        os.lseek(file, _FAR, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)

    def _release(path: Path, file: int) -> None:
        os.close(file)  # what is open cannot be removed
        with suppress(OSError):
            path.unlink()

else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _release(path: Path, file: int) -> None:
        path.unlink(missing_ok=True)  # while it is held: who opened it before sees that it is gone
        os.close(file)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder that is there; where the file system knows no locks it is held by nobody.

    Raises:
        OutputError: another process holds it, or nothing can be written there.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with locked(folder):
    ...     [path.name for path in folder.iterdir()]
    ['.lock']
    >>> list(folder.iterdir())
    []
    """
    path = folder / LOCK
    file = _opened(path)
    while not _held(path, file):  # its holder removed it after it was opened
        os.close(file)
        file = _opened(path)
    try:
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, str(os.getpid()).encode())
        yield
    finally:
        _release(path, file)


def _opened(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise OutputError(f"cannot write there: {error.strerror}", path=path.parent) from error


def _held(path: Path, file: int) -> bool:
    """Whether the lock is had, on the file that is at `path` still."""
    try:
        _lock(file)
    except (BlockingIOError, PermissionError):
        os.lseek(file, 0, os.SEEK_SET)
        holder = os.read(file, 20).decode("ascii", "replace").strip("\0 ")
        os.close(file)
        who = f"process {holder}" if holder.isdecimal() else "another process"
        raise OutputError(f"in use by {who}; wait for it, or name another folder", path=path.parent) from None
    except OSError:
        return True  # no locks on this file system
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except OSError:
        return False
