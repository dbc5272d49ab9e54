"""Writing Niantic's .spz, versions 2 to 4; see `g2ard.io.spz` for what they hold."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.packing import (
    coded,
    log_scales,
    morton_order,
    smallest_three,
    unit_quats,
    world_means,
    writable,
)
from g2ard.io.spz import COLOR_SCALE, FLIPS, MAGIC, zstandard
from g2ard.scene.splats import Splats

__all__ = ["VERSIONS", "fraction_bits", "write"]

VERSIONS = (2, 3, 4)

_USUAL_BITS, _MOST_BITS = 12, 20
_BUCKETS = (8, 16)
"""Steps that band 1, and bands past it, are rounded to: 5 and 4 of their 8 bits, as SPZ's own packer does."""


def write(path: Path, splats: Splats, *, overwrite: bool = False, version: int = 4) -> None:
    """Write an .spz; equal scenes give equal bytes.

    Scales are held to e^−10 … e^5.94, harmonics to ±1, colours to a little past [0, 1].

    Args:
        path: the file to write.
        splats: the scene.
        overwrite: whether an existing file may be replaced.
        version: 4 (Zstandard streams), 3 (gzip) or 2 (gzip, coarser rotations, read by more programs).

    Raises:
        OutputError: see `atomic_output`.
        InputError: the scene is empty, has a non-finite value, or an offset that 24 bits do not hold.
        MissingDependencyError: version 4 before Python 3.14 without `pip install g2ard[spz]`.
    """
    if version not in VERSIONS:
        raise InputError(f"SPZ version {version} is not written (2, 3 and 4 are)", path=path)
    splats = writable(path, splats)
    splats = splats.take(morton_order(splats.means))
    means = world_means(path, splats, ".spz")
    bits = fraction_bits(path, means, splats)
    streams = _streams(splats, means, bits, version)
    head = MAGIC + struct.pack("<IIBBB", version, len(splats), splats.sh_degree, bits, 0)
    if version < 4:
        content = gzip.compress(head + b"\0" + b"".join(streams), 9, mtime=0)
    else:
        zstd = zstandard(path)
        packed = [zstd.compress(stream, 19) for stream in streams]
        sizes = zip(packed, streams, strict=True)
        table = b"".join(struct.pack("<QQ", len(p), len(stream)) for p, stream in sizes)
        content = head + struct.pack("<BI12x", len(streams), 32) + table + b"".join(packed)
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(content)


def fraction_bits(path: Path, means: NDArray[np.float64], splats: Splats) -> int:
    """Fractional bits of the 24 of a coordinate: the usual 12, more where a step of 2^−12 would be more than
    a quarter of the middle scale of one Gaussian in a hundred, as many as the extent leaves.

    Raises:
        InputError: the steps left are coarser than half of the Gaussians are thin.
    """
    farthest = float(np.abs(means).max())
    room = 23 - math.ceil(math.log2(max(farthest, 2.0**-20) * (1 + 2**-20)))
    middle = np.sort(splats.scales, axis=1)[:, 1].astype(np.float64)
    fine = max(float(np.percentile(middle, 1)), 1e-12)
    wanted = math.ceil(-math.log2(fine / 4))
    bits = min(max(_USUAL_BITS, wanted), _MOST_BITS, room)
    if bits < 0 or 2.0**-bits > max(float(np.median(middle)), 2.0**-_USUAL_BITS):
        raise InputError(
            f".spz holds steps of {2.0**-bits:g} at {farthest:g} from the origin; "
            "write another format, or drop the offset with `g2ard convert --recentre`",
            path=path,
        )
    return bits


def _streams(splats: Splats, means: NDArray[np.float64], bits: int, version: int) -> list[bytes]:
    """Positions, alphas, colours, scales, rotations and, where there are any, harmonics."""
    fixed = np.rint(means * (1, -1, -1) * (1 << bits)).astype("<i4")
    quats = unit_quats(splats.quats) * (1, 1, -1, -1)
    streams = [
        fixed.reshape(-1, 1).view(np.uint8)[:, :3].tobytes(),
        _bytes(splats.opacities.astype(np.float64) * 255),
        _bytes((splats.sh0[:, 0].astype(np.float64) * COLOR_SCALE + 0.5) * 255),
        _bytes((log_scales(splats) + 10) * 16),
        _xyz(quats) if version == 2 else _packed(quats),
    ]
    if splats.sh_degree:
        streams.append(_harmonics(splats))
    return streams


def _bytes(values: NDArray[Any]) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _xyz(quats: NDArray[np.float64]) -> bytes:
    """Version 2: x y z of the sign that makes w ≥ 0."""
    return _bytes(quats[:, 1:] * np.where(quats[:, :1] < 0, -1, 1) * 127.5 + 127.5)


def _packed(quats: NDArray[np.float64]) -> bytes:
    """2 bits name the largest of x y z w; then sign and 9 bits of |q|·√2 of the others, in order."""
    largest, others = smallest_three(quats[:, [1, 2, 3, 0]])
    words = largest.astype(np.uint32)
    for k in range(3):
        part = (others[:, k] < 0).astype(np.uint32) << 9 | coded(
            np.abs(others[:, k]) * math.sqrt(2), 511
        ).astype(np.uint32)
        words = (words << np.uint32(10) | part).astype(np.uint32)
    return words.astype("<u4").tobytes()


def _harmonics(splats: Splats) -> bytes:
    """128x + 128, rounded to the buckets' middles."""
    rest = splats.shN.shape[1]
    codes = np.rint(splats.shN.astype(np.float64) * FLIPS[:rest, None] * 128 + 128)
    bucket = np.where(np.arange(rest) < 3, *_BUCKETS)[:, None]
    return _bytes(np.floor((codes + bucket // 2) / bucket) * bucket)
