"""Helpers for PLY readers: headers, rows and errors that name the file."""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyListProperty, PlyParseError

from g2ard.arrays import Float, Values
from g2ard.config.choices import AXES, Axes, RenderModel
from g2ard.errors import InputError, damaged
from g2ard.io.atomic import atomic_output
from g2ard.io.paths import about, naming, plain_numbers
from g2ard.io.signs import AGAIN
from g2ard.scene.splats import Splats
from g2ard.scene.transform import moved_axes

_OFFSET_COMMENT = re.compile(r"g2ard offset (\S+) (\S+) (\S+)$")
_VERTICAL_AXIS = re.compile(r"vertical (a)xis\s*[:=]?\s*(.+)", re.IGNORECASE)
_RENDER_MODES: dict[str, RenderModel | Literal["2dgs"]] = {
    "splatrendermode: default": "classic",
    "splatrendermode: mip": "antialiased",
    "splatrendermode: 2dgs": "2dgs",
    "antialiased 0": "classic",
    "antialiased 1": "antialiased",
}
"""Comments of brush and Postshot, in lower case."""

_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"), ("rf", "gf", "bf"))
_COLOR_PREFIXES = ("", "diffuse_", "color_", "vertex_")
COLOR_NAMES = [
    tuple(prefix + channel for channel in channels)
    for channels in _CHANNELS
    for prefix in _COLOR_PREFIXES
]
"""Names of colours."""

_HEADER_LIMIT = 1 << 20  # longest header, bytes
_MARK = b"\xef\xbb\xbf"  # byte order mark of UTF-8

_ASCII = bytes(range(128)) + b"?" * 128
"""Translation of names and comments of other character sets, byte by byte."""

_END_HEADER = re.compile(rb"(?<=[\r\n])end_header[ \t]*(\r\n|\r|\n)")
# Python reads no longer ones
_COUNT = re.compile(rb"(?<=[\r\n])(element[ \t]+(\S+)[ \t]+)(\d{1,4000})\b")


@dataclass(frozen=True)
class PlyHeader:
    """A PLY header: plyfile's elements, without rows, row counts per element, all comments, and its bytes."""

    elements: PlyData
    counts: dict[str, int]
    comments: list[str]
    span: range

    def properties(self, element: str) -> list[str]:
        """Return the properties of an element that are no lists; none if there is no such element."""
        if element not in self.elements:
            return []
        properties = self.elements[element].properties
        return [each.name for each in properties if not isinstance(each, PlyListProperty)]


def read_header(path: Path) -> PlyHeader:
    with about(path), path.open("rb") as file:
        return _header(file.read(_HEADER_LIMIT))


def _header(head: bytes) -> PlyHeader:
    if not head:
        raise InputError("is empty")
    start = 0
    if head.startswith(_MARK):
        start = len(_MARK)
    head = head[start:]
    if head[:3] != b"ply" or head[3:4] not in b"\r\n":
        raise InputError(
            f"is not a PLY file (begins with {head[:8]!r}, expected 'ply')",
            hint="export it again, or rename it to the suffix of its format",
        )
    end = _END_HEADER.search(head)  # on a line of its own, since comments may contain it
    if end is None:
        raise damaged("broken PLY header: no end_header line")
    eol = head[3:4]
    if head[3:5] == b"\r\n":
        eol = b"\r\n"
    head = head[: end.start(1) + len(eol)]  # rows may begin with a newline
    span = range(start, start + len(head))
    head = head.translate(_ASCII)
    try:
        counts = {name.decode(): int(count) for _, name, count in _COUNT.findall(head)}
        ply = PlyData.read(io.BytesIO(_COUNT.sub(rb"\g<1>0", head)), mmap=False)
    except (PlyParseError, ValueError) as error:
        raise damaged(f"broken PLY header, {error}") from error
    comments = list(ply.comments)
    for element in ply:
        comments += element.comments
    comments = [" ".join(text.split()) for text in comments]
    return PlyHeader(ply, counts, comments, span)


class _Plain(io.BufferedReader):
    """A PLY file from its header on, whose header reads as ASCII."""

    def __init__(self, path: Path, span: range) -> None:
        super().__init__(io.FileIO(str(path)))
        self._end = span.stop
        self.seek(span.start)

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if self.tell() <= self._end:
            return data.translate(_ASCII)
        return data


def scene_names(properties: Sequence[str]) -> dict[str, str]:
    """Return properties by their usual names, without the prefixes of CloudCompare and 3dgsconverter.

    >>> scene_names(["x", "scalar_f_dc_0", "filter_3D", "red"])
    {'x': 'x', 'filter_3d': 'filter_3D', 'red': 'red', 'f_dc_0': 'scalar_f_dc_0'}
    """
    found: dict[str, str] = {}
    for name in sorted(properties, key=lambda name: name.lower().startswith("scal")):
        found.setdefault(re.sub(r"^(scalar_|scal_)+", "", name.lower()), name)
    return found


