"""LightGaussian's pruning (arXiv 2311.17245) by contribution to the training views and volume.

Its fine-tuning (5,000 Adam steps at the rates of 3DGS) counts as recovery. SH distillation and quantisation
are not included.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.ranking import keep_best
from g2ard.progress import Progress, silent
from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

__all__ = ["global_significance", "lightgaussian"]

_VOLUME_POWER = 0.1
_VOLUME_RANK = 0.9


def global_significance(
    splats: Splats,
    cameras: Cameras,
    *,
    kernel: Literal["transmittance", "hits"] = "transmittance",
    progress: Progress = silent,
) -> NDArray[np.float64]:
    """Return (N,) scores I_j·(V_j / V*)^0.1.

    I_j = Σ σ_j·T over the pixels of all views that j touches (α = min(0.99, σG) ≥ 1/255, before the pixel
    stops), or Σ σ_j with `kernel="hits"`, as in an older release. V is the product of the scales and V* the
    one at rank ⌊0.9 N⌋ from the largest.
    """
    seen = visibility(splats, cameras, progress)
    touched = seen.transmittance if kernel == "transmittance" else seen.hits.astype(np.float64)
    volume = splats.scales.astype(np.float64).prod(1)
    typical = np.sort(volume)[::-1][int(_VOLUME_RANK * len(volume))]
    relative = volume / max(typical, np.finfo(np.float64).tiny)
    return splats.opacities.astype(np.float64) * touched * relative**_VOLUME_POWER


def lightgaussian(
    splats: Splats,
    budget: int,
    cameras: Cameras,
    *,
    kernel: Literal["transmittance", "hits"] = "transmittance",
    progress: Progress = silent,
) -> Splats:
    """Keep the `budget` Gaussians of highest `global_significance`."""
    return keep_best(splats, global_significance(splats, cameras, kernel=kernel, progress=progress), budget)
