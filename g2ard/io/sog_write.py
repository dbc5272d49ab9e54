"""Writer for SOG version 2 (PlayCanvas): attributes as pixels of lossless images.

| attribute | code |
|---|---|
| mean | sign·ln(1 + \\|v\\|) over [min, max] of its axis, 16 bits, low and high byte in two images |
| quaternion | smallest three, 255(q/√2 + ½); A = 252 + the largest's index in w x y z |
| log-scale, sh0 | a codebook of 256 each, shared by the three axes or channels |
| opacity | 255·α, in A of sh0 |
| shN | one of K entries of a palette, whose values go through a codebook of 256 |
"""

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np

import g2ard._core as _core
from g2ard._core import __version__
from g2ard.arrays import Bytes, Float, Float32, Int, Rows, Values
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_folder, atomic_output
from g2ard.io.packing import (
    coded,
    log_scales,
    own_place,
    packing_order,
    rounding,
    smallest_three,
    unit_quats,
    writable,
)
from g2ard.io.types import Size
from g2ard.progress import Progress, silent
from g2ard.scene.shape import longer_axes
from g2ard.scene.splats import Splats
from g2ard.scene.transform import as_stored

_PALETTE_COLUMNS = 64  # entries of the palette per row of its image
_LONGEST_WEBP_SIDE = 16_383  # longest side of a WebP image, pixels
_KMEANS_STEPS = 6  # steps of k-means after the split; 10 more gain 0.01 dB


