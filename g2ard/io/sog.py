"""Reader for SOG scenes (PlayCanvas): a meta.json and lossless images, in folders or zipped as .sog.

A folder may hold a scene in spatial chunks, named `{lod}_{chunk}` or listed by a lod-meta.json. Only the
finest level of detail is read.
"""

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from PIL.Image import Image

from g2ard.arrays import Bytes, Float32, Rows, Values
from g2ard.config.choices import Axes, RenderModel
from g2ard.errors import InputError, damaged
from g2ard.io.jsonfile import FileName, Place, Vector, Whole, checked, parse_json, read_json
from g2ard.io.packing import from_smallest_three
from g2ard.io.paths import check_regular, check_unpacked, decoded, file_identity, naming
from g2ard.io.photo_headers import open_image
from g2ard.io.sanitize import BLOCK, Raw, logits_of
from g2ard.io.stream import RawStream, from_row, ranges
from g2ard.io.types import Note
from g2ard.progress import plural
from g2ard.scene.transform import moved_axes, one_model

_COEFFICIENTS = (0, 3, 8, 15)  # past band 0, by SH degree
_LARGEST_FLOAT32 = float.fromhex("0x1.fffffep+127")  # largest float32
_LARGEST_LOG = math.log1p(_LARGEST_FLOAT32)
_PALETTE_COLUMNS = 64  # entries of the SH palette per row of its image

_Float32 = Annotated[float, msgspec.Meta(ge=-_LARGEST_FLOAT32, le=_LARGEST_FLOAT32)]
_Log = Annotated[float, msgspec.Meta(ge=-_LARGEST_LOG, le=_LARGEST_LOG)]
_ChannelCount = msgspec.Meta(min_length=3, max_length=4)
_Bound = _Float32 | Annotated[list[_Float32], _ChannelCount]
_LogBound = _Log | Annotated[list[_Log], _ChannelCount]
"""A bound of all channels, or one of each: three, and opacity as the fourth."""

_OneFile = Annotated[list[FileName], msgspec.Meta(min_length=1)]
_TwoFiles = Annotated[list[FileName], msgspec.Meta(min_length=2)]


class _Means(msgspec.Struct):
    files: _TwoFiles
    mins: _LogBound
    maxs: _LogBound
    shape: list[Whole] = []


class _Part(msgspec.Struct):
    files: _OneFile
    codebook: list[float | None] | UnsetType = UNSET
    mins: _Bound | None = None
    maxs: _Bound | None = None


class _Rest(_Part):
    files: _TwoFiles
    bands: Annotated[int, msgspec.Meta(ge=0, le=3)] | UnsetType = UNSET


class _Own(msgspec.Struct, frozen=True):
    offset: Vector = (0.0, 0.0, 0.0)
    axes: Axes = "RDF"


class _Meta(msgspec.Struct):
    """Content of a meta.json; version 1 has mins and maxs in place of codebooks."""

    means: _Means
    scales: _Part
    quats: _Part
    sh0: _Part
    shN: _Rest | UnsetType = UNSET
    version: Literal[1, 2] = 1
    count: Whole | None = None
    model: Any = None
    antialias: Any = False
    g2ard: _Own = msgspec.field(default_factory=_Own)

    @property
    def render_model(self) -> RenderModel:
        """The render model: `model`, or in older files `antialias`."""
        if self.model is not None:
            states = self.model == "antialiased"
        else:
            states = self.antialias is True
        return "antialiased" if states else "classic"


