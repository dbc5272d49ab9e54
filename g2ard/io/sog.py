"""SOG scenes (PlayCanvas): a meta.json and lossless images, in a folder, in several, or zipped as .sog.

A folder may hold one scene as spatial chunks, named `{lod}_{chunk}` or listed by a lod-meta.json. Levels of
detail are alternatives, not parts: only the finest is read.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from g2ard.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL.Image import Image

    from g2ard.io.clean import Raw
    from g2ard.io.types import Note, Scene

__all__ = ["chunks_of", "read"]

_CHUNK_NAME = re.compile(r"(\d+)_(\d+)")
_COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}
_PALETTE_COLUMNS = 64
"""Entries of the SH palette beside each other in one row of its image."""


class _Chunk(NamedTuple):
    """One meta.json, and how to get at the files beside it."""

    name: str
    meta: dict[str, Any]
    load: Callable[[str], bytes]


def chunks_of(path: Path) -> list[Path]:
    """The folders whose meta.json together are the scene at `path`, finest level only; [] if there are none.

    Raises:
        InputError: lod-meta.json is broken or names a chunk that is absent.
    """
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
    """The chunks that lod-meta.json's tree uses at level 0, in the order of its list."""
    from g2ard.io.jsonfile import read_json

    content = read_json(index)
    try:
        files = [index.parent / Path(name).parent for name in content["filenames"]]
        used: set[int] = set()
        nodes = [content["tree"]]
        while nodes:
            node = nodes.pop()
            nodes.extend(node.get("children", ()))
            if "0" in node.get("lods", {}):
                used.add(int(node["lods"]["0"]["file"]))
        chunks = [files[i] for i in sorted(used)]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{index}: not a valid lod-meta.json ({error!r})") from error
    for chunk in chunks:
        if not (chunk / "meta.json").is_file():
            raise InputError(f"{index}: names {chunk.name}/meta.json, which is absent")
    return chunks


def read(path: Path) -> Scene:
    """Read a SOG scene, version 1 or 2: a .sog, a meta.json or its folder, or a folder of chunks.

    Chunks of different SH degrees are padded with zeros to the highest.

    Raises:
        InputError: a part is missing or broken, or nothing in it is finite.
    """
    from g2ard.io.clean import Raw, cleaned

    with _opened(path) as chunks:
        counts = [_count(chunk) for chunk in chunks]
        decoded_rest = [_rest_coefficients(chunk) for chunk in chunks]
        raw = Raw.empty(sum(counts), max(decoded_rest, default=0))
        start = 0
        for chunk, count in zip(chunks, counts, strict=True):
            _decode(chunk, raw, slice(start, start + count))
            start += count
        raw.offset = _offset(chunks)
    return cleaned(path, raw, _left_out(path, len(chunks)))


def _offset(chunks: list[_Chunk]) -> NDArray[np.float64]:
    """What g2ard's own writer left under "g2ard"; zeros without it, or where chunks differ."""
    import numpy as np

    found = set()
    for chunk in chunks:
        with _meta_errors(chunk):
            own = chunk.meta.get("g2ard", {})
            x, y, z = own.get("offset", (0, 0, 0))
            found.add((float(x), float(y), float(z)))
    return np.array(found.pop() if len(found) == 1 else (0, 0, 0), np.float64)


def _left_out(path: Path, read_count: int) -> list[Note]:
    """Say that coarser levels, or an environment, lie beside the chunks that were read."""
    from g2ard.io.types import Note

    folder = path if path.is_dir() else path.parent
    if path.suffix.lower() == ".sog" or (folder / "meta.json").is_file():
        return []
    others = len(list(folder.glob("*/meta.json"))) - read_count
    text = f"{others} other SOG folder(s) left out (coarser levels of detail, environment)"
    return [Note("ignored_chunks", others, text)] if others > 0 else []


@contextmanager
def _opened(path: Path) -> Iterator[list[_Chunk]]:
    from g2ard.io.jsonfile import parse_json, read_json

    if path.suffix.lower() != ".sog":
        yield [_Chunk(str(f), read_json(f / "meta.json"), _folder_loader(f)) for f in chunks_of(path)]
        return
    try:
        with zipfile.ZipFile(path) as bundle:
            inside = [name for name in bundle.namelist() if name.rpartition("/")[2] == "meta.json"]
            if not inside:
                raise InputError(f"{path}: no meta.json in it")
            prefix = min(inside, key=len).removesuffix("meta.json")
            load = _bundle_loader(path, bundle, prefix)
            meta = parse_json(f"{path}: meta.json", load("meta.json"))
            yield [_Chunk(str(path), meta, load)]
    except InputError:
        raise
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, struct.error, OverflowError) as error:
        raise InputError(f"{path}: not a whole .sog archive ({error})") from error


