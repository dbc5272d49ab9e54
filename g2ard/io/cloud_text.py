"""Reader for coloured point clouds in tables: text (.xyz, .txt, .pts, .asc, .csv) and PCL's .pcd."""

import io
import re
from pathlib import Path

import numpy as np

from g2ard.arrays import Float
from g2ard.errors import InputError, damaged
from g2ard.io.judge import full_scales, unpack_colors
from g2ard.io.paths import decoded, plain_numbers, read_text
from g2ard.io.signs import is_table
from g2ard.io.stream import HeldPoints

_COLUMNS = {
    "x": r"x|x_coord\w*|east\w*",
    "y": r"y|y_coord\w*|north\w*",
    "z": r"z|z_coord\w*|height|alt\w*|elev\w*",
    "red": r"(scalar_|colou?r_|diffuse_)?r(ed|f)?",
    "green": r"(scalar_|colou?r_|diffuse_)?g(reen|f)?",
    "blue": r"(scalar_|colou?r_|diffuse_)?b(lue|f)?",
    "rgb": r"rgba?",
    "intensity": r"(scalar_)?(i|intensit\w*)|reflect\w*",
    "classification": r"(scalar_)?class\w*",
}
"""Columns and their names in headings, in small letters and without units."""

_SHADES = ("red", "green", "blue"), ("intensity",)  # columns that colour points, the best first

_TRIPLES = {
    6: (3,),
    7: (4, 3),
    8: (5, 4, 3),
    9: (6, 3),
    10: (7, 6, 4, 3),
}
"""Number of columns without a heading → where colours may begin, the likeliest first."""

_ALIKE = 0.5  # least correlation of the channels of colours that tells them from other columns

_LINES = 50  # lines that may be a heading
_HEAD = 1 << 16  # bytes that tell whether a text is a table


class Stream(HeldPoints):
    """Points of a table, which is read whole. Without colours they are grey by their intensities."""

    def __init__(self, path: Path) -> None:
        if path.suffix.lower() == ".pcd":
            names, table = _pcd(path)
        else:
            names, table = _text(read_text(path))
        if not len(table):
            raise InputError("has no points")
        if "rgb" in names and "red" not in names:
            packed = table[:, names.index("rgb")]
            kind = "<f4"
            if (packed == np.rint(packed)).all():
                kind = "<u4"
            colors = unpack_colors(packed.astype(kind))
            read = table.shape[1]
            names[read:read] = ["red", "green", "blue"]  # before unread columns
            table = np.column_stack([table, *colors])
        column = {name: names.index(name) for name in _COLUMNS if name in names}
        for axis in "xyz":
            if axis not in column:
                raise InputError(f"has no column {axis!r} (found {' '.join(names)})")
        choices = (shades for shades in _SHADES if column.keys() >= set(shades))
        shades: tuple[str, ...] = next(choices, ())
        positions = table[:, [column[axis] for axis in "xyz"]]
        values = table[:, [column[name] for name in shades]]
        columns = dict(zip(names, table.T, strict=False))
        scales = full_scales(np.dtype(float))
        super().__init__(path, positions, values, scales, columns)
        if not shades:
            found = " ".join(names)
            self.lack = f"has no colours (found columns {found}); name them red, green and blue"


def check_points(path: Path) -> None:
    """Raise an `InputError` unless the first lines of a text are those of a table of points."""
    if is_table(path):
        return
    with path.open("rb") as file:
        head = decoded(file.read(_HEAD))
    names, _ = _text(re.sub(r"[^\r\n]*$", "", head) or head)
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"has no columns x, y and z (found {' '.join(names)})")