class _Chunk:
    """A meta.json and the images beside it, in a folder or an archive; `place` is that for errors."""

    def __init__(self, place: Path, files: Path | zipfile.Path) -> None:
        self.place = place
        self.files = files
        self.file = Place(place / "meta.json")
        with naming(self.file.path):
            content = parse_json(decoded(self.read("meta.json")))
        self.meta = checked(content, _Meta, self.file)

    def read(self, name: str) -> bytes:
        """Read a file, from an archive within `check_unpacked`."""
        file = self.files / name
        path = self.place / name
        try:
            if isinstance(file, zipfile.Path):
                info = file.root.getinfo(file.at)
                check_unpacked(info.compress_size, info.file_size, path)
            else:
                check_regular(file)
            return file.read_bytes()
        except (KeyError, FileNotFoundError) as error:
            raise InputError("no such file", path=path) from error
        except (
            OSError,
            ValueError,
            EOFError,
            RuntimeError,
            zipfile.BadZipFile,
            zlib.error,
        ) as error:
            raise InputError(f"cannot be read ({error})", path=path) from error

    @contextmanager
    def open_image(self, name: str) -> Iterator[Image]:
        from PIL import (
            WebPImagePlugin,  # noqa: F401  (Pillow would load all its formats to find this one)
        )

        content = io.BytesIO(self.read(name))
        with open_image(self.place / name, content) as image:
            yield image

    def image(self, name: str) -> Bytes:
        """Return (height, width, 4) bytes."""
        with self.open_image(name) as image:
            return np.asarray(image.convert("RGBA"))

    def rows(self, name: str, count: int) -> Bytes:
        """Return (count, 4) bytes, one pixel per Gaussian."""
        pixels = self.image(name).reshape(-1, 4)
        self._check_pixels(name, len(pixels), count)
        return pixels[:count]

    def _check_pixels(self, name: str, pixels: int, count: int) -> None:
        if pixels < count:
            text = f"has {pixels:,} pixels for {count:,} Gaussians"
            raise InputError(text, path=self.place / name)

    def count(self) -> int:
        meta = self.meta
        if meta.version == 2:
            count = meta.count
            place = self.file.to("count")
        else:
            count = next(iter(meta.means.shape), None)
            place = self.file.to("means", "shape", 0)
        if count is None:
            raise place.error("is missing")
        first = meta.means.files[0]
        with self.open_image(first) as image:  # before allocating memory
            pixels = image.width * image.height
        self._check_pixels(first, pixels, count)
        return count

    def rest(self) -> int:
        """Return the number of coefficients past band 0; version 1 only implies it by the palette's width."""
        part = self.meta.shN
        if part is UNSET:
            return 0
        if part.bands is not UNSET:
            return _COEFFICIENTS[part.bands]
        file = _sh_files(part)[0]
        rest, left = divmod(self.image(file).shape[1], _PALETTE_COLUMNS)
        if left or rest not in _COEFFICIENTS:
            text = "does not have the width of a palette of SH degree 1 to 3"
            raise InputError(text, path=self.place / file)
        return rest

    def means(self, count: int) -> Float32:
        """Decode only the (count, 3) means."""
        part = self.meta.means
        low = self.rows(part.files[0], count)
        high = self.rows(part.files[1], count)
        means = np.empty((count, 3), np.float32)
        _fill_means(means, low, high, _positions(part))
        return means


def _sh_files(part: _Rest) -> tuple[str, str]:
    first, second = part.files[:2]
    if "centroids" in second and "centroids" not in first:
        return second, first
    return first, second


