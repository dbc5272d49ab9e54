"""Scenes streamed into tiles, for tests of ingestion."""

from pathlib import Path

import numpy as np

from g2ard.io import write_splats
from g2ard.io.tile_store import TileStore, packed
from g2ard.scene.splats import Splats


def town(
    count: int = 6000, degree: int = 0, seed: int = 0, offset: tuple[float, ...] = (0, 0, 0)
) -> Splats:
    """Streets of uneven density, and a few floaters far out."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * [30, 12, 2] + rng.choice([-40.0, 0, 55], (count, 1))
    means[: count // 200] *= 50
    rest = (degree + 1) ** 2 - 1
    return Splats.create(
        means,
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-3, 1, (count, 3))),
        logit_opacities=rng.normal(0, 3, count),
        sh0=rng.normal(size=(count, 1, 3)),
        shN=rng.normal(size=(count, rest, 3)),
        offset=offset,
    )


def saved(path: Path, splats: Splats) -> Path:
    write_splats(path, splats, overwrite=True)
    return path


def tiles_of(store: TileStore) -> list[np.ndarray]:
    return [packed(store.read(i)) for i in range(len(store.tiles))]


def halos_of(store: TileStore) -> list[np.ndarray]:
    return [packed(store.read_halo(i)) for i in range(len(store.tiles))]


def as_set(rows: np.ndarray) -> np.ndarray:
    """Return the rows in a canonical order."""
    return np.sort(np.ascontiguousarray(rows).view(f"V{4 * rows.shape[1]}").ravel())


def assert_same_sets(a: list[np.ndarray], b: list[np.ndarray]) -> None:
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        assert np.array_equal(as_set(one), as_set(other))