def is_mesh(header: PlyHeader) -> bool:
    """Return whether a file has faces."""
    return any(header.counts.get(name) for name in ("face", "tristrips"))


def groups_of(header: PlyHeader) -> list[str]:
    """Return the element of vertices, or those of reduced-3dgs for the SH degrees, vertex_0 and on."""
    groups = sorted(name for name in header.counts if re.fullmatch(r"vertex_\d", name))
    if "vertex" in header.counts or not groups:
        return ["vertex"]
    return groups


def offset_of(header: PlyHeader) -> Float:
    """Return the (3,) offset of a comment `g2ard offset X Y Z`, turned to the file's axes; zeros without one.

    The comment is in the axes of a comment `g2ard axes`, so it holds coordinates of the map.
    """
    for comment in header.comments:
        match = _OFFSET_COMMENT.match(comment)
        if match is None:
            continue
        try:
            offset = np.array([float(word) for word in match.groups()])
        except ValueError:
            offset = np.full(3, np.nan)
        if not np.isfinite(offset).all():
            raise damaged(f"broken comment {comment!r}")
        return moved_axes(offset, axes_of(header), "RDF")
    return np.zeros(3)


def axes_of(header: PlyHeader) -> Axes:
    """Return the axes of a comment `g2ard axes NAME`, to which a scene is turned; "RDF" without one."""
    for comment in header.comments:
        if comment.startswith("g2ard axes "):
            found = next((name for name in AXES if comment == f"g2ard axes {name}"), None)
            if found is None:
                raise damaged(f"broken comment {comment!r}")
            return found
    return "RDF"


def render_model_of(comments: Sequence[str]) -> RenderModel | Literal["2dgs"]:
    """Return the rendering of the last comment that names one: brush's spelling, or Postshot's.

    >>> render_model_of(["antialiased 1"])
    'antialiased'
    >>> render_model_of(["Exported from Brush", "SplatRenderMode: default"])
    'classic'
    """
    for comment in reversed(comments):
        text = comment.lower()
        if text in _RENDER_MODES:
            return _RENDER_MODES[text]
    return "classic"


def up_of(comments: Sequence[str]) -> tuple[float, float, float] | None:
    """Return the up direction that a comment states, as a unit vector.

    Brush writes the direction, or a letter of which y and z mean −y and −z; nerfstudio's letters mean the
    axis itself. Brush is the writer if a comment names it, or if none names nerfstudio and `axis` is in
    lower case.

    >>> up_of(["Generated by Nerfstudio 1.1.5", "Vertical Axis: z"])
    (0.0, 0.0, 1.0)
    >>> up_of(["Exported from Brush", "Vertical axis: z"])
    (0.0, 0.0, -1.0)
    """
    matches = filter(None, map(_VERTICAL_AXIS.match, reversed(comments)))
    found = next(matches, None)
    if found is None:
        return None
    axis = np.zeros(3)
    letter = re.fullmatch(r"([+-]?)([xyz])", found[2].lower())
    if letter:
        writers = " ".join(comments).lower()
        by_brush = "brush" in writers
        if not by_brush and not re.search("nerf?studio", writers):
            by_brush = found[1] == "a"
        is_down = by_brush and letter[2] != "x"
        if letter[1] == "-":
            is_down = not is_down
        axis["xyz".index(letter[2])] = -1 if is_down else 1
    else:
        words = re.split(r"[\s,]+", found[2].strip("[]() "))
        with suppress(ValueError):
            axis[:] = [float(word) for word in words]
    length = float(np.linalg.norm(axis))
    if not 0 < length < np.inf:
        return None
    x, y, z = (axis / length).tolist()
    return x, y, z


def comments_of(stored: Splats) -> list[str]:
    """Return the comments of a scene `as_stored`, which readers restore."""
    comments = ["generated by g2ard"]
    if stored.axes != "RDF":
        comments.append(f"g2ard axes {stored.axes}")
    if stored.offset.any():
        offset = moved_axes(stored.offset, "RDF", stored.axes)
        comments.append(f"g2ard offset {_spell_out(offset)}")
    if stored.up is not None:
        comments.append(f"Vertical axis: {_spell_out(stored.up)}")
    if stored.render_model == "antialiased":
        comments.append("SplatRenderMode: mip")
    return comments


