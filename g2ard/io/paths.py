"""Checks for files: links, special files, names that leave their folder, sizes when unpacked."""

import codecs
import hashlib
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from g2ard.errors import G2ardError, InputError

AnyPath = str | Path

# longest file name, bytes; systems allow 255, including suffixes and temporary names
_LONGEST_NAME = 200

_LARGEST_RATIO = 100
# bytes that any file may unpack to; larger ones are limited by `_LARGEST_RATIO`
_ALWAYS_UNPACKED = 64 << 20


def real_path(path: AnyPath) -> Path:
    """Return the path with links resolved; circular links are kept (`Path.resolve` would raise)."""
    return Path(os.path.realpath(path))


def beside(photo: Path | None, place: Path) -> str | None:
    """Return a photo's path relative to the folder of `place`."""
    if photo is None:
        return None
    photo = real_path(photo)
    folder = real_path(place.parent)
    try:
        return Path(os.path.relpath(photo, folder)).as_posix()
    except ValueError:  # another drive on Windows
        return photo.as_posix()


def is_special(path: Path) -> bool:
    """Return whether a path is a pipe, device or socket."""
    return path.exists() and not (path.is_file() or path.is_dir())


def check_regular(path: Path) -> None:
    """Raise an `InputError` for a pipe, device or socket, which might block forever."""
    if is_special(path):
        raise InputError("not a regular file", path=path)


def check_unpacked(packed: int, unpacked: int, path: Path | None = None) -> None:
    """Raise an `InputError` for data that unpacks to over 64 MiB and over 100 times its size, in bytes."""
    most = max(_ALWAYS_UNPACKED, _LARGEST_RATIO * packed)
    if unpacked > most:
        text = f"{packed:,} bytes would unpack to {unpacked:,}; the limit is {most:,}"
        raise InputError(text, path=path)


@contextmanager
def naming(path: AnyPath) -> Iterator[None]:
    """Let errors in the block that name neither a file nor a parameter name this file."""
    try:
        yield
    except G2ardError as error:
        if error.path is not None or error.parameter is not None:
            raise
        raise error.at(path=path) from error.__cause__


@contextmanager
def about(path: Path) -> Iterator[None]:
    """Do as `naming`, also for errors of the system."""
    with naming(path):
        try:
            yield
        except G2ardError:
            raise
        except OSError as error:
            raise InputError(error.strerror or str(error), path=path) from error


def read_text(path: Path) -> str:
    with about(path):
        return decoded(path.read_bytes())


def decoded(data: bytes) -> str:
    """Decode text in UTF-8, or in UTF-16 with a byte order mark, which is removed.

    Bytes of other character sets become surrogates, see `g2ard.io.finding.readable`.
    """
    encoding = "utf-8-sig"
    errors = "surrogateescape"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
        errors = "strict"
    try:
        text = data.decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise InputError("not a text file") from error
    if "\0" in text:
        raise InputError("not a text file")
    return text


def plain_numbers(text: str) -> str:
    """Return text in columns with the numbers that Python reads, separated by blanks.

    Decimal commas, further separators, and what Windows writes for numbers that are not finite are replaced.

    >>> plain_numbers("1,5;2;-nan(ind)"), plain_numbers("1.5,2, 1.#QNAN"), plain_numbers("1,2,3")
    ('1.5 2 nan', '1.5 2  nan', '1 2 3')
    """
    sample = text[:_SAMPLE]
    decimal = (
        re.search(r"\d,\d", sample)
        and not re.search(r"\d\.\d", sample)
        and re.search(r"\d[;\t ]", sample)
    )
    if decimal:
        text = re.sub(r"(?<=\d),(?=\d)", ".", text)
    text = text.replace(",", " ").replace(";", " ")
    if not re.search(r"nan\(|#|n/?[aou]", text, re.IGNORECASE):
        return text
    return NOT_FINITE.sub("nan", text)


_SAMPLE = 1 << 14  # characters that tell whether commas are decimal
NOT_FINITE = re.compile(r"[+-]?(nan\([^)\s]*\)|\d\.#\w+|\b(null|none|n/?a)\b)", re.IGNORECASE)
"""Numbers that are not finite, as C and C++ write them on Windows, and words for missing ones."""


def output_names(path: AnyPath, names: Sequence[str]) -> list[str]:
    """Return file names for views, without suffix, that stay inside one folder.

    Roots, drives and `..` are removed. Names that only differ in their suffix keep it. Names that are invalid
    or longer than 200 bytes, or equal, raise an `InputError` about the file of views, `path`.

    >>> output_names("v.json", ["../images/a.png", "/b/c.jpg", "d.png", "d.jpg"])
    ['images/a', 'b/c', 'd.png', 'd.jpg']
    """
    resolved = [_inside(path, i, name) for i, name in enumerate(names)]
    stems = [place.with_suffix("") for place in resolved]
    alike = Counter(stems)
    places = []
    for place, stem in zip(resolved, stems, strict=True):
        if alike[stem] == 1:
            place = stem
        places.append(str(place))
    times = Counter(places)
    for name, written in zip(names, places, strict=True):
        if times[written] > 1:
            text = f"{name!r} and another view would both be written as {written!r}"
            raise InputError(text, path=path)
    return places


def _inside(path: AnyPath, i: int, name: str) -> PurePosixPath:
    given = PureWindowsPath(name.replace("\0", ""))
    kept = [
        part
        for part in PurePosixPath(given.as_posix()).parts
        if part not in ("..", "/", "//") and not part.endswith((":", ":/"))
    ]
    sizes = [len(part.encode(errors="replace")) for part in kept]
    if not kept or "\0" in name or max(sizes) > _LONGEST_NAME:
        short = name
        if len(name) > _LONGEST_NAME:
            short = f"{name[:_LONGEST_NAME]}…"
        raise InputError(
            f"has the invalid file name {short!r}",
            path=path,
            index=i,
            item="view",
        )
    return PurePosixPath(*kept)


def file_identity(files: Iterable[Path]) -> list[Any]:
    """Return the name and a hash of the content of each file."""
    return [[path.name, content_hash(path)] for path in files]


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits, which takes 1 % of the time to decode a photo."""
    with about(path), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def user_cache() -> Path:
    """Return the folder in the user's cache for what can be made again or done without."""
    if sys.platform == "win32":
        usual = os.environ.get("LOCALAPPDATA")
    else:
        usual = os.environ.get("XDG_CACHE_HOME")
    try:
        caches = Path(usual or Path.home() / ".cache")
        cache = caches / "g2ard"
        cache.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # in a container, there may be no home, or only to read
        return Path(tempfile.gettempdir()) / "g2ard"
    return cache