class _Decoder:
    """Images of a chunk, 20 to 28 bytes per Gaussian, and the lookup tables of their bytes."""

    def __init__(self, chunk: _Chunk, count: int) -> None:
        meta = chunk.meta
        self.chunk = chunk
        self._low = chunk.rows(meta.means.files[0], count)
        self._high = chunk.rows(meta.means.files[1], count)
        self._quats = chunk.rows(meta.quats.files[0], count)
        self._scales = chunk.rows(meta.scales.files[0], count)
        self._base = chunk.rows(meta.sh0.files[0], count)
        self._positions = _positions(meta.means)
        self._log_scales = _values(chunk.file.to("scales"), meta.scales)
        self._colors = _values(chunk.file.to("sh0"), meta.sh0)
        self._logits = _logits(chunk.file.to("sh0"), meta.sh0)
        self._rest = chunk.rest()
        if meta.shN is not UNSET and self._rest:
            self._labels_file = _sh_files(meta.shN)[1]
            self._palette, self._labels = _palette(chunk, meta.shN, self._rest, count)

    def fill(self, rows: slice, raw: Raw) -> None:
        """Decode the Gaussians `rows` into `raw` in blocks that fit into the cache."""
        for start in range(rows.start, rows.stop, BLOCK):
            stop = min(start + BLOCK, rows.stop)
            part = raw.take(slice(start - rows.start, stop - rows.start))
            self._fill(slice(start, stop), part)

    def _fill(self, rows: slice, raw: Raw) -> None:
        _fill_means(raw.means, self._low[rows], self._high[rows], self._positions)
        raw.quats[:] = _quats(self._quats[rows])
        raw.log_scales[:] = self._log_scales(self._scales[rows, :3])
        raw.sh0[:, 0] = self._colors(self._base[rows, :3])
        raw.logit_opacities[:] = self._logits[self._base[rows, 3]]
        raw.shN[:, self._rest :] = 0
        if self._rest:
            self._fill_rest(rows, raw.shN)

    def _fill_rest(self, rows: slice, out: Float32) -> None:
        """Look up palette entries by label."""
        index = _words(self._labels[rows, 0], self._labels[rows, 1])
        if index.max() >= len(self._palette):
            row = int(np.argmax(index >= len(self._palette)))
            raise InputError(
                f"has palette entry {index[row]} of {len(self._palette)}",
                path=self.chunk.place / self._labels_file,
                index=rows.start + row,
                item="Gaussian",
            )
        np.take(self._palette, index, axis=0, out=out[:, : self._rest], mode="clip")


def _fill_means(
    out: Float32,
    low: Bytes,
    high: Bytes,
    positions: Values,
) -> None:
    """Decode positions from 16-bit codes, a byte from each of two images."""
    for axis in range(3):
        codes = _words(low[:, axis], high[:, axis])
        out[:, axis] = positions[axis][codes]


def _words(low: Bytes, high: Bytes) -> Rows:
    """Return the 16-bit numbers of low and high bytes."""
    return low + (high.astype(np.intp) << 8)


def _positions(part: _Means) -> Values:
    """Return the (3, 65536) values of codes per axis, which are stored as sign(x)·ln(|x| + 1)."""
    low = np.atleast_1d(part.mins)[:3, None]
    high = np.atleast_1d(part.maxs)[:3, None]
    shares = np.arange(65536) / 65535
    logs = low + (high - low) * shares
    values = np.sign(logs) * np.expm1(np.abs(logs))
    return np.broadcast_to(values, (3, 65536)).astype(np.float32)


def _logits(place: Place, part: _Part) -> Values:
    """Return the (256,) logits of opacity bytes, which are α in version 2 and logits in version 1."""
    alpha = np.arange(256) / 255
    if part.codebook is UNSET:
        low, high = _ends(place, part, slice(3, 4))
        return low + (high - low) * alpha
    return logits_of(alpha)


def _ends(place: Place, part: _Part, channels: slice) -> Iterator[Values]:
    """Yield the lower and the upper bounds of channels."""
    for name, bound in (("mins", part.mins), ("maxs", part.maxs)):
        if bound is None:
            raise place.to(name).error("is missing")
        if isinstance(bound, list):
            if len(bound) < channels.stop:
                raise place.to(name, 3).error("is missing")
            yield np.asarray(bound[channels])
        else:
            yield np.asarray(bound)


def _values(place: Place, part: _Part) -> Callable[[Bytes], Values]:
    """Return the values of bytes: from a codebook (version 2), or between mins and maxs (version 1)."""
    if part.codebook is UNSET:
        low, high = _ends(place, part, slice(3))
        return lambda codes: low + (high - low) * (codes / 255)
    place = place.to("codebook")
    book = np.array(part.codebook, float)
    wrong = np.isfinite(book) & (np.abs(book) > _LARGEST_FLOAT32)
    if wrong.any():
        raise place.to(int(np.argmax(wrong))).error("is beyond the range of float32")
    table = book.astype(np.float32)

    def looked_up(codes: Bytes) -> Values:
        top = int(codes.max(initial=0))
        if codes.size and top >= len(table):
            raise place.error(f"has {len(table)} numbers, expected at least {top + 1}")
        return table[codes]

    return looked_up


