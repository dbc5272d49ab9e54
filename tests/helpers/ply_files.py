"""Standard 3DGS .ply files, written column by column."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from g2ard.scene.splats import Splats


def scene(
    count: int = 20, degree: int = 3, seed: int = 0, offset: tuple[float, ...] = (0, 0, 0)
) -> Splats:
    rng = np.random.default_rng(seed)
    rest = (degree + 1) ** 2 - 1
    means, quats = rng.normal(size=(count, 3)), rng.normal(size=(count, 4))
    return Splats.create(
        means,
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-3, 1, (count, 3))),
        logit_opacities=rng.normal(0, 3, count),
        sh0=rng.normal(size=(count, 1, 3)),
        shN=rng.normal(size=(count, rest, 3)),
        offset=offset,
    )


def columns(splats: Splats) -> dict[str, np.ndarray]:
    """The properties of a 3DGS .ply, written out longhand."""
    out = {name: splats.means[:, i] for i, name in enumerate("xyz")}
    out |= {f"f_dc_{c}": splats.sh0[:, 0, c] for c in range(3)}
    rest = splats.shN.shape[1]
    out |= {f"f_rest_{c * rest + k}": splats.shN[:, k, c] for c in range(3) for k in range(rest)}
    out |= {"opacity": splats.logit_opacities}
    out |= {f"scale_{i}": np.log(splats.scales[:, i]) for i in range(3)}
    out |= {f"rot_{i}": splats.quats[:, i] for i in range(4)}
    return out


def save(
    path: Path, properties: dict[str, np.ndarray], dtype: str = "f4", **options: object
) -> Path:
    rows = np.empty(len(next(iter(properties.values()))), [(name, dtype) for name in properties])
    for name, values in properties.items():
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")], **options).write(str(path))
    return path
