"""Compressed .ply and .spz files, packed by plain loops."""

import gzip
import importlib
import math
import struct
import sys
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from g2ard.io import write_splats
from g2ard.scene.splats import Splats


def rotations(count: int, seed: int) -> np.ndarray:
    """(N, 4) unit wxyz, each component largest in turn and positive there."""
    q = np.random.default_rng(seed).uniform(-1, 1, (count, 4))
    q[np.arange(count), np.arange(count) % 4] = 1.5
    return q / np.linalg.norm(q, axis=1, keepdims=True)


# ── .compressed.ply ──────────────────────────────────────────────────────────────────────────────────


def pack(values: list[float], bits: list[int]) -> int:
    word = 0
    for value, width in zip(values, bits, strict=True):
        word = (word << width) | round(value * ((1 << width) - 1))
    return word


def compressed(path: Path, truth: Splats, *, chunk_colors: bool = True, chunk_size: int = 256) -> Path:
    """Pack a scene as SuperSplat does."""
    count, logs, colors = len(truth), np.log(truth.scales.astype(float)), truth.colors.astype(float)
    axes = {"": truth.means.astype(float), "_scale": logs, "_color": colors}
    chunks, words = [], []
    for start in range(0, count, chunk_size):
        rows = range(start, min(start + chunk_size, count))
        bounds = {key: (v[rows].min(0), v[rows].max(0)) for key, v in axes.items()}
        if not chunk_colors:
            bounds["_color"] = (np.zeros(3), np.ones(3))
        chunks.append(tuple(np.concatenate([np.concatenate(b) for b in bounds.values()])))
        for i in rows:
            t = {k: (axes[k][i] - lo) / np.maximum(hi - lo, 1e-12) for k, (lo, hi) in bounds.items()}
            q = truth.quats[i].astype(float)
            largest = int(np.argmax(np.abs(q)))
            small = [q[k] / math.sqrt(2) + 0.5 for k in range(4) if k != largest]
            words.append(
                (
                    pack(list(t[""]), [11, 10, 11]),
                    (largest << 30) | pack(small, [10, 10, 10]),
                    pack(list(t["_scale"]), [11, 10, 11]),
                    pack([*t["_color"], float(truth.opacities[i])], [8, 8, 8, 8]),
                )
            )
    names = [f"{end}{what}_{a}" for what in ("", "_scale") for end in ("min", "max") for a in "xyz"]
    names += [f"{end}_{a}" for end in ("min", "max") for a in "rgb"]
    chunk = np.array(chunks, [(n, "f4") for n in names])
    if not chunk_colors:
        chunk = chunk[names[:12]].astype([(n, "f4") for n in names[:12]])
    packed = [f"packed_{n}" for n in ("position", "rotation", "scale", "color")]
    vertex = np.array(words, [(n, "u4") for n in packed])
    elements = [PlyElement.describe(chunk, "chunk"), PlyElement.describe(vertex, "vertex")]
    rest = truth.shN.shape[1]
    if rest:
        sh = np.zeros(count, [(f"f_rest_{k}", "u1") for k in range(3 * rest)])
        for k in range(3 * rest):
            value = truth.shN[:, k % rest, k // rest].astype(float)
            sh[f"f_rest_{k}"] = np.clip(np.floor((value / 8 + 0.5) * 256), 0, 255)
        elements.append(PlyElement.describe(sh, "sh"))
    PlyData(elements, byte_order="<").write(str(path))
    return path


def truth(count: int, degree: int, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats.create(
        rng.uniform(-2, 2, (count, 3)).astype(np.float32),
        quats=rotations(count, seed),
        scales=np.exp(rng.uniform(-8, -2, (count, 3))),
        logit_opacities=rng.uniform(-4, 4, count),
        sh0=rng.uniform(-1.2, 1.2, (count, 1, 3)),
        shN=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2 - 1, 3)),
    )


# ── .spz ─────────────────────────────────────────────────────────────────────────────────────────────


def spz_streams(scene: Splats, version: int, fraction_bits: int = 12) -> list[bytes]:
    """The attributes as SPZ stores them: right-up-back, so y and z and what is odd in them change sign."""
    byte = lambda v: np.clip(np.rint(v), 0, 255).astype(np.uint8).tobytes()  # noqa: E731
    positions, quats = b"", b""
    for mean in scene.means.astype(float) * (1, -1, -1):
        for value in mean:
            positions += struct.pack("<i", round(value * (1 << fraction_bits)))[:3]
    for w, x, y, z in scene.quats.astype(float) * (1, 1, -1, -1):
        if version == 2:
            sign = -1 if w < 0 else 1
            quats += byte(np.array([x, y, z]) * sign * 127.5 + 127.5)
            continue
        xyzw = np.array([x, y, z, w])
        largest = int(np.argmax(np.abs(xyzw)))
        word = largest
        for i in range(4):
            if i != largest:
                value = xyzw[i] * np.sign(xyzw[largest])
                word = word << 10 | (value < 0) << 9 | round(abs(value) * math.sqrt(2) * 511)
        quats += struct.pack("<I", int(word))
    odd = np.array([parity(band, m) for band in (1, 2, 3) for m in range(-band, band + 1)])
    rest = scene.shN.astype(float) * odd[: scene.shN.shape[1], None]
    return [
        positions,
        byte(scene.opacities * 255),
        byte((scene.sh0[:, 0] * 0.15 + 0.5) * 255),
        byte((np.log(scene.scales) + 10) * 16),
        quats,
        byte(rest * 128 + 128),
    ]


def parity(degree: int, order: int) -> int:
    """Sign that a real harmonic takes when y and z change sign, a half turn about x.

    y → −y alone turns sin(mφ) into its negative; z → −z alone multiplies by (−1)^(l+|m|).
    """
    return (-1 if order < 0 else 1) * (-1) ** (degree + abs(order))


def save_spz(path: Path, scene: Splats, version: int, magic: bytes = b"NGSP") -> Path:
    streams = spz_streams(scene, version)
    streams = streams if scene.sh_degree else streams[:5]
    head = magic + struct.pack("<IIBBB", version, len(scene), scene.sh_degree, 12, 0)
    if version < 4:
        path.write_bytes(gzip.compress(head + b"\0" + b"".join(streams)))
        return path
    zstd = importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    packed = [zstd.compress(s) for s in streams]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    gap = b"extension"  # the header says where the table begins
    head += bytes([len(streams)]) + struct.pack("<I12x", 32 + len(gap))
    path.write_bytes(head + gap + table + b"".join(packed))
    return path


def saved(folder: Path, name: str, scene: Splats, **options: object) -> Path:
    """Write a scene as a.NAME, or as NAME if that has a folder."""
    path = folder / (name if "/" in name else f"a.{name}")
    write_splats(path, scene, **options)
    return path


# ── .ksplat ──────────────────────────────────────────────────────────────────────────────────────────


def unpacked_ksplat(name: str, folder: Path) -> Path:
    """Unpack a file of `tests/io/ksplat`, which GaussianSplats3D wrote."""
    packed = Path(__file__).parents[1] / "io" / "ksplat" / f"{name}.ksplat.gz"
    path = folder / f"{name}.ksplat"
    path.write_bytes(gzip.decompress(packed.read_bytes()))
    return path