def _bundle_loader(path: Path, bundle: zipfile.ZipFile, prefix: str) -> Callable[[str], bytes]:
    """Reads a file of the archive: whole, and of a size within `check_unpacked`."""
    from g2ard.io.limits import check_unpacked

    def load(name: str) -> bytes:
        info = bundle.getinfo(prefix + name)
        check_unpacked(f"{path}: {name}", info.compress_size, info.file_size)
        try:
            return bundle.read(info)
        except (zipfile.BadZipFile, EOFError, OSError, ValueError, RuntimeError, zlib.error) as error:
            raise InputError(f"{path}: {name}: not whole in the .sog archive ({error})") from error

    return load


def _folder_loader(folder: Path) -> Callable[[str], bytes]:
    return lambda name: (folder / name).read_bytes()


@contextmanager
def _meta_errors(chunk: _Chunk) -> Iterator[None]:
    """Turn what a malformed meta.json causes into one line that names it."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{chunk.name}: malformed meta.json ({error!r})") from error


def _count(chunk: _Chunk) -> int:
    with _meta_errors(chunk):
        version = chunk.meta.get("version", 1)
        if version not in (1, 2):
            raise InputError(f"{chunk.name}: SOG version {version!r} is not known (1 and 2 are)")
        count = chunk.meta["count"] if version == 2 else chunk.meta["means"]["shape"][0]
        if not isinstance(count, int) or count < 0:
            raise InputError(f"{chunk.name}: malformed meta.json (count is {count!r})")
        first = chunk.meta["means"]["files"][0]
    with _opened_image(chunk, first) as image:  # before room is made for them
        if image.width * image.height < count:
            pixels = image.width * image.height
            raise InputError(f"{chunk.name}: {first} has {pixels:,} pixels for {count:,} Gaussians")
    return count


def _rest_coefficients(chunk: _Chunk) -> int:
    """How many coefficients past band 0; version 1 tells only by the width of its palette image."""
    with _meta_errors(chunk):
        if "shN" not in chunk.meta:
            return 0
        if "bands" in chunk.meta["shN"]:
            return _COEFFICIENTS[chunk.meta["shN"]["bands"]]
        width = _image(chunk, _sh_files(chunk)[0]).shape[1]
        return {_PALETTE_COLUMNS * k: k for k in (3, 8, 15)}[width]


def _sh_files(chunk: _Chunk) -> tuple[str, str]:
    files = chunk.meta["shN"]["files"]
    centroids = next((f for f in files if "centroids" in f), files[0])
    return centroids, next((f for f in files if f != centroids), files[1])


@contextmanager
def _opened_image(chunk: _Chunk, name: str) -> Iterator[Image]:
    from PIL import (
        WebPImagePlugin,  # noqa: F401  (Pillow would load all its formats to find this one)
    )

    from g2ard.io.limits import opened_image

    where = f"{chunk.name}: {name}"
    try:
        data = chunk.load(name)
    except (KeyError, FileNotFoundError) as error:
        raise InputError(f"{where} is missing") from error
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{where} cannot be read ({error})") from error
    with opened_image(where, io.BytesIO(data)) as image:
        yield image


def _image(chunk: _Chunk, name: str) -> NDArray[np.uint8]:
    """(height, width, 4) bytes."""
    import numpy as np

    with _opened_image(chunk, name) as image:
        return np.asarray(image.convert("RGBA"))


def _rows(chunk: _Chunk, name: str, count: int) -> NDArray[np.uint8]:
    """(count, 4) bytes, one pixel a Gaussian."""
    pixels = _image(chunk, name).reshape(-1, 4)
    if len(pixels) < count:
        raise InputError(f"{chunk.name}: {name} has {len(pixels):,} pixels for {count:,} Gaussians")
    return pixels[:count]


def _decode(chunk: _Chunk, raw: Raw, at: slice) -> None:
    from g2ard.io.clean import BLOCK

    meta, count = chunk.meta, at.stop - at.start
    with _meta_errors(chunk):
        low, high, quats, scales, base = (
            _rows(chunk, name, count)
            for part, files in (("means", 2), ("quats", 1), ("scales", 1), ("sh0", 1))
            for name in meta[part]["files"][:files]
        )
        positions = _positions(meta["means"])
        logits = _logits(meta["sh0"])
        for start in range(0, count, BLOCK):  # what is made in between stays in the cache
            rows = slice(start, min(start + BLOCK, count))
            to = slice(at.start + rows.start, at.start + rows.stop)
            code = low[rows, :3] + (high[rows, :3].astype(int) << 8)
            for axis in range(3):
                raw.means[to, axis] = positions[axis][code[:, axis]]
            raw.quats[to] = _quats(quats[rows])
            raw.log_scales[to] = _values(meta["scales"], scales[rows, :3], slice(3))
            raw.sh0[to, 0] = _values(meta["sh0"], base[rows, :3], slice(3))
            raw.logit_opacities[to] = logits[base[rows, 3]]
        _decode_rest(chunk, raw.shN[at])


def _positions(part: dict[str, Any]) -> NDArray[Any]:
    """(3, 65536) what each code stands for on each axis; stored as sign(x)·ln(|x| + 1)."""
    import numpy as np

    logs = _lerp(part, np.arange(65536)[:, None] / 65535, slice(3))
    return (np.sign(logs) * np.expm1(np.abs(logs))).T.astype(np.float32)


def _logits(part: dict[str, Any]) -> NDArray[Any]:
    """(256,) what each byte of opacity stands for: an α (version 2), or a logit (version 1)."""
    import numpy as np

    alpha = np.arange(256) / 255
    if "codebook" not in part:
        return _lerp(part, alpha, 3)
    with np.errstate(divide="ignore"):
        return np.log(alpha) - np.log1p(-alpha)


def _values(part: dict[str, Any], codes: NDArray[np.uint8], channels: slice) -> NDArray[Any]:
    """Bytes to values: by codebook (version 2), or between mins and maxs (version 1)."""
    import numpy as np

    if "codebook" in part:
        return np.asarray(part["codebook"], np.float32)[codes]
    return _lerp(part, codes / 255, channels)


def _lerp(part: dict[str, Any], t: NDArray[Any], channels: slice | int) -> NDArray[Any]:
    import numpy as np

    low, high = np.asarray(part["mins"], np.float64), np.asarray(part["maxs"], np.float64)
    if low.ndim:
        low, high = low[channels], high[channels]
    return low + (high - low) * t


def _quats(codes: NDArray[np.uint8]) -> NDArray[Any]:
    """(N, 4) wxyz: three components in ±1/√2; the fourth byte − 252 says which is left out, the largest.

    Any other fourth byte gives a zero quaternion, which is counted and made the identity later.
    """
    import numpy as np

    parts = np.zeros((len(codes), 5))  # the three, the largest, and nothing
    parts[:, :3] = (codes[:, :3] / 255 - 0.5) * np.sqrt(2)
    parts[:, 3] = np.sqrt(np.maximum(0, 1 - (parts[:, :3] ** 2).sum(1)))
    source = np.full((256, 4), 4)
    source[252:] = [[3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2], [0, 1, 2, 3]]
    quats: NDArray[Any] = np.take_along_axis(parts, source[codes[:, 3]], axis=1)
    return quats


def _decode_rest(chunk: _Chunk, out: NDArray[np.float32]) -> None:
    """Fill (n, K−1, 3): each Gaussian's label picks a palette entry, whose bytes pick values."""
    import numpy as np

    from g2ard.io.clean import BLOCK

    rest = _rest_coefficients(chunk)
    out[:, rest:] = 0
    if not rest:
        return
    centroids, labels = _sh_files(chunk)
    image = _image(chunk, centroids)
    if image.shape[1] != _PALETTE_COLUMNS * rest:
        raise InputError(f"{chunk.name}: {centroids} is {image.shape[1]} wide, not {_PALETTE_COLUMNS * rest}")
    palette = _values(chunk.meta["shN"], image[:, :, :3].reshape(-1, rest, 3), slice(3)).astype(np.float32)
    codes = _rows(chunk, labels, len(out))
    for start in range(0, len(out), BLOCK):
        rows = slice(start, start + BLOCK)
        index = codes[rows, 0] + (codes[rows, 1].astype(np.intp) << 8)
        if index.max() >= len(palette):
            row = int(np.argmax(index >= len(palette)))
            named = f"Gaussian {start + row} names entry {index[row]} of {len(palette)}"
            raise InputError(f"{chunk.name}: {labels}: {named}")
        np.take(palette, index, axis=0, out=out[rows, :rest], mode="clip")
