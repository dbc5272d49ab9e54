"""Helpers for PLY readers: headers, rows and errors that name the file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.errors import DAMAGED, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_OFFSET = re.compile(r"g2ard offset (\S+) (\S+) (\S+)$")
_HEADER_LIMIT = 1 << 20
"""Longest header, bytes."""

_END = re.compile(rb"^end_header[ \t]*[\r\n]", re.MULTILINE)


@dataclass
class PlyHeader:
    """A PLY header: row counts and properties per element, and comments."""

    counts: dict[str, int] = field(default_factory=dict)
    properties: dict[str, list[str]] = field(default_factory=dict)
    lists: dict[str, list[str]] = field(default_factory=dict)
    comments: list[str] = field(default_factory=list)


def read_header(path: Path) -> PlyHeader:
    """Read a header without the data."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_LIMIT)
    except OSError as error:
        raise InputError(f"{error.strerror}", path=path) from error
    if not head:
        raise InputError("is empty", path=path)
    if head[:3] != b"ply" or head[3:4] not in b"\r\n":
        raise InputError(
            f"is not a PLY file (begins with {head[:8]!r}, expected 'ply')",
            path=path,
            hint="export it again, or rename it to the suffix of its format",
        )
    end = _END.search(head)  # on a line of its own, since comments may contain it
    if end is None:
        raise InputError("broken PLY header: no end_header line", path=path, hint=DAMAGED)
    header = PlyHeader()
    for number, line in enumerate(re.split(r"\r\n|\r|\n", head[: end.start()].decode("latin-1")), 1):
        if not line.isascii():  # required by plyfile
            raise InputError(f"PLY header, line {number}: a character that is not ASCII", path=path)
        try:
            _header_line(header, line.split())
        except (IndexError, ValueError, KeyError) as error:
            raise InputError(
                f"broken PLY header, line {number}: {line.strip()[:80]!r}", path=path, hint=DAMAGED
            ) from error
    return header


def _header_line(header: PlyHeader, words: list[str]) -> None:
    if not words:
        return
    if words[0] == "comment":
        header.comments.append(" ".join(words[1:]))
    elif words[0] == "element":
        if not words[2].isdecimal():
            raise ValueError("no count")
        header.counts[words[1]] = int(words[2])
        header.properties[words[1]], header.lists[words[1]] = [], []
    elif words[0] == "property":
        owner = list(header.properties)[-1]
        (header.lists if words[1] == "list" else header.properties)[owner].append(words[-1])


def offset_of(path: Path, header: PlyHeader) -> NDArray[np.float64]:
    """Return the (3,) offset of a comment `g2ard offset X Y Z`; zeros without one."""
    import numpy as np

    for comment in header.comments:
        if match := _OFFSET.match(comment):
            try:
                offset = np.array([float(word) for word in match.groups()])
            except ValueError as error:
                raise InputError(f"broken comment {comment!r}", path=path, hint=DAMAGED) from error
            if not np.isfinite(offset).all():
                raise InputError(f"broken comment {comment!r}", path=path, hint=DAMAGED)
            return offset
    return np.zeros(3)


def read_element(path: Path, header: PlyHeader, *names: str) -> list[NDArray[Any]]:
    """Return the rows of elements, memory-mapped if the file is binary."""
    from plyfile import PlyData, PlyElementParseError, PlyParseError

    size = path.stat().st_size
    for name, count in header.counts.items():  # before allocating memory: a row has at least a byte
        if count > size:
            raise InputError(
                f"truncated: {count:,} rows of {name!r} in {size:,} bytes",
                path=path,
                hint=DAMAGED,
            )
    triangles = {name: dict.fromkeys(lists, 3) for name, lists in header.lists.items() if lists}
    try:
        try:
            ply = PlyData.read(path, mmap="r", known_list_len=triangles)
        except PlyElementParseError:
            if not triangles:
                raise
            ply = PlyData.read(path, mmap="r")  # polygons: slower
    except PlyElementParseError as error:
        raise _parse_error(path, header, error) from error
    except (PlyParseError, ValueError, OSError, OverflowError, MemoryError) as error:
        raise InputError(f"cannot be read as a PLY: {error}", path=path) from error
    return [ply[name].data for name in names]


def row_blocks(
    path: Path, every: NDArray[Any], rows: int, start: int = 0
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield an element's rows from `start` in blocks of `rows`, each with the index of its first row.

    Mapped rows are read with file reads, since mapped pages count as memory of the process.
    """
    import numpy as np

    for first in range(start, len(every), rows):
        count = min(rows, len(every) - first)
        if not isinstance(every, np.memmap):
            yield first, every[first : first + count]
            continue
        block = np.fromfile(path, every.dtype, count, offset=every.offset + first * every.itemsize)
        if len(block) < count:
            raise InputError("was truncated while it was read", path=path)
        yield first, block


def spread_rows(rows: NDArray[Any]) -> NDArray[Any]:
    """Return about 100,000 evenly spaced rows, without loading the pages between them."""
    import numpy as np

    step = max(1, len(rows) // 100_000)
    if not isinstance(rows, np.memmap) or step == 1:
        return np.asarray(rows[::step])
    parts = []
    with Path(rows.filename or "").open("rb", buffering=0) as file:
        for row in range(0, len(rows), step):
            file.seek(rows.offset + row * rows.itemsize)
            parts.append(file.read(rows.itemsize))
    return np.frombuffer(b"".join(parts), rows.dtype)


def _parse_error(path: Path, header: PlyHeader, error: Any) -> InputError:
    name = error.element.name
    return InputError(
        f"of {header.counts.get(name, 0)} cannot be read ({error.message})",
        path=path,
        property=error.prop and error.prop.name,
        index=error.row,
        item=f"{name} row",
        hint=DAMAGED,
    )


def require(path: Path, present: list[str], wanted: list[str], what: str) -> None:
    """Raise an `InputError` that lists the `wanted` properties that are not `present`."""
    missing = [name for name in wanted if name not in present]
    if missing:
        words = ", ".join(map(repr, missing))
        raise InputError(f"{what} needs the vertex property {words}", path=path)
