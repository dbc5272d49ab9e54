"""Scenes for levels of detail, and the files written for them."""

from hashlib import sha256
from pathlib import Path

import numpy as np

from g2ard.levels import Node
from g2ard.scene.splats import Splats


def scattered(count: int, seed: int = 0, offset: float = 0.0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats.create(
        rng.normal(size=(count, 3)) * (4, 2, 1),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.02, 0.2, size=(count, 3)),
        logit_opacities=rng.normal(size=count),
        offset=np.full(3, offset),
    )


def leaves_of(tree: Node) -> list[Node]:
    return list(tree.leaves())


def files_of(folder: Path) -> dict[str, str]:
    """Return the digest of each file by its path in the folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(p.relative_to(folder)): sha256(p.read_bytes()).hexdigest() for p in files}
