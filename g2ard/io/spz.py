"""Reader and writer for Niantic's .spz: 8-bit attributes, gzipped (versions 2, 3) or in Zstandard (4).

SPZ has right-up-back axes; a 3DGS .ply has right-down-forward. Therefore y and z change sign, as do the
quaternion's y and z and every harmonic odd in them. Version 4 may name other axes in an extension, a record
of type, length and content between header and table of streams.
"""

import json
import math
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import g2ard.io.packing as packing
from g2ard.arrays import Bytes, Float, Values
from g2ard.config.choices import Axes, RenderModel
from g2ard.errors import InputError, damaged, missing, require
from g2ard.io.atomic import atomic_output
from g2ard.io.jsonfile import Place as JsonPlace
from g2ard.io.jsonfile import Vector, checked, parse_json
from g2ard.io.paths import about, check_unpacked
from g2ard.io.sanitize import Raw, cleaned, logits_of
from g2ard.io.types import Note, Noted
from g2ard.progress import Progress, plural, silent, some
from g2ard.scene.splats import Splats
from g2ard.scene.transform import change_of_axes, harmonic_signs, moved_axes, restored, with_axes

_MAGIC = b"NGSP"
_HEADER = 16  # size of the header, bytes
_GZIP_BLOCK = 1 << 20  # bytes packed between two reports of progress, a fraction of a second
_POSITION_BITS = 24
_COEFFICIENTS = (0, 3, 8, 15, 24)
_ANTIALIASED = 0x1
_HAS_EXTENSIONS = 0x2
_COORDINATE_SYSTEM = 0xADBE0003
_OWN_PLACE = 0x67320001
"""Record of version 4 with `own_place` as JSON, which older versions have in their gzip header's comment."""

_COMMENTED = b"\x10"  # flag of a gzip header with a comment
_HEADER_4 = 32  # size of the header of version 4, bytes

_ADOBE_AXES: tuple[Axes, ...] = (
    "LDB",
    "RDB",
    "LUB",
    "RUB",
    "LDF",
    "RDF",
    "LUF",
    "RUF",
    "LBU",
    "RBU",
    "LFU",
    "RFU",
    "LBD",
    "RBD",
    "LFD",
    "RFD",
)
"""Axes of the extension SPZ_ADOBE_coordinate_system, from number 1 on, as @adobe/spz 0.2.3 stores and reads
them. Its header swaps the names of 9 and 15, and of 10 and 16.
"""

_COLOR_SCALE = 0.15  # SPZ's factor for band 0, which leaves room for colours outside [0, 1]

FLIPS = harmonic_signs((1, -1, -1))
"""Signs of harmonics, which differ between SPZ's axes and those of a .ply."""

_USUAL_BITS = 12  # fractional bits of positions, if they suffice
_MOST_BITS = 20  # most fractional bits of positions


def read(path: Path) -> Noted:
    """Read an .spz of version 2, 3 or 4; bands past degree 3 are ignored with a note."""
    return decoded(path, path.read_bytes())


def names_axes(path: Path) -> bool:
    """Return whether a file names its axes, as one of version 4 can, or a file of g2ard's of a map."""
    data = path.read_bytes()
    if b'"stored"' in _comment(data):
        return True
    if len(data) < _HEADER_4 or data[:5] != _MAGIC + b"\4":
        return False
    if not data[14] & _HAS_EXTENSIONS:
        return False
    with about(path):
        return _extensions(data)[0] != "RUB"


