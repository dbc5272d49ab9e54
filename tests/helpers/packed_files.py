"""Small scenes in packed formats."""

import gzip
from pathlib import Path

import numpy as np

from g2ard.io import write_splats
from g2ard.scene.splats import Splats


def rotations(count: int, seed: int) -> np.ndarray:
    """(N, 4) unit wxyz, each component largest in turn and positive there."""
    q = np.random.default_rng(seed).uniform(-1, 1, (count, 4))
    q[np.arange(count), np.arange(count) % 4] = 1.5
    return q / np.linalg.norm(q, axis=1, keepdims=True)


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
