"""Reader and writer for SuperSplat's .compressed.ply: 16 bytes per Gaussian, quantised in chunks of 256."""

import math
import re
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured, unstructured_to_structured

from g2ard.arrays import Float, Float32, Values
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.packing import (
    coded,
    from_smallest_three,
    log_scales,
    packing_order,
    rounding,
    smallest_three,
    unit_quats,
    writable,
)
from g2ard.io.plyfiles import (
    axes_of,
    comments_of,
    offset_of,
    read_element,
    read_header,
    render_model_of,
    require,
    row_blocks,
    up_of,
)
from g2ard.io.sanitize import Raw, logits_of
from g2ard.io.stream import RawStream
from g2ard.progress import plural
from g2ard.scene.splats import SH_C0, Splats
from g2ard.scene.transform import as_stored

_CHUNK_ROWS = 256
_SCALE_LIMIT = 20.0
"""Log-scales are clamped to ±20, as in SuperSplat, since an outlier would coarsen its chunk."""

_VECTOR_BITS = 11, 10, 11  # bits of the three components of a position or scale
_BOUNDS = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
]
"""Bounds of a chunk: of positions, log-scales and colours."""

_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


class Stream(RawStream):
    """Scene in blocks; memory holds all chunk bounds, 144 bytes per 256 Gaussians."""

    def __init__(self, path: Path) -> None:
        header = read_header(path)
        require(header.properties("vertex"), _PACKED, "a compressed scene")
        chunk_properties = header.properties("chunk")
        # older files: colours over [0, 1]
        if "min_r" in chunk_properties:
            bounds = _BOUNDS
        else:
            bounds = _BOUNDS[:12]
        require(chunk_properties, bounds, "a compressed scene", "chunk")
        rest = [p for p in header.properties("sh") if re.fullmatch(r"f_rest_\d+", p)]
        if len(rest) not in (0, 9, 24, 45) or set(rest) != set(_rest_names(len(rest))):
            raise InputError(f"element 'sh' has {len(rest)} coefficients; expected 9, 24 or 45")

        names = ["vertex", "chunk"]
        if rest:
            names.append("sh")
        vertex, chunk, *sh = read_element(path, header, *names)
        count = len(vertex)
        if len(chunk) * _CHUNK_ROWS < count or any(len(each) != count for each in sh):
            raise InputError(f"{len(chunk)} chunks and {plural(count, 'Gaussian')} do not fit")
        for name in _PACKED:
            if vertex.dtype[name] != np.uint32:
                raise InputError(f"has type {vertex.dtype[name]}, expected uint", property=name)
        offset = offset_of(header)
        model = render_model_of(header.comments)
        if model != "antialiased":
            model = "classic"
        self._rest = len(rest) // 3
        super().__init__(path, count, self._rest, offset, render_model=model)
        self.up = up_of(header.comments)
        self.restore(axes_of(header))
        self._vertex = vertex
        self._sh = next(iter(sh), None)
        kinds = len(bounds) // 6
        self._bounds = np.zeros((len(chunk), 3, 2, 3))
        self._bounds[:, kinds:, 1] = 1
        stored = structured_to_unstructured(np.asarray(chunk)[bounds])
        self._bounds[:, :kinds] = stored.reshape(len(chunk), kinds, 2, 3)

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        bands: Iterator[Any] = repeat((0, None))
        if self._sh is not None:
            bands = row_blocks(self.path, self._sh, rows, start)
        vertices = row_blocks(self.path, self._vertex, rows, start)
        for (first, vertex), (_, sh) in zip(vertices, bands, strict=False):
            yield self._decode(first, vertex, sh)

    def _decode(self, first: int, vertex: Values, sh: Values | None) -> Raw:
        raw = Raw.empty(len(vertex), self._rest)
        position, rotation, scale, color = (vertex[name] for name in _PACKED)
        means, scales, colors = self._bounds.swapaxes(0, 1)
        raw.means[:] = _between(means, first, _unpacked(position, _VECTOR_BITS))
        raw.log_scales[:] = _between(scales, first, _unpacked(scale, _VECTOR_BITS))
        others = (_unpacked(rotation, (10, 10, 10)) - 0.5) * np.sqrt(2)
        largest = rotation >> np.uint32(30)
        raw.quats[:] = from_smallest_three(largest, others)
        rgba = _unpacked(color, (8, 8, 8, 8))
        rgb = _between(colors, first, rgba[:, :3])
        raw.sh0[:, 0] = (rgb - 0.5) / SH_C0
        raw.logit_opacities[:] = logits_of(rgba[:, 3])
        if sh is not None:
            codes = structured_to_unstructured(sh[_rest_names(3 * self._rest)])
            channels = _coefficient(codes).reshape(len(sh), 3, -1)
            raw.shN[:] = channels.swapaxes(1, 2)
        return raw