def decoded(path: Path, data: bytes) -> Noted:
    """Read the bytes of an .spz like `read`; `path` names their file in messages."""
    own = _comment(data)
    if data[:2] == b"\x1f\x8b":
        data = _gunzip(data)
    sizes = _sizes(data)
    version, count, degree, fraction_bits, flags, stream_count = struct.unpack_from(
        "<IIBBBB",
        data,
        4,
    )
    stored = _COEFFICIENTS[degree]
    if version == 4:
        streams = _zstd_streams(data, stream_count, sizes)
    else:
        streams = _slices(data, sizes)
    arrays = [np.frombuffer(stream, np.uint8) for stream in streams]
    positions, alphas, colors, scales, rotations, sh = arrays
    kept = min(stored, 15)
    raw = Raw.empty(count, kept)
    steps = _fixed24(positions.reshape(-1, 3)).reshape(-1, 3)
    raw.means[:] = steps / (1 << fraction_bits) * (1, -1, -1)
    raw.log_scales[:] = scales.reshape(-1, 3) / 16 - 10
    if version == 2:
        quats = _quats_xyz(rotations)
    else:
        quats = _quats_packed(rotations)
    raw.quats[:] = quats * (1, 1, -1, -1)
    raw.logit_opacities[:] = logits_of(alphas / 255)
    shades = colors.reshape(-1, 3) / 255
    raw.sh0[:, 0] = (shades - 0.5) / _COLOR_SCALE
    bands = sh.reshape(count, stored, 3)[:, :kept].astype(np.float32)
    raw.shN[:] = (bands - 128) / 128 * FLIPS[:kept, None]
    notes = []
    if stored > kept:
        notes.append(Note("ignored_bands", 1, "spherical harmonics past degree 3 ignored"))
    axes: Axes = "RUB"
    if flags & _HAS_EXTENSIONS:
        ignored = 1
        if version == 4:
            axes, own, ignored = _extensions(data)
        if ignored:
            notes.append(Note("ignored_extensions", ignored, "SPZ extensions ignored"))
    model: RenderModel = "classic"
    if flags & _ANTIALIASED:
        model = "antialiased"
    scene, all_notes = cleaned(raw, notes, model)
    if axes != "RUB":
        from_rub = change_of_axes("RDF", "RUB")  # so far taken for RUB
        scene = with_axes(scene, change_of_axes(axes, "RDF") @ from_rub)
    return _in_place(path, scene, own), all_notes


class _Own(msgspec.Struct):
    """Offset and axes of the scene, and the file's axes if they differ from the format's."""

    offset: Vector = (0.0, 0.0, 0.0)
    axes: Axes = "RDF"
    stored: Axes = "RUB"


class _Comment(msgspec.Struct):
    g2ard: _Own


def _in_place(path: Path, scene: Splats, own: bytes) -> Splats:
    """Return a scene with the offset and axes that g2ard stated in a comment or record, if it is one."""
    if b'"g2ard"' not in own:
        return scene
    content = parse_json(own.decode("latin-1"))
    place = checked(content, _Comment, JsonPlace(path)).g2ard
    if place.stored != "RUB":
        scene = with_axes(scene, change_of_axes(place.stored, "RUB"))
    offset = moved_axes(place.offset, place.axes, "RDF")
    return restored(replace(scene, offset=offset), place.axes)


def _comment(data: bytes) -> bytes:
    """Return the comment of a gzip header whose only optional part it is."""
    if data[:4] != b"\x1f\x8b\x08" + _COMMENTED:
        return b""
    return data[10 : data.find(b"\0", 10)]


def _extensions(data: bytes) -> tuple[Axes, bytes, int]:
    """Return the axes that the records of version 4 name, g2ard's own record, and the number of others."""
    axes = _ADOBE_AXES[3]
    own = b""
    others = 0
    at = _HEADER_4
    (end,) = struct.unpack_from("<I", data, 16)
    end = min(end, len(data))
    while at + 8 <= end:
        kind, size = struct.unpack_from("<II", data, at)
        begin = at + 8
        at = begin + size
        if at > end:
            raise damaged("truncated: an extension is cut off")
        if kind == _COORDINATE_SYSTEM and size == 4:
            (number,) = struct.unpack_from("<I", data, begin)
            if number > len(_ADOBE_AXES):
                raise InputError(f"unknown coordinate system {number}; expected 0 to 16")
            if number:
                axes = _ADOBE_AXES[number - 1]
        elif kind == _OWN_PLACE:
            own = data[begin:at]
        else:
            others += 1
    return axes, own, others


def _gunzip(data: bytes) -> bytes:
    """Unpack the header and as many bytes as it announces."""
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        head = stream.decompress(data, _HEADER)
        promised = sum(_sizes(head))
        check_unpacked(len(data), promised)
        body = b""
        if promised:
            body = stream.decompress(stream.unconsumed_tail, promised)
    except zlib.error as error:
        raise damaged(f"truncated or broken gzip stream ({error})") from error
    return head + body