def _quats(codes: Bytes) -> Values:
    """Decode (N, 4) wxyz: three components in ±1/√2; the fourth byte − 252 is the index of the largest.

    Other fourth bytes give a zero quaternion, which later becomes the identity, with a note.
    """
    others = (codes[:, :3] / 255 - 0.5) * np.sqrt(2)
    quats = from_smallest_three(codes[:, 3] & 3, others)
    quats[codes[:, 3] < 252] = 0
    return quats


def _palette(
    chunk: _Chunk,
    part: _Rest,
    rest: int,
    count: int,
) -> tuple[Float32, Bytes]:
    """Return the (entries, K−1, 3) coefficients of the palette, and the labels."""
    centroids, labels = _sh_files(part)
    image = chunk.image(centroids)
    expected = _PALETTE_COLUMNS * rest
    if image.shape[1] != expected:
        text = f"has width {image.shape[1]}, expected {expected}"
        raise InputError(text, path=chunk.place / centroids)
    values = _values(chunk.file.to("shN"), part)
    entries = image[:, :, :3].reshape(-1, rest, 3)
    return values(entries).astype(np.float32), chunk.rows(labels, count)


_CHUNK_NAME = re.compile(r"(\d+)_(\d+)")


class _Lod(msgspec.Struct):
    file: Whole


class _Node(msgspec.Struct):
    children: list["_Node"] = []
    lods: dict[str, Any] = {}


class _Levels(msgspec.Struct):
    tree: _Node
    filenames: list[FileName]
    version: Literal[1] = 1
    environment: str | None = None


def chunks_of(path: Path) -> list[Path]:
    """Return the folders of a scene's chunks at the finest level; [] if `path` is not a SOG scene."""
    if path.is_file() and path.name == "meta.json":
        path = path.parent
    if (path / "meta.json").is_file():
        return [path]
    index = path / "lod-meta.json"
    if index.is_file():
        return _listed(index)
    if path.name == index.name:
        return _listed(path)
    if not path.is_dir():
        return []
    folders = sorted(file.parent for file in path.glob("*/meta.json"))
    numbered = []
    for folder in folders:
        match = _CHUNK_NAME.fullmatch(folder.name)
        if match:
            numbered.append((int(match[1]), int(match[2]), folder))
    if not numbered:
        return folders
    finest, _, _ = min(numbered)
    return [folder for level, _, folder in sorted(numbered) if level == finest]


def _listed(index: Path) -> list[Path]:
    """Return the chunks that lod-meta.json's tree uses at level 0, in the order of its list, and the sky."""
    content = checked(read_json(index), _Levels, Place(index))
    names = content.filenames
    sky = content.environment
    files = [_chunk_at(index.parent / name.replace("\\", "/")) for name in names]
    used = set()
    nodes = [(content.tree, Place(index).to("tree"))]
    while nodes:
        node, place = nodes.pop()
        for i, child in enumerate(node.children):
            nodes.append((child, place.to("children", i)))
        if "0" in node.lods:
            place = place.to("lods", "0")
            at = checked(node.lods["0"], _Lod, place).file
            if at >= len(files):
                raise place.to("file").error(f"is {at}, but there are {len(files)} filenames")
            used.add(at)
    for i in sorted(used):
        place = Place(index).to("filenames", i)
        try:
            there = files[i].is_file() or (files[i] / "meta.json").is_file()
        except OSError as error:  # a name too long
            raise place.error(f"cannot be found ({error.strerror})") from error
        if not there:
            raise place.error(f"is {names[i]}, which does not exist")
    chunks = [files[i] for i in sorted(used)]
    if sky and (index.parent / sky).is_file():
        chunks.append(_chunk_at(index.parent / sky))
    return chunks


def _chunk_at(file: Path) -> Path:
    """Return the place of a chunk: its archive, or the folder of its meta.json."""
    if file.suffix.lower() == ".sog":
        return file
    return file.parent


