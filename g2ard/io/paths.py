"""Paths as users give them: links that go in a circle, files that are none, names that leave their folder."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from g2ard.errors import InputError

_LONGEST = 200
"""Bytes of a name of a file: systems take 255, of which a suffix and temporary names need some."""


def real_path(path: str | Path) -> Path:
    """The path without links; one whose links go in a circle stays (`Path.resolve` raises there)."""
    return Path(os.path.realpath(path))


def check_regular(path: Path) -> None:
    """Refuse a pipe, a device or a socket: reading it could wait for ever, or never end.

    Raises:
        InputError: the path is neither a file, nor a folder, nor free.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError("not a regular file", path=path)


def output_names(path: str | Path, names: Sequence[str]) -> list[str]:
    """What views' names become as files of one folder, without suffix: no name leads out of it.

    Roots, drives and `..` go. Where two names differ in their suffix alone, both keep it.

    Args:
        path: the file of views, for errors.
        names: of the views.

    Raises:
        InputError: a name holds no name of a file, one of over 200 bytes, or comes to another's.

    >>> output_names("v.json", ["../images/a.png", "/b/c.jpg", "d.png", "d.jpg"])
    ['images/a', 'b/c', 'd.png', 'd.jpg']
    """
    found = [_inside(path, i, name) for i, name in enumerate(names)]
    stems = Counter(path.with_suffix("") for path in found)
    places = [path if stems[path.with_suffix("")] > 1 else path.with_suffix("") for path in found]
    times = Counter(places)
    for name, place in zip(names, places, strict=True):
        if times[place] > 1:
            raise InputError(f"{name!r} and another view would both be written as {str(place)!r}", path=path)
    return [str(place) for place in places]


def _inside(path: str | Path, i: int, name: str) -> PurePosixPath:
    parts = PurePosixPath(PureWindowsPath(name.replace("\0", "")).as_posix()).parts
    kept = [part for part in parts if part not in ("..", "/", "//") and not part.endswith((":", ":/"))]
    if not kept or "\0" in name or max(len(part.encode(errors="replace")) for part in kept) > _LONGEST:
        short = name if len(name) <= _LONGEST else f"{name[:_LONGEST]}…"
        raise InputError(f"has the name {short!r}, which cannot be a file's", path=path, index=i, item="view")
    return PurePosixPath(*kept)