def _sizes(head: bytes) -> list[int]:
    """Return the bytes of the unpacked positions, alphas, colours, scales, rotations and harmonics."""
    if head[:4] != _MAGIC:
        raise InputError(f"not an SPZ file (begins with {head[:4]!r})")
    if len(head) < _HEADER:
        raise damaged(f"truncated: {len(head)} of {_HEADER} bytes of the header")
    version, count, degree, fraction_bits = struct.unpack_from("<IIBB", head, 4)
    if version not in (2, 3, 4):
        raise InputError(f"unsupported SPZ version {version}; expected 2, 3 or 4")
    if degree >= len(_COEFFICIENTS):
        raise InputError(f"unsupported SH degree {degree}; expected 0 to 4")
    if fraction_bits > _POSITION_BITS:
        text = f"is {fraction_bits}, expected at most {_POSITION_BITS}"
        raise InputError(text, property="fractionalBits")
    rotation = 3 if version == 2 else 4
    return [count * size for size in (9, 1, 3, 3, rotation, 3 * _COEFFICIENTS[degree])]


def _slices(data: bytes, sizes: list[int]) -> list[bytes]:
    ends = _HEADER + np.cumsum(sizes)
    if len(data) < ends[-1]:
        raise damaged(f"truncated: {len(data):,} of {ends[-1]:,} bytes")
    return [data[end - size : end] for end, size in zip(ends, sizes, strict=True)]


def _zstd_streams(data: bytes, stream_count: int, sizes: list[int]) -> list[bytes]:
    """Unpack the streams of version 4: a table of (packed, unpacked) sizes, then a frame per stream."""
    check_unpacked(len(data), sum(sizes))
    try:
        (table,) = struct.unpack_from("<I", data, 16)
        entries = [struct.unpack_from("<QQ", data, table + 16 * i) for i in range(stream_count)]
    except struct.error as error:
        raise damaged("truncated: the table of streams is cut off") from error
    streams = []
    start = table + 16 * stream_count
    entries += [(0, 0)] * len(sizes)
    for i, size in enumerate(sizes):
        packed, unpacked = entries[i]
        if start + packed > len(data):
            raise damaged(f"truncated in stream {i}")
        stream = b""
        if size == unpacked > 0:
            stream = _unpacked(data[start : start + packed], size)
        if unpacked != size or len(stream) != size:
            raise damaged(f"stream {i} does not hold {size:,} bytes")
        streams.append(stream)
        start += packed
    return streams


def _zstandard() -> Any:
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError as error:
        raise missing("SPZ version 4", "backports.zstd") from error
    return zstd


def _unpacked(frame: bytes, size: int) -> bytes:
    """Unpack a frame of Zstandard, at most one byte past its expected size."""
    zstd = _zstandard()
    try:
        return bytes(zstd.ZstdDecompressor().decompress(frame, max_length=size + 1))
    except zstd.ZstdError as error:
        raise damaged(f"broken Zstandard stream ({error})") from error


def _fixed24(triples: Bytes) -> Values:
    """Decode signed 24-bit little-endian integers."""
    wide = np.zeros((len(triples), 4), np.uint8)
    wide[:, 1:] = triples
    return wide.view("<i4")[:, 0] >> 8


def _quats_xyz(codes: Bytes) -> Float:
    """Decode quaternions of version 2: x y z as bytes in [−1, 1], with w ≥ 0."""
    xyz = codes.reshape(-1, 3) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1)))
    return np.concatenate([w[:, None], xyz], axis=1)


def _quats_packed(codes: Bytes) -> Float:
    """Decode quaternions of versions 3 and 4: 2 bits for the largest of x y z w, and 9 bits of |q|·√2 plus a
    sign for the others."""
    packed = codes.view("<u4")
    parts = packed[:, None] >> np.array([20, 10, 0], np.uint32)
    magnitudes = (parts & np.uint32(511)) / (511 * np.sqrt(2))
    others = np.where(parts & np.uint32(512), -magnitudes, magnitudes)
    largest = packed >> np.uint32(30)
    quats = packing.from_smallest_three(largest, others)
    return quats[:, [3, 0, 1, 2]]


