"""Images as arrays: resizing, rounding, and PNGs."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from g2ard.arrays import Bytes, Float32
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.types import Size


def resize(image: Float32, size: Size) -> Float32:
    """Resize an (H, W, C) float32 image to (width, height): by area when shrinking, bilinearly when growing.

    >>> resize(np.full((4, 8, 3), 0.5, np.float32), (2, 1)).tolist()
    [[[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]]
    """
    for axis, length in ((0, size[1]), (1, size[0])):
        if length < image.shape[axis]:
            image = _average(image, length, axis)
    height, width = image.shape[:2]
    if (width, height) != size:
        channels = []
        for values in np.moveaxis(image, 2, 0):
            plane = Image.fromarray(np.ascontiguousarray(values))
            resized = plane.resize(size, Image.Resampling.BILINEAR)
            channels.append(np.asarray(resized, np.float32))
        image = np.stack(channels, axis=2)
    return np.ascontiguousarray(image)


def _average(image: Float32, length: int, axis: int) -> Float32:
    """Return exact means over `length` equal parts of an axis, from differences of its running sum."""
    count = image.shape[axis]
    others = [i for i in range(3) if i != axis]
    pad = [(0, 0), (0, 0), (0, 0)]
    pad[axis] = (1, 0)
    sums = np.pad(np.cumsum(image, axis=axis, dtype=float), pad)
    edges = np.linspace(0, count, length + 1)
    below = np.minimum(edges.astype(int), count - 1)
    share = np.expand_dims(edges - below, others)
    low = sums.take(below, axis)
    high = sums.take(below + 1, axis)
    at_edges = low + share * (high - low)
    means = np.diff(at_edges, axis=axis) * (length / count)
    return means.astype(np.float32)


def to_bytes(image: ArrayLike) -> Bytes:
    """Convert values in [0, 1] to bytes, clipped and rounded to nearest; bytes are unchanged, NaN is black.

    >>> to_bytes([[-1.0, 0.5, 2.0]]).tolist()
    [[0, 128, 255]]
    """
    values = np.asarray(image)
    if values.dtype == np.uint8:
        return values
    inside = np.clip(np.nan_to_num(values, nan=0.0), 0, 1)
    return np.rint(inside * 255).astype(np.uint8)


def as_saved(image: ArrayLike) -> Float32:
    """Round an image in [0, 1] like an 8-bit PNG: clipped, in multiples of 1/255.

    >>> (255 * as_saved([[-1.0, 0.5, 2.0]])).tolist()
    [[0.0, 128.0, 255.0]]
    """
    return to_bytes(image).astype(np.float32) / np.float32(255)


def write_png(
    path: str | Path,
    image: ArrayLike,
    *,
    overwrite: bool = False,
) -> None:
    """Write (H, W, 3), (H, W, 4) or (H, W) floats in [0, 1] or bytes as an 8-bit PNG, atomically."""
    values = to_bytes(image)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    channels = values.shape[2:]
    if not values.size or values.ndim < 2 or channels not in ((), (3,), (4,)):
        raise InputError(f"expected an image, got an array of shape {values.shape}", path=path)
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(png_bytes(values))


def png_bytes(image: ArrayLike) -> bytes:
    """Return an image, as `write_png` takes it, as the content of a PNG file."""
    content = BytesIO()
    pixels = np.ascontiguousarray(to_bytes(image))
    Image.fromarray(pixels).save(content, format="PNG", compress_level=3)
    return content.getvalue()
