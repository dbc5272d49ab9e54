"""Losses of recovery in torch: photometric, L_shape and L_anchor (`eq:shape`, `eq:anchor`); rates by size."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

import g2ard._core as _core
from g2ard.errors import require
from g2ard.scene.cameras import Cameras
from g2ard.stages.recover.anchors import Anchors, Regularizers


@torch.no_grad()
def measure_extents(
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
    focals = K.diagonal()[:2]
    centre = K[:2, 2]
    size = np.array([cameras.widths[view], cameras.heights[view]])
    margin = 0.15 * size  # as in the rasteriser: 1.3 half-fields of view
    low = torch.from_numpy((-centre - margin) / focals).to(means)
    high = torch.from_numpy((size - centre + margin) / focals).to(means)
    focal = torch.from_numpy(focals.copy()).to(means)
    camera = means @ pose[:3, :3].T + pose[:3, 3]
    seen = camera[:, 2] >= near
    depth = torch.where(seen, camera[:, 2], 1.0)[:, None]
    ray = (camera[:, :2] / depth).clamp(low, high)
    to_screen = focal[:, None] * (pose[:2, :3] - ray[..., None] * pose[2, :3]) / depth[..., None]
    axes = to_screen @ build_rotations(quats) * log_scales.exp()[:, None]  # (N, 2, 3)
    x, y = axes.unbind(1)
    xx = (x * x).sum(1)
    xy = (x * y).sum(1)
    yy = (y * y).sum(1)
    difference = 0.5 * (xx - yy)
    largest = 0.5 * (xx + yy) + (difference**2 + xy**2).sqrt()
    return largest * seen, (axes**2).sum(1) * seen[:, None]


def share_of_rate(variance: Tensor, reach: float, finest: float = 0.0) -> Tensor:
    """Return σ²/(σ² + finest²) · 1/(1 + (σ/reach)¹⁶) for the variance σ², all in pixels."""
    ratio = (variance * (1 / reach) * (1 / reach)).clamp(max=100.0)
    seen = variance / (variance + finest**2) if finest else 1.0
    return seen / (1 + ratio**8)


def build_rotations(quats: Tensor) -> Tensor:
    """Return (N, 3, 3) matrices of (N, 4) wxyz quaternions of any length, differentiably."""
    w, x, y, z = normalize(quats, dim=1).unbind(1)
    rows = [
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
        ],
        [
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
        ],
        [
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, ssim_weight: float, mask: Tensor | None
    ) -> Tensor:
        a, b = (t.detach().contiguous().numpy() for t in (image, target))
        if mask is None:
            counts = None
        else:
            counts = mask.contiguous().numpy()
        loss, gradient = _core.l1_ssim(a, b, ssim_weight, counts)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * grads[0], None, None, None


def l1_ssim(
    image: Tensor, target: Tensor, ssim_weight: float = 0.2, mask: Tensor | None = None
) -> Tensor:
    """Return (1 − λ)·L1 + λ·(1 − SSIM), means over pixels and channels (3DGS's loss with its λ = 0.2).

    SSIM is that of `g2ard.rendering.metrics.ssim`. Sums have a fixed order.

    Args:
        image: (H, W, C) float32 on the CPU; the loss is differentiated with respect to it.
        target: the same.
        mask: (H, W) bool, True for pixels that count in both means; None means all.

    Raises:
        InputError: wrong shapes or dtypes.
    """
    for name, tensor in (("image", image), ("target", target)):
        fits = tensor.dtype == torch.float32 and tensor.device.type == "cpu" and tensor.ndim == 3
        given = f"{tuple(tensor.shape)} {tensor.dtype} on {tensor.device}"
        require(name, given, fits, "(H, W, C) float32 on the CPU")
    loss: Tensor = _L1Ssim.apply(image, target, ssim_weight, mask)
    return loss


def anchor_loss(means: Tensor, anchors: Anchors) -> Tensor:
    """Return (1/N) Σ log(1 + [D² − 1]₊): zero inside the trust region, robust outside."""
    arrays = anchors.frames, anchors.means, anchors.r_parallel, anchors.r_perp
    frames, places, r_parallel, r_perp = (torch.from_numpy(array).to(means) for array in arrays)
    local = torch.einsum("nji,nj->ni", frames, means - places)
    inside = (local[:, :2] / r_parallel[:, None]).square().sum(1)
    squared = inside + (local[:, 2] / r_perp).square()
    return torch.log1p((squared - 1).clamp_min(0)).mean()


def shape_loss(
    log_scales: Tensor, quats: Tensor, anchors: Anchors, weights: Regularizers
) -> Tensor:
    """Return (1/N) Σ max(0, −log(r_eff − 1 + ε)) + β[log s⊥ − log s̄⊥]₊, with s⊥ along the anchor's normal."""
    normal = torch.from_numpy(anchors.frames[:, :, 2]).to(quats)
    r_perp = torch.from_numpy(anchors.r_perp).to(quats)
    extent = torch.einsum("nji,nj->ni", build_rotations(quats), normal) * log_scales.exp()
    thickness = extent.square().sum(1).clamp_min(1e-38).log() / 2 - r_perp.log()
    total = weights.thickness * thickness.clamp_min(0)
    if weights.effective_rank:
        log_q = torch.log_softmax(log_scales, dim=1)  # log(s / Σs)
        rank = torch.exp(-(log_q.exp() * log_q).sum(1))
        barrier = -torch.log((rank - 1).clamp_min(0) + weights.rank_offset)
        total = total + barrier.clamp_min(0)
    return total.mean()


def regularization(
    means: Tensor, quats: Tensor, log_scales: Tensor, anchors: Anchors, weights: Regularizers
) -> Tensor:
    """Return λ_a·L_anchor + λ_s·L_shape."""
    total = means.new_zeros(())
    if weights.anchor > 0:
        total = total + weights.anchor * anchor_loss(means, anchors)
    if weights.shape > 0:
        total = total + weights.shape * shape_loss(log_scales, quats, anchors, weights)
    return total