def _own(chunks: list[_Chunk]) -> _Own:
    """Return what g2ard stored under "g2ard"; the defaults if it is missing or chunks differ."""
    found = {chunk.meta.g2ard for chunk in chunks}
    if len(found) == 1:
        return found.pop()
    return _Own()


def _left_out(path: Path, read_count: int) -> list[Note]:
    """Note coarser levels, or other folders beside the chunks."""
    folder = path if path.is_dir() else path.parent
    if path.suffix.lower() == ".sog" or (folder / "meta.json").is_file():
        return []
    others = len(list(folder.glob("*/meta.json"))) - read_count
    if others <= 0:
        return []
    text = f"{plural(others, 'other SOG folder')} ignored (coarser levels of detail)"
    return [Note("ignored_chunks", others, text)]


class Stream(RawStream):
    """SOG scene, version 1 or 2: a .sog, a meta.json or its folder, or a folder of chunks.

    Chunks are padded with zeros to the highest SH degree, and blocks do not cross chunks. Memory holds a
    chunk's images, 20 to 28 bytes per Gaussian.
    """

    def __init__(self, path: Path) -> None:
        with _opened(path) as chunks:
            self._counts = [chunk.count() for chunk in chunks]
            self._rest = max((chunk.rest() for chunk in chunks), default=0)
            own = _own(chunks)
            models = [chunk.meta.render_model for chunk in chunks]
        model = one_model(models or ["classic"])
        notes = tuple(_left_out(path, len(chunks)))
        offset = moved_axes(own.offset, own.axes, "RDF")
        super().__init__(path, sum(self._counts), self._rest, offset, notes, model)
        self.restore(own.axes)

    def identity(self) -> list[Any]:
        if self.path.suffix.lower() == ".sog":
            return file_identity([self.path])
        files = list[Path]()
        for place in chunks_of(self.path):
            if place.is_dir():
                files += place.iterdir()
            else:
                files.append(place)
        return file_identity(sorted(filter(Path.is_file, files)))

    def parts(self, rows: int) -> list[tuple[int, int]]:
        return ranges(self._counts, rows)

    def positions(self, rows: int, start: int = 0) -> Iterator[Float32]:
        with _opened(self.path) as chunks:
            for number, begin in from_row(self._counts, start):
                means = chunks[number].means(self._counts[number])
                means = self.in_axes(means)
                for at in range(begin, len(means), rows):
                    yield means[at : at + rows]

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        with _opened(self.path) as chunks:
            for number, begin in from_row(self._counts, start):
                count = self._counts[number]
                decoder = _Decoder(chunks[number], count)
                for at in range(begin, count, rows):
                    raw = Raw.empty(min(rows, count - at), self._rest)
                    decoder.fill(slice(at, at + len(raw.means)), raw)
                    yield raw


@contextmanager
def _opened(path: Path) -> Iterator[list[_Chunk]]:
    if path.suffix.lower() == ".sog":
        places = [path]
    else:
        places = chunks_of(path)
    with ExitStack() as opened:
        yield [opened.enter_context(_chunk(place)) for place in places]


@contextmanager
def _chunk(path: Path) -> Iterator[_Chunk]:
    """Open a chunk: an archive, or a folder."""
    if path.is_dir():
        yield _Chunk(path, path)
        return
    try:
        with zipfile.ZipFile(path) as bundle:
            for info in bundle.infolist():  # as .NET writes them on Windows
                info.filename = info.filename.replace("\\", "/")
                bundle.NameToInfo[info.filename] = info
            metas = [name for name in bundle.namelist() if name.rpartition("/")[2] == "meta.json"]
            if not metas:
                raise InputError("has no meta.json", path=path)
            folder = min(metas, key=len).removesuffix("meta.json")
            yield _Chunk(path, zipfile.Path(bundle, folder))
    except InputError:
        raise
    except (
        zipfile.BadZipFile,
        EOFError,
        OSError,
        ValueError,
        struct.error,
        OverflowError,
    ) as error:
        raise damaged(f"is not a complete .sog archive ({error})", path=path) from error