def write(
    path: Path,
    splats: Splats,
    *,
    overwrite: bool = False,
    spz_version: int = 3,
    axes: Axes = "RUB",
    progress: Progress = silent,
) -> float:
    """Write an .spz; equal scenes give equal bytes.

    Scales are clamped to e^−10 … e^5.94, harmonics to ±1, colours to slightly more than [0, 1].
    Version 3 uses gzip, 4 Zstandard (smaller files), 2 gzip with coarser rotations. Version 4 can store other
    `axes`, which it names; readers that ignore extensions show such a scene turned or mirrored. Versions 2
    and 3 store right-up-back, or with RDF the coordinates of a .ply, against the definition and unnamed, as
    splat-transform and SuperSplat read every .spz. Return the largest change of a position by rounding.
    """
    require("spz_version", spz_version, spz_version in (2, 3, 4), "2, 3 or 4")
    if axes not in ("RUB", "RDF") and spz_version != 4:
        raise InputError(
            f"version {spz_version} has RUB axes, or RDF for programs that expect those of a .ply",
            hint="{spz_version=4} can name others",
        )
    error = 0.0
    if len(splats):
        error = packing.rounding(splats, splats.narrowed())
    splats = packing.as_packed(splats)
    own = packing.own_place(splats)
    bits = fraction_bits(splats.means.astype(float), splats)
    splats = replace(splats, offset=np.zeros(3))
    if axes != "RUB":
        turn = change_of_axes("RUB", "RDF") @ change_of_axes("RDF", axes)
        splats = with_axes(splats, turn)
    splats = splats.take(packing.packing_order(splats.means))
    means = splats.means.astype(float)
    named: Axes = "RUB"
    if spz_version == 4:
        named = axes
    if own and axes != named:
        own["stored"] = axes
    comment = b""
    if own:
        comment = json.dumps({"g2ard": own}, separators=(",", ":")).encode()
    content = encoded(splats, means, bits, spz_version, named, progress, comment)
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(content)
    return error + rounding(means, bits)


def rounding(means: Values, bits: int) -> float:
    """Return the largest change of a coordinate in `bits` fractional bits."""
    steps = 1 << bits
    scaled = np.asarray(means, float) * steps
    return float(np.abs(np.rint(scaled) - scaled).max()) / steps


def encoded(
    splats: Splats,
    means: Float,
    bits: int,
    spz_version: int,
    axes: Axes = "RUB",
    progress: Progress = silent,
    comment: bytes = b"",
) -> bytes:
    """Return the bytes of an .spz with these means, in `bits` fractional bits and the order of the rows.

    The `comment`, text, is in the gzip header, or in version 4 a record that other readers skip.
    """
    streams = _streams(splats, means, bits, spz_version)
    flags = _ANTIALIASED if splats.antialiased else 0
    records = b""
    if axes != "RUB":
        flags |= _HAS_EXTENSIONS
        number = _ADOBE_AXES.index(axes) + 1
        records = struct.pack("<III", _COORDINATE_SYSTEM, 4, number)
    if comment and spz_version == 4:
        comment += b" " * (-len(comment) % 4)
        flags |= _HAS_EXTENSIONS
        records += struct.pack("<II", _OWN_PLACE, len(comment)) + comment
    head = _MAGIC + struct.pack(
        "<IIBBB",
        spz_version,
        len(splats),
        splats.sh_degree,
        bits,
        flags,
    )
    if spz_version < 4:
        return _gzipped(head + b"\0" + b"".join(streams), progress, comment)
    zstd = _zstandard()
    packed = []
    for number, stream in enumerate(streams):
        progress("pack", number, len(streams))
        packed.append(zstd.compress(stream, 19))
    progress("pack", len(streams), len(streams))
    table = b""
    for frame, stream in zip(packed, streams, strict=True):
        table += struct.pack("<QQ", len(frame), len(stream))
    start = struct.pack("<BI12x", len(streams), _HEADER_4 + len(records))
    return head + start + records + table + b"".join(packed)


def _gzipped(content: bytes, progress: Progress, comment: bytes) -> bytes:
    """Return what `gzip.compress(content, 9, mtime=0)` does, with a comment in the header."""
    packer = zlib.compressobj(9, wbits=31)
    parts = []
    for start in range(0, len(content), _GZIP_BLOCK):
        progress("pack", start, len(content))
        parts.append(packer.compress(content[start : start + _GZIP_BLOCK]))
    progress("pack", len(content), len(content))
    parts.append(packer.flush())
    packed = b"".join(parts)
    if not comment:
        return packed
    head = packed[:3] + _COMMENTED + packed[4:10]
    return head + comment + b"\0" + packed[10:]


