"""Reader for SOG scenes (PlayCanvas): a meta.json and lossless images, in folders or zipped as .sog.

A folder may hold a scene in spatial chunks, named `{lod}_{chunk}` or listed by a lod-meta.json. Only the
finest level of detail is read.
"""

import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from g2ard.errors import InputError, damaged
from g2ard.io.jsonfile import FileName, Place, Whole, checked, parse_json, read_json
from g2ard.io.limits import check_unpacked
from g2ard.io.paths import check_regular, file_identity
from g2ard.io.sanitize import Raw
from g2ard.io.sog_chunk import Chunk, Decoder, Meta, count_of, means_of, rest_of
from g2ard.io.stream import RawStream, from_row
from g2ard.io.types import Note
from g2ard.progress import plural
from g2ard.scene.transform import one_model

_CHUNK_NAME = re.compile(r"(\d+)_(\d+)")


class _Lod(msgspec.Struct):
    file: Whole


class _Lods(msgspec.Struct):
    finest: _Lod | UnsetType = msgspec.field(default=UNSET, name="0")


class _Node(msgspec.Struct):
    children: list["_Node"] = []
    lods: _Lods = msgspec.field(default_factory=_Lods)


class _Levels(msgspec.Struct):
    """Content of a lod-meta.json."""

    tree: _Node
    filenames: list[FileName]
    environment: str | None = None


def chunks_of(path: Path) -> list[Path]:
    """Return the folders of a scene's chunks at the finest level; [] if `path` is not a SOG scene."""
    if path.is_file():
        path = path.parent if path.name == "meta.json" else path
    if (path / "meta.json").is_file():
        return [path]
    if path.name == "lod-meta.json" or (path / "lod-meta.json").is_file():
        return _listed(path if path.is_file() else path / "lod-meta.json")
    if not path.is_dir():
        return []
    folders = sorted(p.parent for p in path.glob("*/meta.json"))
    named = [(folder, match) for folder in folders if (match := _CHUNK_NAME.fullmatch(folder.name))]
    if not named:
        return folders
    finest = min(int(match[1]) for _, match in named)
    numbered = sorted((int(match[2]), folder) for folder, match in named if int(match[1]) == finest)
    return [folder for _, folder in numbered]


def _listed(index: Path) -> list[Path]:
    """Return the chunks that lod-meta.json's tree uses at level 0, in the order of its list, and the sky."""
    content = checked(read_json(index), _Levels, Place(index))
    names, sky = content.filenames, content.environment
    files = [index.parent / Path(name).parent for name in names]
    used: set[int] = set()
    nodes = [(content.tree, Place(index).to("tree"))]
    while nodes:
        node, place = nodes.pop()
        nodes.extend((child, place.to("children", i)) for i, child in enumerate(node.children))
        if node.lods.finest is not UNSET:
            at = node.lods.finest.file
            if at >= len(files):
                raise place.to("lods", "0", "file").error(f"is {at}, but there are {len(files)} filenames")
            used.add(at)
    for i in sorted(used):
        place = Place(index).to("filenames", i)
        try:
            there = (files[i] / "meta.json").is_file()
        except OSError as error:  # a name too long
            raise place.error(f"cannot be found ({error.strerror})") from error
        if not there:
            raise place.error(f"is {names[i]}, which does not exist")
    chunks = [files[i] for i in sorted(used)]
    if sky and (index.parent / sky).is_file():
        chunks.append((index.parent / sky).parent)
    return chunks


def _offset(chunks: list[Chunk]) -> NDArray[np.float64]:
    """Return the offset that g2ard stored under "g2ard"; zeros if it is missing or chunks differ."""
    found = {chunk.meta.g2ard.offset for chunk in chunks}
    return np.array(found.pop() if len(found) == 1 else (0, 0, 0), np.float64)


def _left_out(path: Path, read_count: int) -> list[Note]:
    """Note coarser levels, or other folders beside the chunks."""
    folder = path if path.is_dir() else path.parent
    if path.suffix.lower() == ".sog" or (folder / "meta.json").is_file():
        return []
    others = len(list(folder.glob("*/meta.json"))) - read_count
    text = f"{plural(others, 'other SOG folder')} ignored (coarser levels of detail)"
    return [Note("ignored_chunks", others, text)] if others > 0 else []


class Stream(RawStream):
    """SOG scene, version 1 or 2: a .sog, a meta.json or its folder, or a folder of chunks.

    Chunks are padded with zeros to the highest SH degree, and blocks do not cross chunks. Memory holds a
    chunk's images, 20 to 28 bytes per Gaussian.
    """

    def __init__(self, path: Path) -> None:
        with _opened(path) as chunks:
            self._counts = [count_of(chunk) for chunk in chunks]
            self._rest = max(map(rest_of, chunks), default=0)
            offset, model = (
                _offset(chunks),
                one_model([chunk.meta.render_model for chunk in chunks] or ["classic"]),
            )
        notes = tuple(_left_out(path, len(chunks)))
        super().__init__(path, sum(self._counts), self._rest, offset, notes, model)

    def identity(self) -> list[Any]:
        if self.path.suffix.lower() == ".sog":
            return file_identity([self.path])
        files = (file for folder in chunks_of(self.path) for file in folder.iterdir() if file.is_file())
        return file_identity(sorted(files))

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        with _opened(self.path) as chunks:
            for chunk, count in zip(chunks, self._counts, strict=True):
                yield means_of(chunk, count)

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        with _opened(self.path) as chunks:
            for number, begin in from_row(self._counts, start):
                count = self._counts[number]
                decoder = Decoder(chunks[number], count)
                for at in range(begin, count, rows):
                    raw = Raw.empty(min(rows, count - at), self._rest)
                    decoder.fill(slice(at, at + len(raw.means)), raw)
                    yield raw


@contextmanager
def _opened(path: Path) -> Iterator[list[Chunk]]:
    if path.suffix.lower() != ".sog":
        yield [
            _chunk(folder, read_json(folder / "meta.json"), _folder_loader(folder))
            for folder in chunks_of(path)
        ]
        return
    try:
        with zipfile.ZipFile(path) as bundle:
            inside = [name for name in bundle.namelist() if name.rpartition("/")[2] == "meta.json"]
            if not inside:
                raise InputError("has no meta.json", path=path)
            prefix = min(inside, key=len).removesuffix("meta.json")
            load = _bundle_loader(path, bundle, prefix)
            yield [_chunk(path, parse_json(path / "meta.json", load("meta.json")), load)]
    except InputError:
        raise
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, struct.error, OverflowError) as error:
        raise damaged(f"is not a complete .sog archive ({error})", path=path) from error


def _chunk(place: Path, content: Any, load: Callable[[str], bytes]) -> Chunk:
    return Chunk(place, checked(content, Meta, Place(place / "meta.json")), load)


def _bundle_loader(path: Path, bundle: zipfile.ZipFile, prefix: str) -> Callable[[str], bytes]:
    """Return a function that reads a file of the archive within `check_unpacked`."""

    def load(name: str) -> bytes:
        info = bundle.getinfo(prefix + name)
        check_unpacked(path / name, info.compress_size, info.file_size)
        try:
            return bundle.read(info)
        except (zipfile.BadZipFile, EOFError, OSError, ValueError, RuntimeError, zlib.error) as error:
            raise InputError(f"is damaged in the archive ({error})", path=path / name) from error

    return load


def _folder_loader(folder: Path) -> Callable[[str], bytes]:
    def load(name: str) -> bytes:
        check_regular(folder / name)
        return (folder / name).read_bytes()

    return load
