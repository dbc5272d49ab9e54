"""Lift coloured points to a geometric prior of surface-aligned discs, without training.

Distil *from* this prior, with photos as targets; rendered as it is, it looks flat (10 dB in the paper).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard import _core
from g2ard.config.checks import Within, checks_arguments
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.progress import Progress, counter, silent
from g2ard.scene.splats import SH_C0, Splats, unit_colors

_CORE = _core.defaults()["lift"]
"""Defaults of the Rust core, which are the paper's."""


@dataclass(frozen=True)
class LiftConfig(Settings):
    """Constants of `lift`, for callers that keep them together: `lift(points, colors, **vars(config))`."""

    neighbors: Annotated[int, Within("[3, inf)")] = _CORE["neighbors"]
    spread: float = _CORE["spread"]
    normal_ratio: float = _CORE["normal_ratio"]
    max_anisotropy: float = _CORE["max_anisotropy"]
    opacity: float = 0.5


@checks_arguments
def lift(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    neighbors: int = LiftConfig.neighbors,
    spread: float = LiftConfig.spread,
    normal_ratio: float = LiftConfig.normal_ratio,
    max_anisotropy: float = LiftConfig.max_anisotropy,
    opacity: float = LiftConfig.opacity,
    progress: Progress = silent,
) -> Splats:
    """Turn each coloured point into a flat disc (supplement, "Dense Prior Construction").

    A PCA of the point and its nearest neighbours gives two tangents and the normal. With the
    neighbourhood's variances λ₁ ≥ λ₂ along the tangents, s₁ = spread·√λ₁,
    s₂ = max(spread·√λ₂, s₁/max_anisotropy) and the normal scale s₃ = normal_ratio·√(s₁s₂), in the points'
    unit. If all neighbours coincide, the disc gets the median size around it.

    Args:
        points: (N, 3), any unit and origin; pass float64 to keep map coordinates exact.
        colors: (N, 3) in [0, 1], or uint8 or uint16, which are divided by their largest value.
        neighbors: number of neighbours for the PCA (10 in the paper).
        spread: tangential scale over the neighbourhood's standard deviation (not stated in the paper).
        normal_ratio: normal over tangential scale (0.1 in the paper).
        max_anisotropy: largest ratio of the tangential scales (4 in the paper, to avoid needles).
        opacity: opacity of every disc, in (0, 1) (0.5 in the paper).
        progress: called with the number of points done.

    Returns:
        N discs of SH degree 0 in the order of the points; points that are not finite are skipped. Means are
        float32, relative to `offset`, which is the median point if float32 cannot hold the coordinates and 0
        otherwise.

    Raises:
        InputError: mismatched shapes, no finite point, a colour outside [0, 1], or a parameter out of range.

    >>> grid = np.stack(np.meshgrid(range(8), range(8), [0]), -1).reshape(-1, 3)
    >>> discs = lift(grid + [5.4e6, 0, 0], np.full((64, 3), 0.5))
    >>> len(discs), float(discs.offset[0]), bool((discs.scales[:, 2] < discs.scales[:, 1]).all())
    (64, 5400003.0, True)
    """
    xyz = np.ascontiguousarray(points, np.float64)
    rgb = unit_colors(colors)
    require("points", xyz.shape, xyz.ndim == 2 and xyz.shape[1] == 3, "shape (N, 3)")
    require("colors", rgb.shape, rgb.shape == xyz.shape, f"shape {xyz.shape}")
    require("opacity", opacity, 0 < opacity < 1, "a number between 0 and 1")
    finite = np.isfinite(xyz).all(1) & np.isfinite(rgb).all(1)
    if not finite.any():
        raise InputError(f"none of the {len(xyz)} points is finite", parameter="points")
    if not finite.all():
        xyz, rgb = xyz[finite], rgb[finite]
    middle = _middle(xyz)
    centered = xyz - middle
    config = LiftConfig(neighbors, spread, normal_ratio, max_anisotropy, opacity)
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
    """Return whether float32 holds the coordinates to 1 % of a disc; other programs ignore offsets."""
    step = np.spacing(np.float32(np.abs(points).max()))
    return bool(step <= 0.01 * np.median(scales[:, 0]))


def _middle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lower median per axis: it is an input value, so shifting the points shifts it exactly."""
    rank = (len(points) - 1) // 2
    return np.partition(points, rank, axis=0)[rank]