def _between(bounds: Values, first: int, t: Float) -> Float:
    """Interpolate by `t` between the (chunks, 2, 3) bounds of each Gaussian's chunk, from row `first` on."""
    chunks = np.arange(first, first + len(t)) // _CHUNK_ROWS
    low, high = bounds[chunks].astype(float).swapaxes(0, 1)
    return low * (1 - t) + high * t


def _coefficient(codes: Values) -> Float:
    """Decode bytes to [−4, 4]: bucket centres, except that the first and last bucket are the ends."""
    t = (codes.astype(float) + 0.5) / 256
    t[codes == 0] = 0
    t[codes == 255] = 1
    return (t - 0.5) * 8


def write(path: Path, splats: Splats, *, overwrite: bool = False) -> float:
    """Write a .compressed.ply: 16 bytes per Gaussian, plus one per harmonic past band 0.

    Gaussians are written in `packing_order`, which keeps the bounds of chunks tight. An `offset`, axes, the
    render model and the up direction are stored in comments, as in .ply. Return the largest change of a
    position by rounding.
    """
    from plyfile import PlyData, PlyElement

    given = writable(splats)
    given = given.take(packing_order(given.means, _CHUNK_ROWS))
    error = rounding(given, given.narrowed())
    splats = as_stored(given)
    words = np.empty(len(splats), [(name, "<u4") for name in _PACKED])
    means, shares = _within(splats.means)
    words["packed_position"] = _packed(shares, _VECTOR_BITS)
    largest, others = smallest_three(unit_quats(splats.quats))
    rotations = _packed(others / math.sqrt(2) + 0.5, (10, 10, 10))
    words["packed_rotation"] = largest.astype(np.uint32) << np.uint32(30) | rotations
    logs = np.clip(log_scales(splats), -_SCALE_LIMIT, _SCALE_LIMIT)
    scales, shares = _within(logs)
    words["packed_scale"] = _packed(shares, _VECTOR_BITS)
    colors, shares = _within(splats.colors)
    rgba = np.column_stack([shares, splats.opacities])
    words["packed_color"] = _packed(rgba, (8, 8, 8, 8))
    bounds = np.concatenate([means, scales, colors], axis=1).reshape(len(means), -1)
    types = np.dtype([(name, "<f4") for name in _BOUNDS])
    chunk = unstructured_to_structured(bounds, types)
    elements = [
        PlyElement.describe(chunk, "chunk"),
        PlyElement.describe(words, "vertex"),
    ]
    if splats.sh_degree:
        elements.append(PlyElement.describe(_harmonics(splats), "sh"))
    comments = comments_of(splats)
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData(elements, byte_order="<", comments=comments).write(file)
    stored = _between(means, 0, _unpacked(words["packed_position"], _VECTOR_BITS))
    return error + rounding(splats, stored + splats.offset)


def _within(values: Values) -> tuple[Float32, Float]:
    """Return the (chunks, 2, 3) bounds of the values of chunks, and values scaled to [0, 1] within them."""
    starts = np.arange(0, len(values), _CHUNK_ROWS)
    lows = np.minimum.reduceat(values, starts)
    highs = np.maximum.reduceat(values, starts)
    ends = np.stack([lows, highs], axis=1).astype(np.float32)
    chunks = np.arange(len(values)) // _CHUNK_ROWS
    low, high = ends[chunks].astype(float).swapaxes(0, 1)
    wide = high - low
    wide[wide == 0] = 1
    return ends, (values - low) / wide


def _packed(values: Float, bits: tuple[int, ...]) -> Values:
    """Pack (N, C) in [0, 1] into words, the first column in the highest bits."""
    word = np.zeros(len(values), np.uint32)
    for k, width in enumerate(bits):
        part = coded(values[:, k], (1 << width) - 1)
        word = word << np.uint32(width) | part.astype(np.uint32)
    return word


def _unpacked(words: Values, bits: tuple[int, ...]) -> Float:
    """Return the (N, C) values in [0, 1] that `_packed` takes."""
    values = np.empty((len(words), len(bits)))
    shift = 0
    for k, width in reversed(list(enumerate(bits))):
        top = (1 << width) - 1
        part = words >> np.uint32(shift) & np.uint32(top)
        values[:, k] = part / top
        shift += width
    return values


def _harmonics(splats: Splats) -> Values:
    """Quantise coefficients in [−4, 4] to bytes, channel-major."""
    values = splats.shN.swapaxes(1, 2).reshape(len(splats), -1).astype(float)
    buckets = np.floor((values / 8 + 0.5) * 256)
    codes = np.clip(buckets, 0, 255).astype(np.uint8)
    names = [(name, "u1") for name in _rest_names(codes.shape[1])]
    return unstructured_to_structured(codes, np.dtype(names))


def _rest_names(count: int) -> list[str]:
    return [f"f_rest_{k}" for k in range(count)]