def write(
    path: Path,
    splats: Splats,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> float:
    """Write a .sog: the files of `sog_files`, zipped without compression; equal scenes give equal bytes.

    Return the largest change of a position by rounding.
    """
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(sog_bytes(splats, progress))
    return largest_rounding(splats)


def sog_bytes(splats: Splats, progress: Progress = silent) -> bytes:
    """Return the bytes of a .sog."""
    room = io.BytesIO()
    with zipfile.ZipFile(room, "w") as bundle:
        for name, content in sog_files(splats, progress=progress).items():
            info = zipfile.ZipInfo(name)  # of 1980, so that equal scenes give equal bytes
            bundle.writestr(info, content)
    return room.getvalue()


def write_folder(
    path: Path,
    splats: Splats,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> float:
    """Write `path`, a meta.json, and its images beside it; return what `write` returns."""
    with atomic_folder(path.parent, overwrite) as temporary:
        for name, content in sog_files(splats, progress=progress).items():
            (temporary / name).write_bytes(content)
    return largest_rounding(splats)


def largest_rounding(splats: Splats) -> float:
    """Return the largest change of a position by rounding."""
    near = as_stored(splats)
    low, high, codes = _means(near)
    logs = low + codes / 65535 * (high - low)
    stored = np.sign(logs) * np.expm1(np.abs(logs))
    packed = rounding(near, stored + near.offset)
    return rounding(splats, splats.narrowed()) + packed


def palette_size(count: int) -> int:
    """Return the largest palette for the harmonics of N Gaussians: min(64, 2^⌊log₂(N/1024)⌋)·1024.

    >>> palette_size(1), palette_size(100_000), palette_size(9_000)
    (1, 65536, 8192)
    """
    return min(1 << 16, 1 << (count.bit_length() - 1))


def sog_files(
    splats: Splats,
    *,
    ordered: bool = False,
    progress: Progress = silent,
) -> dict[str, bytes]:
    """Return the files of a scene by name, meta.json last; rows in `packing_order` unless already `ordered`.

    An `offset`, and other axes than y down, are stored under "g2ard" in meta.json; other programs show the
    recentred scene, upright.
    """
    splats = as_stored(writable(splats))
    if not ordered:
        splats = splats.take(packing_order(splats.means))
    width, height = _size(len(splats))
    files = {}
    meta = {
        "version": 2,
        "asset": {"generator": f"g2ard {__version__}"},
        "count": len(splats),
        "antialias": splats.antialiased,
    }
    if splats.antialiased:
        meta["model"] = "antialiased"  # newer spelling

    images = 7 if splats.sh_degree else 5
    progress("sog", 0, images)

    def image(name: str, pixels: Values) -> str:
        room = np.zeros((width * height, 4), np.uint8)
        room[:, 3] = 255
        room[: len(pixels), : pixels.shape[1]] = pixels
        files[f"{name}.webp"] = _webp(room.reshape(height, width, 4))
        progress("sog", len(files), images)
        return f"{name}.webp"

    low, high, codes = _means(splats)
    names = [image("means_l", codes & 255), image("means_u", codes >> 8)]
    meta["means"] = {
        "mins": low.tolist(),
        "maxs": high.tolist(),
        "files": names,
    }
    book, labels = _numbers(log_scales(splats))
    meta["scales"] = {
        "codebook": book.tolist(),
        "files": [image("scales", labels)],
    }
    largest, others = smallest_three(unit_quats(splats.quats))
    parts = coded(others / math.sqrt(2) + 0.5, 255)
    quats = np.column_stack([parts, 252 + largest])
    meta["quats"] = {"files": [image("quats", quats)]}
    book, labels = _numbers(splats.sh0[:, 0])
    sh0 = np.column_stack([labels, coded(splats.opacities, 255)])
    meta["sh0"] = {
        "codebook": book.tolist(),
        "files": [image("sh0", sh0)],
    }
    if splats.sh_degree:
        count, book, centroids, entry = _rest(splats)
        files["shN_centroids.webp"] = _webp(centroids)
        labels = np.column_stack([entry & 255, entry >> 8])
        meta["shN"] = {
            "count": count,
            "bands": splats.sh_degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", image("shN_labels", labels)],
        }
    own = own_place(splats)
    if own:
        meta["g2ard"] = own
    files["meta.json"] = json.dumps(meta, separators=(",", ":")).encode()
    return files


def _size(count: int) -> Size:
    """Return width and height, multiples of 4, of an image of `count` pixels."""
    width = math.ceil(math.sqrt(count) / 4) * 4
    height = math.ceil(count / width / 4) * 4
    if max(width, height) > _LONGEST_WEBP_SIDE:
        raise InputError(f"not written: {count:,} Gaussians exceed the largest SOG image")
    return width, height


def _webp(pixels: Bytes) -> bytes:
    from PIL import (
        Image,
        WebPImagePlugin,  # noqa: F401  (Pillow would load all its formats to find this one)
    )

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(
        buffer,
        "WEBP",
        lossless=True,
        exact=True,  # keeps the colours of pixels with A = 0, which are codes
        quality=50,
        method=2,
    )
    return buffer.getvalue()


def _means(splats: Splats) -> tuple[Float, Float, Int]:
    """Return the bounds of the logarithms per axis, and (N, 3) 16-bit codes between them."""
    means = splats.means.astype(float)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low = logs.min(axis=0)
    high = logs.max(axis=0)
    wide = np.where(high > low, high - low, 1.0)
    return low, high, coded((logs - low) / wide, 65535)


def _numbers(values: Values) -> tuple[Float32, Rows]:
    """Return a codebook of 256 entries, and the nearest entry of every value."""
    values = np.ascontiguousarray(values, np.float32)
    book = _core.codebook(values.ravel(), 256)
    return book, nearest(book, values)


def nearest(book: Float32, values: Float32) -> Rows:
    """Return the entry of an ascending codebook nearest to each value."""
    wide = book.astype(float)
    middles = (wide[1:] + wide[:-1]) / 2
    return np.searchsorted(middles, values)


def _weights(splats: Splats) -> Float32:
    """Return (N,) weights √(α·A) over their mean, A the product of the two larger scales.

    The root gains 0.35 dB over equal weights on a scene at 10×; α·A itself gains nothing.
    """
    areas = longer_axes(splats.scales.astype(float)).prod(axis=1)
    shown = np.sqrt(splats.opacities * np.minimum(areas, 1e30))
    mean = shown.mean()
    if not mean > 0:
        return np.ones(len(splats), np.float32)
    return (shown / mean).astype(np.float32)


def _rest(splats: Splats) -> tuple[int, Float32, Bytes, Values]:
    """Return the palette's size, codebook and image, and the (N,) entries of Gaussians."""
    rest = splats.shN.shape[1]
    points = np.ascontiguousarray(splats.shN.reshape(len(splats), 3 * rest))
    entries, labels = _core.palette(
        points,
        palette_size(len(splats)),
        _KMEANS_STEPS,
        _weights(splats),
    )
    count = len(entries)
    used = np.bincount(labels, minlength=count).astype(np.float32)
    book = _core.codebook(entries.ravel(), 256, np.repeat(used, 3 * rest))
    rows = math.ceil(count / _PALETTE_COLUMNS)
    image = np.zeros((rows * _PALETTE_COLUMNS, rest, 3), np.uint8)
    image[:count] = nearest(book, entries).reshape(-1, rest, 3)
    image = image.reshape(rows, _PALETTE_COLUMNS * rest, 3)
    return count, book, image, labels
