"""Folder locks between processes, released by the operating system when the holder dies."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from g2ard.errors import OutputError
from g2ard.io.atomic import hidden_name

LOCK = ".lock"
"""Lock file with the holder's process id. The holder removes it; one left by a killed process is reused."""

if sys.platform == "win32":
    import msvcrt

    _FAR = 1 << 30
    """Locked byte, past the text, since locked bytes cannot be read."""

    def _lock(file: int) -> None:
        os.lseek(file, _FAR, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)

    def _release(path: Path, file: int) -> None:
        os.close(file)  # open files cannot be removed
        with suppress(OSError):
            path.unlink()

else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _release(path: Path, file: int) -> None:
        # before releasing, so that waiting processes see that it is gone
        path.unlink(missing_ok=True)
        os.close(file)


@contextmanager
def locked(folder: Path, output: str | None = None) -> Iterator[None]:
    """Lock an existing folder, or one output in it, or raise an `OutputError` if another process holds it.

    File systems without locks are not locked.
    """
    path = lock_file(folder, output)
    file = _opened(path)
    shown = folder
    if output is not None:
        shown = folder / output
    while not _held(path, file, shown):  # removed by its holder after it was opened
        os.close(file)
        file = _opened(path)
    try:
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, str(os.getpid()).encode())
        yield
    finally:
        _release(path, file)


def check_unlocked(folder: Path, output: str | None = None) -> None:
    """Raise an `OutputError` if another process holds the lock of a folder, or of one output in it."""
    if lock_file(folder, output).exists():
        with locked(folder, output):
            pass


def lock_file(folder: Path, output: str | None) -> Path:
    """Return the lock file of a folder, or of one output in it."""
    if output is None:
        return folder / LOCK
    return folder / hidden_name(output, LOCK)


def _opened(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise OutputError(f"cannot write there: {error.strerror}", path=path.parent) from error


def _held(path: Path, file: int, shown: Path) -> bool:
    """Lock the file and return whether it is still the one at `path`."""
    try:
        _lock(file)
    except (BlockingIOError, PermissionError):
        os.lseek(file, 0, os.SEEK_SET)
        holder = os.read(file, 20).decode("ascii", "replace").strip("\0 ")
        os.close(file)
        who = "another process"
        if holder.isdecimal():
            who = f"process {holder}"
        hint = "wait for it, or give another output"
        raise OutputError(f"in use by {who}", path=shown, hint=hint) from None
    except OSError:
        return True  # no locks on this file system
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except OSError:
        return False
