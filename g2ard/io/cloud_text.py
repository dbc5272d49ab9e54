"""Reader for coloured point clouds in tables: text (.xyz, .txt, .pts, .asc, .csv) and PCL's .pcd."""

import io
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, damaged
from g2ard.io import judge
from g2ard.io.paths import plain_numbers, read_text
from g2ard.io.signs import is_table
from g2ard.io.stream import MarkedPoints, PointStream

_COLUMNS = {
    "x": ("x", "easting"),
    "y": ("y", "northing"),
    "z": ("z", "height", "altitude"),
    "red": ("red", "r"),
    "green": ("green", "g"),
    "blue": ("blue", "b"),
    "intensity": ("intensity", "i", "reflectance", "scalar_intensity"),
}
"""Columns and their names in headings, in small letters."""

_SHADES = ("red", "green", "blue"), ("intensity",)
"""Columns that colour points, the best first."""

_TRIPLES = {6: (3,), 7: (4, 3), 8: (3, 4, 5), 9: (3, 6), 10: (3, 4, 6, 7)}
"""Number of columns without a heading → where colours may begin, the likeliest first."""

_TYPES = {
    "F4": "<f4",
    "F8": "<f8",
    "U1": "u1",
    "U2": "<u2",
    "U4": "<u4",
    "I1": "i1",
    "I2": "<i2",
    "I4": "<i4",
}
"""Types of .pcd by letter and size."""

_LINES, _HEAD = 50, 1 << 16  # lines that may be a heading, and bytes that tell whether a text is a table


class Stream(PointStream):
    """Points of a table, which is read whole. Without colours they are grey by their intensities."""

    def __init__(self, path: Path) -> None:
        names, table = _pcd(path) if path.suffix.lower() == ".pcd" else _text(path, read_text(path))
        column = {
            key: names.index(own)
            for key, spelled in _COLUMNS.items()
            if (own := next((name for name in spelled if name in names), None)) is not None
        }
        if not len(table):
            raise InputError("has no points", path=path)
        if missing := [name for name in "xyz" if name not in column]:
            raise InputError(f"has no column {missing[0]!r} (found {' '.join(names)})", path=path)
        self._positions = table[:, [column[name] for name in "xyz"]]
        shades: tuple[str, ...] = next((names for names in _SHADES if set(names) <= set(column)), ())
        self._values = table[:, [column[name] for name in shades]].astype(np.float32)
        unmarked = np.zeros(len(table), bool)
        scales = judge.full_scales(np.dtype(np.float64))
        super().__init__(path, len(table), (self._positions, self._values, unmarked), scales)
        if not shades:
            self.lack = f"has no colours (found columns {' '.join(names)})"

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for first in range(start, self.count, rows):
            part = slice(first, first + rows)
            values = self._values[part]
            yield self._positions[part], values, np.zeros(len(values), bool)


def holds_points(path: Path) -> bool:
    """Return whether the first lines of a text are those of a table of points."""
    if is_table(path):
        return True
    with suppress(InputError, OSError), path.open("rb") as file:
        head = file.read(_HEAD).decode("utf-8-sig", "replace")
        return {"x", "y", "z"} <= set(_text(path, head.rpartition("\n")[0] or head)[0])
    return False


def _text(path: Path, text: str) -> tuple[list[str], NDArray[np.float64]]:
    """Return the names of the columns and the rows of a text, with or without a heading."""
    text = plain_numbers(text)
    lines = iter(enumerate(text.split("\n", _LINES)))
    names, first = list[str](), 0
    for number, line in lines:
        words = re.findall(r"\w+", line.lower())
        first = number
        if any(re.match(r"[a-df-z_]|e\w", word) for word in words if word != "nan"):  # a heading
            names = words
        elif len(words) > 1 and not line.lstrip().startswith(("#", "/", "%")):
            break
    if not any(map(str.isdigit, text)):
        raise InputError("has no points", path=path)
    try:
        table = np.loadtxt(io.StringIO(text), np.float64, comments=("#", "//", "%"), skiprows=first, ndmin=2)
    except ValueError as error:
        raise InputError(f"is not a table of numbers: {error}", path=path) from error
    if table.size and not {"x", "y", "z"} <= set(names):
        names = _unnamed(path, table)
    if table.size and len(names) != table.shape[1]:
        raise InputError(f"has {table.shape[1]} columns, and a heading of {len(names)}", path=path)
    return names, table


def _unnamed(path: Path, table: NDArray[np.float64]) -> list[str]:
    """Return the names of columns without a heading, by their number and values."""
    count = table.shape[1]
    names = ["x", "y", "z", *(["intensity"] if count == 4 else [f"column_{k + 1}" for k in range(3, count)])]
    for start in _TRIPLES.get(count, ()):
        values = table[:, start : start + 3]
        whole = (values == np.rint(values)).all() and values.max(initial=0) <= 65535
        if values.min(initial=0) >= 0 and (whole or values.max(initial=0) <= 1):
            names[start : start + 3] = ["red", "green", "blue"]
            return names
    if count < 3 or count > 4:
        text = f"has {count} columns without a heading, of which none are colours from 0 to 255 or 0 to 1"
        raise InputError(text, path=path, hint="add a heading, such as: x y z red green blue")
    return names


def _pcd(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Return the names of the fields and the rows of a .pcd; a packed `rgb` becomes three columns."""
    data = path.read_bytes()
    found = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if found is None:
        raise damaged("has no line DATA", path=path)
    how, body = found[1].decode().lower(), data[found.end() :]
    words = [line.split() for line in data[: found.start()].decode("latin-1").splitlines()]
    head = {line[0]: line[1:] for line in words if line}
    try:
        fields, count = head["FIELDS"], int(head["POINTS"][0])
        counts = map(int, head["COUNT"] if "COUNT" in head else "1" * len(fields))
        kinds = [kind.lower() + size for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
        rows = np.dtype(
            [(f"{i}", f"<{kind}", (n,)) for i, (kind, n) in enumerate(zip(kinds, counts, strict=True))]
        )
        if how == "ascii":
            values = np.loadtxt(io.StringIO(plain_numbers(body.decode("latin-1"))), ndmin=2)
            table, at = np.zeros(len(values), rows), 0
            for name in rows.names or ():
                table[name] = values[:, at : (at := at + table[name].shape[1])]
        elif how == "binary":
            table = np.frombuffer(body, rows, count)
        else:
            hint = "`pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1` unpacks it, with its colours (rgb)"
            raise InputError(f"has the unsupported kind of data {how!r}", path=path, hint=hint)
    except InputError:
        raise
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise damaged(f"cannot be read as .pcd ({error})", path=path) from error
    names, columns = list[str](), list[NDArray[np.float64]]()
    for field, name in zip(fields, rows.names or (), strict=False):
        own = table[name].reshape(len(table), -1)
        if field.lower() in ("rgb", "rgba") and own.dtype.itemsize == 4:
            packed = np.ascontiguousarray(own[:, 0]).view("<u4")
            names += ["red", "green", "blue"]
            columns += [(packed >> shift & 255).astype(np.float64) for shift in (16, 8, 0)]
        else:
            names += [field.lower(), *(f"{field}_{k}" for k in range(1, own.shape[1]))]
            columns += list(own.T.astype(np.float64))
    return names, np.column_stack(columns)
