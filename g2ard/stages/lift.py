"""Coloured points → a geometric prior of surface-aligned discs, without training.

A prior to distil *from*, with photos as targets; rendered as it is, it is flat (10 dB in the paper).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import Progress, counter, silent
from g2ard.scene.splats import SH_C0, Splats

_CORE = _core.defaults()["lift"]
"""The one place of these defaults, which are the paper's."""


@dataclass(frozen=True)
class LiftConfig:
    """The constants of `lift`, for those who keep them together: `lift(points, colors, **vars(config))`."""

    neighbors: int = _CORE["neighbors"]
    normal_ratio: float = _CORE["normal_ratio"]
    max_anisotropy: float = _CORE["max_anisotropy"]
    opacity: float = 0.5


def lift(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    neighbors: int = LiftConfig.neighbors,
    normal_ratio: float = LiftConfig.normal_ratio,
    max_anisotropy: float = LiftConfig.max_anisotropy,
    opacity: float = LiftConfig.opacity,
    progress: Progress = silent,
) -> Splats:
    """One flat disc for each coloured point (supplement, "Dense Prior Construction").

    The frame is a PCA of the point and its nearest others: two tangents, then the normal. With the
    neighbourhood's variances λ₁ ≥ λ₂ along the tangents, s₁ = 0.94·√λ₁, s₂ = max(0.94·√λ₂, s₁/max_anisotropy)
    and the normal scale s₃ = normal_ratio·√(s₁s₂), in the points' unit. A point whose
    neighbours all coincide takes the median size around it.

    Args:
        points: (N, 3), any unit and origin; float64 keeps map coordinates exact.
        colors: (N, 3) in [0, 1].
        neighbors: nearest others that PCA looks at (10 in the paper).
        normal_ratio: normal over tangential scale (0.1 in the paper).
        max_anisotropy: largest ratio of the tangential scales (4 in the paper: no needles).
        opacity: of every disc, in (0, 1) (0.5 in the paper).
        progress: told of points done.

    Returns:
        N discs of SH degree 0 in the order of the points; rows that are not finite are left out. Means are
        float32; far coordinates, which float32 cannot hold, are relative to `offset`, the median point.

    Raises:
        InputError: shapes that do not fit, no finite point, or a parameter out of its range.

    >>> grid = np.stack(np.meshgrid(range(8), range(8), [0]), -1).reshape(-1, 3)
    >>> discs = lift(grid + [5.4e6, 0, 0], np.full((64, 3), 0.5))
    >>> len(discs), float(discs.offset[0]), bool((discs.scales[:, 2] < discs.scales[:, 1]).all())
    (64, 5400003.0, True)
    """
    xyz = np.ascontiguousarray(points, np.float64)
    rgb = np.asarray(colors, np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError(f"expected shape (N, 3), got {xyz.shape}", parameter="points")
    if rgb.shape != xyz.shape:
        raise InputError(f"expected shape {xyz.shape}, got {rgb.shape}", parameter="colors")
    if not 0 < opacity < 1:
        raise InputError(f"expected a number between 0 and 1, got {opacity}", parameter="opacity")
    finite = np.isfinite(xyz).all(1) & np.isfinite(rgb).all(1)
    if not finite.any():
        raise InputError(f"none of {len(xyz)} is finite", parameter="points")
    if not finite.all():
        xyz, rgb = xyz[finite], rgb[finite]
    middle = _middle(xyz)
    centered = xyz - middle
    config = LiftConfig(neighbors, normal_ratio, max_anisotropy, opacity)
    quats, scales = _core.lift_points(centered, config, counter(progress, "lift"))
    n = len(centered)
    near = _fits_float32(xyz, scales)
    return Splats.create(
        (xyz if near else centered).astype(np.float32),
        quats=quats,
        scales=scales,
        logit_opacities=np.full(n, np.log(opacity / (1 - opacity))),
        sh0=((rgb - 0.5) / SH_C0)[:, None],
        offset=np.zeros(3) if near else middle,
    )


def _fits_float32(points: NDArray[np.float64], scales: NDArray[np.float32]) -> bool:
    """Whether float32 holds the coordinates as they are, to 1 % of a disc: other programs know no offset."""
    step = np.spacing(np.float32(np.abs(points).max()))
    return bool(step <= 0.01 * np.median(scales[:, 0]))


def _middle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The per-axis lower median: a value of the data, so moving the cloud moves it exactly."""
    rank = (len(points) - 1) // 2
    return np.partition(points, rank, axis=0)[rank]
