"""Losses of recovery in torch: photometric, L_shape and L_anchor (`eq:shape`, `eq:anchor`)."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from g2ard import _core
from g2ard.errors import require
from g2ard.stages.recover.anchors import Anchors, Regularizers
from g2ard.stages.recover.extent import rotations

_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float, mask: Tensor | None) -> Tensor:
        a, b = (t.detach().contiguous().numpy() for t in (image, target))
        counts = None if mask is None else mask.contiguous().numpy()
        loss, gradient = _core.l1_ssim(a, b, ssim_weight, counts)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * grads[0], None, None, None


def l1_ssim(image: Tensor, target: Tensor, ssim_weight: float = 0.2, mask: Tensor | None = None) -> Tensor:
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


def l1_ssim_anywhere(
    image: Tensor, target: Tensor, ssim_weight: float = 0.2, mask: Tensor | None = None
) -> Tensor:
    """Compute `l1_ssim` with torch operations, on any device."""
    counts = torch.ones_like(image[..., 0], dtype=torch.bool) if mask is None else mask
    x, y = (torch.where(counts, t.permute(2, 0, 1), 0.0)[:, None] for t in (image, target))
    offsets = torch.arange(_SSIM_WINDOW, device=image.device, dtype=image.dtype) - _SSIM_WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SSIM_SIGMA**2))
    weights = weights / weights.sum()

    def summed(t: Tensor) -> Tensor:
        t = conv2d(t, weights.view(1, 1, 1, -1), padding=(0, _SSIM_WINDOW // 2))
        return conv2d(t, weights.view(1, 1, -1, 1), padding=(_SSIM_WINDOW // 2, 0))

    # Without a mask, pixels beyond the edge are black and count; with one they have no part.
    inside = None if mask is None else summed(counts.to(image.dtype)[None, None]).where(counts, 1.0)

    def blurred(t: Tensor) -> Tensor:
        return summed(t) if inside is None else summed(t) / inside

    mean_x, mean_y = blurred(x), blurred(y)
    var_x = (blurred(x * x) - mean_x**2).clamp_min(0)
    var_y = (blurred(y * y) - mean_y**2).clamp_min(0)
    both = blurred(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + _SSIM_C1) * (2 * both + _SSIM_C2)
    ssim = above / ((mean_x**2 + mean_y**2 + _SSIM_C1) * (var_x + var_y + _SSIM_C2))
    loss = (1 - ssim_weight) * (x - y).abs() + ssim_weight * (1 - ssim)
    return torch.where(counts, loss, 0.0).sum() / (counts.sum().clamp_min(1) * len(x))


def anchor_loss(means: Tensor, anchors: Anchors) -> Tensor:
    """Return (1/N) Σ log(1 + [D² − 1]₊): zero inside the trust region, robust outside."""
    arrays = anchors.frames, anchors.means, anchors.r_parallel, anchors.r_perp
    frames, places, r_parallel, r_perp = (torch.from_numpy(array).to(means) for array in arrays)
    local = torch.einsum("nji,nj->ni", frames, means - places)
    inside = (local[:, :2] / r_parallel[:, None]).square().sum(1)
    squared = inside + (local[:, 2] / r_perp).square()
    return torch.log1p((squared - 1).clamp_min(0)).mean()


def shape_loss(log_scales: Tensor, quats: Tensor, anchors: Anchors, weights: Regularizers) -> Tensor:
    """Return (1/N) Σ max(0, −log(r_eff − 1 + ε)) + β[log s⊥ − log s̄⊥]₊, with s⊥ along the anchor's normal."""
    normal, r_perp = (torch.from_numpy(a).to(quats) for a in (anchors.frames[:, :, 2], anchors.r_perp))
    extent = torch.einsum("nji,nj->ni", rotations(quats), normal) * log_scales.exp()
    thickness = extent.square().sum(1).clamp_min(1e-38).log() / 2 - r_perp.log()
    total = weights.thickness * thickness.clamp_min(0)
    if weights.effective_rank:
        log_q = torch.log_softmax(log_scales, dim=1)  # log(s / Σs)
        rank = torch.exp(-(log_q.exp() * log_q).sum(1))
        total = total + (-torch.log((rank - 1).clamp_min(0) + weights.rank_offset)).clamp_min(0)
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
