"""Reader for .ksplat of GaussianSplats3D: sections of rows at one of three compression levels, SH 0–3."""

from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float, Values
from g2ard.errors import InputError, damaged
from g2ard.io.sanitize import Raw, cleaned
from g2ard.io.types import Noted

_HEADER = 4096  # bytes of the file's header
_SECTION = np.dtype(
    [
        ("count", "<u4"),
        ("capacity", "<u4"),
        ("bucket_size", "<u4"),
        ("buckets", "<u4"),
        ("block", "<f4"),
        ("bucket_bytes", "<u2"),
        ("_0", "V2"),
        ("steps", "<u4"),
        ("_1", "V4"),
        ("full", "<u4"),
        ("partial", "<u4"),
        ("degree", "<u2"),
        ("_2", "V982"),
    ]
)
"""Header of a section."""

_SH_COUNTS = {
    0: 0,
    1: 9,
    2: 24,
    3: 45,
}
_BANDS = ((0, 9), (9, 24), (24, 45))  # first column of a band, and of the next
_SH_ORDER = np.concatenate(
    [np.arange(begin, end).reshape(3, -1).T.ravel() for begin, end in _BANDS]
)
"""Columns of harmonics, which are stored channel after channel per band, in the order of `Splats`."""

_SH_RANGE = (-1.5, 1.5)  # range of 8-bit harmonics if the header gives none
# half of the steps of a 16-bit position within its bucket, if a section gives none
_SCALE_RANGE = 32767

_KINDS = (
    ("<f4", "<f4", "<f4"),
    ("<u2", "<f2", "<f2"),
    ("<u2", "<f2", "u1"),
)
"""Types of positions, of scales and rotations, and of harmonics, by level of compression."""


def read(path: Path) -> Noted:
    """Read a scene. Version 0.1 is read, the only one published.

    A row holds its position, linear scales, rotation (wxyz), 8-bit RGBA and harmonics, channel after channel
    per band. Levels 1 and 2 store halves, and positions as 16-bit steps within a bucket's cube:
    x = (q − s)·b/2s + centre. Level 2 stores harmonics in 8 bits between the header's limits.
    """
    data = path.read_bytes()
    if len(data) < _HEADER:
        raise damaged("is cut off within its header")
    if data[0] != 0 or data[1] < 1:
        raise InputError(f"unsupported version {data[0]}.{data[1]}; expected 0.1")
    words = np.frombuffer(data, "<u4", 11)
    floats = np.frombuffer(data, "<f4", 11)
    level = int(words[5] & 0xFFFF)
    sections = int(words[1])
    if level not in (0, 1, 2):
        raise InputError(f"unsupported compression level {level}; expected 0, 1 or 2")
    limits = tuple(
        float(given) or usual for given, usual in zip(floats[9:11], _SH_RANGE, strict=True)
    )
    at = _HEADER + sections * _SECTION.itemsize
    if len(data) < at:
        raise damaged(f"is cut off within the headers of {sections} sections")
    parts = []
    for i in range(sections):
        raw, at = _rows(
            data,
            i,
            at,
            _section(data, i),
            level,
            limits,
        )
        parts.append(raw)
    rest = max((raw.shN.shape[1] for raw in parts), default=0)
    whole = Raw.empty(sum(len(raw.means) for raw in parts), rest)
    start = 0
    whole.shN[:] = 0
    for raw in parts:
        rows = slice(start, start + len(raw.means))
        whole.take(rows).fill(vars(raw).values())
        start = rows.stop
    return cleaned(whole)


def _section(data: bytes, i: int) -> dict[str, Any]:
    at = _HEADER + i * _SECTION.itemsize
    values = np.frombuffer(data, _SECTION, 1, at)[0].item()
    section = dict(zip(_SECTION.names or (), values, strict=True))
    if section["degree"] not in _SH_COUNTS:
        text = f"has the unsupported SH degree {section['degree']}; expected 0 to 3"
        raise InputError(text, index=i, item="section")
    return section


def _rows(
    data: bytes,
    i: int,
    at: int,
    section: dict[str, Any],
    level: int,
    limits: tuple[float, ...],
) -> tuple[Raw, int]:
    """Return the rows of section `i`, which begins at byte `at`, and the byte after it."""
    mean, real, sh = _KINDS[level]
    harmonics = _SH_COUNTS[section["degree"]]
    count = min(section["count"], section["capacity"])
    row = np.dtype(
        [
            ("mean", mean, 3),
            ("scale", real, 3),
            ("quat", real, 4),
            ("rgba", "u1", 4),
            ("sh", sh, (harmonics,)),
        ]
    )
    begin = at + 4 * section["partial"] + section["bucket_bytes"] * section["buckets"]
    end = begin + row.itemsize * section["capacity"]
    if end > len(data):
        raise damaged("is cut off", index=i, item="section")
    rows = np.frombuffer(data, row, count, begin)
    raw = Raw.empty(count, harmonics // 3)
    if level == 0:
        raw.means[:] = rows["mean"]
    else:
        raw.means[:] = _centres(data, i, at, section, rows["mean"])
    raw.set_linear(rows["scale"], rows["rgba"])
    raw.quats[:] = rows["quat"]
    values = rows["sh"].astype(float)
    if level == 2:
        values = values / 255 * (limits[1] - limits[0]) + limits[0]
    raw.shN[:] = values[:, _SH_ORDER[:harmonics]].reshape(raw.shN.shape)
    return raw, end


def _centres(
    data: bytes,
    i: int,
    at: int,
    section: dict[str, Any],
    steps: Values,
) -> Float:
    """Return positions from 16-bit steps: full buckets first, then partial ones of the listed lengths."""
    full = section["full"]
    partial = section["partial"]
    buckets = section["buckets"]
    size = section["bucket_bytes"]
    if size < 12 or full + partial != buckets:
        raise damaged("has inconsistent buckets", index=i, item="section")
    lengths = np.full(full + partial, section["bucket_size"], np.int64)
    lengths[full:] = np.frombuffer(data, "<u4", partial, at)
    if lengths.sum() < len(steps):
        raise damaged("has more rows than its buckets hold", index=i, item="section")
    table = np.frombuffer(data, "u1", buckets * size, at + 4 * partial).reshape(buckets, size)
    centres = np.ascontiguousarray(table[:, :12]).view("<f4").astype(float)
    count = len(steps)
    bucket = np.repeat(np.arange(buckets), np.minimum(lengths, count))[:count]
    half = section["steps"] or _SCALE_RANGE
    step = section["block"] / 2 / half
    return (steps.astype(float) - half) * step + centres[bucket]
