"""SOG folders, built image by image."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


def webp(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def square(rows: np.ndarray, side: int = 4) -> np.ndarray:
    """(N, ≤4) bytes as a side×side RGBA image, padded."""
    out = np.full((side * side, 4), 255)
    out[: len(rows), : rows.shape[1]] = rows
    return out.reshape(side, side, 4)


def parts(count: int = 10, bands: int = 1, seed: int = 0, version: int = 2) -> dict[str, bytes]:
    """The files of a small scene, random codes."""
    rng = np.random.default_rng(seed)
    codes = {
        name: rng.integers(0, 256, (count, 4)) for name in ("low", "high", "scales", "quats", "sh0")
    }
    codes["quats"][:, 3] = 252 + np.arange(count) % 4
    codes["sh0"][:, 3] = np.clip(codes["sh0"][:, 3], 1, 254)
    files = {f"{name}.webp": webp(square(rows)) for name, rows in codes.items()}
    meta: dict[str, Any] = {
        "means": {"mins": [-2.0, -1, 0], "maxs": [2.0, 1, 3], "files": ["low.webp", "high.webp"]},
        "scales": {"files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"files": ["sh0.webp"]},
    }
    rest = {0: 0, 1: 3, 2: 8, 3: 15}[bands]
    if rest:
        files["shN_centroids.webp"] = webp(rng.integers(0, 256, (2, 64 * rest, 3)))
        labels = rng.integers(0, 128, count)
        files["shN_labels.webp"] = webp(square(np.stack([labels & 255, labels >> 8], axis=1)))
        meta["shN"] = {"files": ["shN_centroids.webp", "shN_labels.webp"]}
    if version == 2:
        meta |= {"version": 2, "count": count}
        meta["scales"]["codebook"] = np.linspace(-9, -1, 256).tolist()
        meta["sh0"]["codebook"] = np.linspace(-3, 3, 256).tolist()
        if rest:
            meta["shN"] |= {
                "codebook": np.linspace(-1, 1, 256).tolist(),
                "bands": bands,
                "count": 128,
            }
    else:
        meta["means"]["shape"] = [count, 3]
        meta["scales"] |= {"mins": [-9.0, -8, -7], "maxs": [-1.0, -2, -3]}
        meta["sh0"] |= {"mins": [-3.0, -2, -1, -5], "maxs": [3.0, 2, 1, 5]}
        if rest:
            meta["shN"] |= {"mins": -1.0, "maxs": 1.0}
    return files | {"meta.json": json.dumps(meta).encode()}


def folder(path: Path, files: dict[str, bytes]) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (path / name).write_bytes(content)
    return path


def zipped(path: Path, files: dict[str, bytes], prefix: str = "") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(prefix + name, content)
    return path