def check_far(
    splats: Splats,
    means: Float,
    widened: float = 1.0,
    movable: bool = False,
) -> None:
    """Raise the error of `fraction_bits` for a scene whose Gaussians will be `widened` times as large."""
    scales = splats.scales * np.float32(widened)
    fraction_bits(means, replace(splats, scales=scales), movable=movable)


def fraction_bits(means: Float, splats: Splats, *, movable: bool = False) -> int:
    """Return the fractional bits of 24-bit coordinates.

    Usually 12. More, as far as the extent allows, if a step of 2^−12 exceeds a quarter of the 1st percentile
    of the Gaussians' middle scales. The error if steps exceed both 2^−12 and the median middle scale names
    the Gaussians to blame, if they are few, and the box of the others.

    Args:
        movable: whether the origin of the coordinates follows from them, so that far is far from the median.
    """
    reach = np.abs(means).max(axis=1)
    farthest = float(reach.max())
    # 23 bits beside the sign; the margin keeps what is just below a power of two from rounding up to 2^23
    margin = 1 + 2**-20
    room = 23 - math.ceil(math.log2(max(farthest, 2.0**-20) * margin))
    middle = np.sort(splats.scales, axis=1)[:, 1].astype(float)
    fine_scale = max(float(np.percentile(middle, 1)), 1e-12)
    bits_for_fine_scale = math.ceil(-math.log2(fine_scale / 4))
    bits = min(max(_USUAL_BITS, bits_for_fine_scale), _MOST_BITS, room)
    coarsest = max(float(np.median(middle)), 2.0**-_USUAL_BITS)
    if bits >= 0 and 2.0**-bits <= coarsest:
        return bits
    away = reach
    if movable:
        away = np.abs(means - np.median(means, axis=0)).max(axis=1)
    least_bits = max(0, math.ceil(-math.log2(coarsest)))
    far = np.flatnonzero(away * margin > 2.0 ** (23 - least_bits))
    steps = f"(steps of {2.0**-bits:g})"
    text = f".spz is too coarse at {farthest:g} from the origin {steps}"
    if 2 * len(far) > len(means):
        raise InputError(text, hint="write another format")
    near = np.delete(splats.means, far, axis=0).astype(float) + splats.offset
    ends = [*np.floor(near.min(axis=0)), *np.ceil(near.max(axis=0))]
    box = ",".join(f"{end:.0f}" for end in ends)
    gaussians = f"{plural(len(far), 'Gaussian')} of {len(means):,}"
    rows = some(far.tolist())
    raise InputError(
        f"{text}, where {gaussians} lie (row {rows})",
        hint=f"crop the scene with `g2ard convert --box={box}`, or write another format",
    )


def _streams(
    splats: Splats,
    means: Float,
    bits: int,
    version: int,
) -> list[bytes]:
    steps = means * (1, -1, -1) * (1 << bits)
    fixed = np.rint(steps).astype("<i4")
    quats = packing.unit_quats(splats.quats) * (1, 1, -1, -1)
    if version == 2:
        signs = np.where(quats[:, :1] < 0, -1, 1)  # w ≥ 0
        rotations = _bytes(quats[:, 1:] * signs * 127.5 + 127.5)
    else:
        rotations = _packed(quats)
    shades = splats.sh0[:, 0].astype(float) * _COLOR_SCALE + 0.5
    streams = [
        fixed.reshape(-1, 1).view(np.uint8)[:, :3].tobytes(),
        _bytes(splats.opacities.astype(float) * 255),
        _bytes(shades * 255),
        _bytes((packing.log_scales(splats) + 10) * 16),
        rotations,
    ]
    if splats.sh_degree:  # in all 8 bits: rounding to fewer is where other writers lose most
        flips = FLIPS[: splats.shN.shape[1], None]
        streams.append(_bytes(splats.shN.astype(float) * flips * 128 + 128))
    return streams


def _bytes(values: Values) -> bytes:
    return packing.as_bytes(values).tobytes()


def _packed(quats: Float) -> bytes:
    largest, others = packing.smallest_three(quats[:, [1, 2, 3, 0]])
    words = largest.astype(np.uint32)
    for values in others.T:
        negative = (values < 0).astype(np.uint32)
        magnitude = packing.coded(np.abs(values) * math.sqrt(2), 511)
        part = negative << 9 | magnitude.astype(np.uint32)
        words = (words << np.uint32(10) | part).astype(np.uint32)
    return words.astype("<u4").tobytes()
