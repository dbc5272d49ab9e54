"""Size of each Gaussian in a view, and the resulting reduction of its rates."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from g2ard.scene.cameras import Cameras


@torch.no_grad()
def extents(
    means: Tensor, quats: Tensor, log_scales: Tensor, cameras: Cameras, view: int, near: float
) -> tuple[Tensor, Tensor]:
    """Return squared sizes on the screen before dilation, px²; 0 behind the near plane.

    Σ₂ = MMᵀ with M = J·W·R·S, and J clamped like in the rasteriser. Means are in the coordinates of
    `cameras`; quaternions may have any length.

    Returns:
        (N,) the larger eigenvalue of Σ₂, and (N, 3) the squared lengths of M's columns, one per axis.
    """
    pose = torch.from_numpy(cameras.viewmats[view]).to(means)
    K = cameras.Ks[view]
    focal = torch.tensor([K[0, 0], K[1, 1]]).to(means)
    size = np.array([cameras.widths[view], cameras.heights[view]])
    centre, margin = K[:2, 2], 0.15 * size  # as in the rasteriser: 1.3 half-fields of view
    low, high = (
        torch.from_numpy(edge / K.diagonal()[:2]).to(means)
        for edge in (-centre - margin, size - centre + margin)
    )
    camera = means @ pose[:3, :3].T + pose[:3, 3]
    seen = camera[:, 2] >= near
    depth = torch.where(seen, camera[:, 2], 1.0)[:, None]
    ray = (camera[:, :2] / depth).clamp(low, high)
    to_screen = focal[:, None] * (pose[:2, :3] - ray[..., None] * pose[2, :3]) / depth[..., None]
    axes = to_screen @ rotations(quats) * log_scales.exp()[:, None]  # (N, 2, 3)
    x, y = axes.unbind(1)
    xx, xy, yy = (x * x).sum(1), (x * y).sum(1), (y * y).sum(1)
    largest = 0.5 * (xx + yy) + ((0.5 * (xx - yy)) ** 2 + xy**2).sqrt()
    return largest * seen, (axes**2).sum(1) * seen[:, None]


def share_of_rate(variance: Tensor, reach: float, finest: float = 0.0) -> Tensor:
    """Return σ²/(σ² + finest²) · 1/(1 + (σ/reach)¹⁶) for the variance σ², all in pixels."""
    ratio = (variance * (1 / reach) * (1 / reach)).clamp(max=100.0)
    seen = variance / (variance + finest**2) if finest else 1.0
    return seen / (1 + ratio**8)


def rotations(quats: Tensor) -> Tensor:
    """Return (N, 3, 3) matrices of (N, 4) wxyz quaternions of any length, differentiably."""
    w, x, y, z = normalize(quats, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)