def _spell_out(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def read_element(
    path: Path,
    header: PlyHeader,
    *names: str,
    plain: bool = False,
) -> list[Values]:
    """Return an array of rows per element name, memory-mapped if the file is binary.

    Lists are first read as triangles, since lists of a known length can be mapped; if a polygon has another
    number of corners, the file is read again, more slowly.
    """
    size = path.stat().st_size
    for name, count in header.counts.items():  # before allocating memory: a row has at least a byte
        if count > size:
            raise damaged(f"truncated: {count:,} rows of {name!r} in {size:,} bytes")
    triangles = {}
    for element in header.elements:
        lists = [each for each in element.properties if isinstance(each, PlyListProperty)]
        triangles[element.name] = {each.name: 3 for each in lists}
    try:
        try:
            ply = _read(path, header, triangles, plain)
        except PlyElementParseError:
            if not any(triangles.values()):
                raise
            ply = _read(path, header, {}, plain)
    except PlyElementParseError as error:
        if header.elements.text and not plain:  # numbers of other languages or of Windows
            return read_element(path, header, *names, plain=True)
        name = error.element.name
        raise damaged(
            f"of {header.counts.get(name, 0)} cannot be read ({error.message})",
            property=error.prop and error.prop.name,
            index=error.row,
            item=f"{name} row",
        ) from error
    except (PlyParseError, ValueError, OSError, OverflowError, MemoryError) as error:
        raise InputError(f"cannot be read as a PLY: {error}") from error
    last = ply.elements[-1].data
    if isinstance(last, np.memmap):
        _check_rest(path, last.offset + last.nbytes)
    return [ply[name].data for name in names]


def _check_rest(path: Path, end: int) -> None:
    """Raise an `InputError` for more than line ends and zeros after the last row, which ends at a byte."""
    with path.open("rb") as file:
        file.seek(end)
        if not file.read(_HEADER_LIMIT).strip(b"\0\r\n\t "):
            return
    rest = path.stat().st_size - end
    text = f"has {rest:,} bytes after its last row: a transfer as text changed line ends"
    raise InputError(f"{text}, or its header states too few rows", hint=AGAIN)


def _read(
    path: Path,
    header: PlyHeader,
    list_lengths: dict[str, dict[str, int]],
    plain: bool = False,
) -> PlyData:
    with _Plain(path, header.span) as file:
        if plain:
            head = file.read(len(header.span))
            body = plain_numbers(file.read().decode("latin-1"))
            return PlyData.read(io.BytesIO(head + body.encode("latin-1")))
        return PlyData.read(file, mmap="r", known_list_len=list_lengths)


def write_rows(
    path: Path,
    types: dict[str, str],
    count: int,
    blocks: Iterable[Values],
    overwrite: bool,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary .ply of `count` vertices, which arrive in blocks, with properties of these types."""
    every = np.broadcast_to(np.zeros(1, list(types.items())), count)  # costs no memory
    elements = [PlyElement.describe(every, "vertex")]
    header = PlyData(elements, byte_order="<", comments=comments).header
    written = 0
    with naming(path), atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii") + b"\n")
        for rows in blocks:
            file.write(rows.data)
            written += len(rows)
        if written != count:
            raise InputError(f"not written: got {written:,} vertices, expected {count:,}")


def row_blocks(
    path: Path,
    every: Values,
    rows: int,
    start: int = 0,
) -> Iterator[tuple[int, Values]]:
    """Yield an element's rows from `start` in blocks of `rows`, each with the index of its first row.

    Mapped rows are read with file reads, since mapped pages count as memory of the process.
    """
    for first in range(start, len(every), rows):
        count = min(rows, len(every) - first)
        if not isinstance(every, np.memmap):
            yield first, every[first : first + count]
            continue
        offset = every.offset + first * every.itemsize
        block = np.fromfile(path, every.dtype, count, offset=offset)
        if len(block) < count:
            raise InputError("was truncated while it was read", path=path)
        yield first, block


def spread_rows(rows: Values, count: int = 100_000) -> Values:
    """Return evenly spaced rows: `count` to twice as many, or all if there are fewer.

    A memory map of a file is read row by row, so that the pages between are not loaded.
    """
    step = max(1, len(rows) // count)
    if not isinstance(rows, np.memmap) or step == 1:
        return np.asarray(rows[::step])
    parts = []
    with Path(rows.filename or "").open("rb", buffering=0) as file:
        for row in range(0, len(rows), step):
            file.seek(rows.offset + row * rows.itemsize)
            parts.append(file.read(rows.itemsize))
    return np.frombuffer(b"".join(parts), rows.dtype)


def require(
    present: list[str],
    wanted: list[str],
    what: str,
    element: str = "vertex",
) -> None:
    """Raise an `InputError` that lists the `wanted` properties that are not `present`."""
    missing = [name for name in wanted if name not in present]
    if missing:
        words = ", ".join(map(repr, missing))
        raise InputError(f"{what} needs the {element} property {words}")