def _text(text: str) -> tuple[list[str], Float]:
    """Return the names of the columns and the rows of a text, with or without a heading.

    Of a table whose heading names x, y and z, only known columns are read, and their names are the first.
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace('"', "")
    names = list[str]()
    heading = ""
    first = 0
    for number, line in enumerate(text.split("\n", _LINES)):
        words = re.findall(r"\w+", line.lower())
        first = number
        named = {"x", "y", "z"} <= set(names)
        if not named and any(re.match(r"[a-df-z_]|e\w", word) for word in words if word != "nan"):
            names = _names(line)
            heading = line
        elif len(words) > 1 and re.match(r"\s*[^\s#/%].*\d", line):
            break
    rows = text.split("\n", first)[-1]
    if not any(map(str.isdigit, rows)):
        raise InputError("has no points")
    if any(mark in heading for mark in ",;\t"):
        rows = re.sub(r"(?<=([,;\t]))(?=\1|\n)", "nan", rows)  # empty fields
    if heading:
        rows = rows.replace(f"\n{heading}\n", "\n")
    rows = re.sub(r"\n[ \t]*\d+[ \t]*(?=\n)", "", rows)  # numbers of points, one for each scan
    known = None
    if named:
        known = [i for i, name in enumerate(names) if name in _COLUMNS]
    try:
        table = np.loadtxt(
            io.StringIO(plain_numbers(rows)),
            comments=("#", "//", "%"),
            usecols=known,
            ndmin=2,
        )
    except ValueError as error:
        text = str(error).partition(";")[0]
        raise InputError(f"is not a table of numbers: {text}") from error
    if known is not None:
        unread = [name for name in names if name not in _COLUMNS]
        names = [names[i] for i in known] + unread
    elif table.size:
        names = _unnamed(table)
    return names, table


def _names(heading: str) -> list[str]:
    """Return the names of columns in a heading without units, the usual ones for those that have others."""
    mark = next((mark for mark in ";,\t" if mark in heading), None)
    plain = re.sub(r"\[.*?\]|\(.*?\)", "", heading.lower()).strip(" #/%")
    words = [word.strip(" #/%'").replace(" ", "_") for word in plain.split(mark)]
    for i, word in enumerate(words):
        for name, spelled in _COLUMNS.items():
            if re.fullmatch(spelled, word):
                words[i] = name
    return words


def _unnamed(table: Float) -> list[str]:
    """Return the names of columns without a heading, by their number and values."""
    count = table.shape[1]
    whole = [bool((values == np.rint(values)).all()) for values in table.T]
    grid = whole[:5] == [True, True, False, False, False]
    grid = grid and table[:, :2].min() >= 0
    if grid and (count > 6 or whole[5:] == [True]):
        return ["row", "column", *_unnamed(table[:, 2:])]  # of a scan's grid, as FARO writes them
    further = [f"column_{k + 1}" for k in range(3, count)]
    if count == 4:
        further = ["intensity"]
    names = ["x", "y", "z", *further]
    found = []
    alike = {}
    for start in _TRIPLES.get(count, ()):
        columns = slice(start, start + 3)
        values = table[:, columns]
        top = values.max(initial=0)
        most = 1
        if all(whole[columns]):
            most = 65535
        if not (values.min(initial=0) >= 0 and top <= most):  # also NaN
            continue
        varying = bool(np.ptp(values, axis=0).all())
        found.append((not varying, top > 255, start))
        alike[start] = 0.0
        if varying:
            correlations = np.corrcoef(values.T)
            alike[start] = float(np.abs(correlations).min())
    if found:
        # an intensity beside colours differs from them more than they do
        likest = max(alike.values())
        if likest >= _ALIKE:
            found = [each for each in found if alike[each[-1]] > likest / 2]
        start = min(found, key=lambda each: each[:2])[-1]
        names[start : start + 3] = ["red", "green", "blue"]
    elif count < 3 or count > 4:
        text = f"has {count} columns without a heading of x, y and z, none of them colours up to 1 or 255"
        raise InputError(text, hint="add a heading, such as: x y z red green blue")
    return names


def _pcd(path: Path) -> tuple[list[str], Float]:
    """Return the names of the fields and the rows of a .pcd; a packed `rgb` becomes three columns."""
    data = path.read_bytes()
    found = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if found is None:
        raise damaged("has no line DATA")
    how = found[1].decode().lower()
    body = data[found.end() :]
    lines = data[: found.start()].decode("latin-1").splitlines()
    words = [line.split() for line in lines]
    head = {line[0]: line[1:] for line in words if line}
    try:
        fields = head["FIELDS"]
        count = int(head["POINTS"][0])
        counts = head.get("COUNT") or "1" * len(fields)
        shapes = zip(head["TYPE"], head["SIZE"], counts, strict=True)
        types = []
        for i, (kind, size, width) in enumerate(shapes):
            types.append((f"{i}", f"<{kind.lower()}{size}", (int(width),)))
        rows = np.dtype(types)
        if how == "ascii":
            text = plain_numbers(body.decode("latin-1"))
            values = np.loadtxt(io.StringIO(text), ndmin=2)
            table = np.zeros(len(values), rows)
            at = 0
            for name in rows.names or ():
                width = table[name].shape[1]
                table[name] = values[:, at : at + width]
                at += width
        elif how == "binary":
            table = np.frombuffer(body, rows, count)
        else:
            hint = (
                "`pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1` unpacks it, with its colours (rgb)"
            )
            raise InputError(f"has the unsupported kind of data {how!r}", hint=hint)
    except InputError:
        raise
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise damaged(f"cannot be read as .pcd ({error})") from error
    names = []
    columns = []
    for field, name in zip(fields, rows.names or (), strict=False):
        own = table[name].reshape(len(table), -1)
        if field.lower() in ("rgb", "rgba") and own.dtype.itemsize == 4:
            names += ["red", "green", "blue"]
            columns += unpack_colors(own[:, 0])
        else:
            names += _names(field)
            names += [f"{field}_{k}" for k in range(1, own.shape[1])]
            columns += list(own.T.astype(float))
    return names, np.column_stack(columns)
