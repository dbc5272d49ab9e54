"""L_shape and L_anchor (`eq:shape`, `eq:anchor`) in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from g2ard.stages.recover.anchors import Anchors, Regularizers
from g2ard.stages.recover.extent import rotations

__all__ = ["TorchAnchors", "anchor_loss", "regularization", "shape_loss"]


class TorchAnchors:
    """`Anchors` as tensors."""

    def __init__(self, anchors: Anchors) -> None:
        self.means = torch.from_numpy(anchors.means)
        self.frames = torch.from_numpy(anchors.frames)
        self.r_parallel = torch.from_numpy(anchors.r_parallel)
        self.r_perp = torch.from_numpy(anchors.r_perp)

    def to(self, device: torch.device) -> TorchAnchors:
        """Itself, moved."""
        for name, value in vars(self).items():
            setattr(self, name, value.to(device))
        return self


def anchor_loss(means: Tensor, anchors: TorchAnchors) -> Tensor:
    """(1/N) Σ log(1 + [D² − 1]₊): nothing inside the trust region, robust outside it."""
    local = torch.einsum("nji,nj->ni", anchors.frames, means - anchors.means)
    inside = (local[:, :2] / anchors.r_parallel[:, None]).square().sum(1)
    squared = inside + (local[:, 2] / anchors.r_perp).square()
    return torch.log1p((squared - 1).clamp_min(0)).mean()


def shape_loss(log_scales: Tensor, quats: Tensor, anchors: TorchAnchors, weights: Regularizers) -> Tensor:
    """(1/N) Σ max(0, −log(r_eff − 1 + ε)) + β[log s⊥ − log s̄⊥]₊; s⊥ is taken along the anchor's normal."""
    normal = anchors.frames[:, :, 2]
    extent = torch.einsum("nji,nj->ni", rotations(quats), normal) * log_scales.exp()
    thickness = extent.square().sum(1).clamp_min(1e-38).log() / 2 - anchors.r_perp.log()
    total = weights.thickness * thickness.clamp_min(0)
    if weights.effective_rank:
        log_q = torch.log_softmax(log_scales, dim=1)  # log(s / Σs)
        rank = torch.exp(-(log_q.exp() * log_q).sum(1))
        total = total + (-torch.log((rank - 1).clamp_min(0) + weights.rank_offset)).clamp_min(0)
    return total.mean()


def regularization(
    means: Tensor, quats: Tensor, log_scales: Tensor, anchors: TorchAnchors, weights: Regularizers
) -> Tensor:
    """λ_a·L_anchor + λ_s·L_shape."""
    total = means.new_zeros(())
    if weights.anchor > 0:
        total = total + weights.anchor * anchor_loss(means, anchors)
    if weights.shape > 0:
        shape = shape_loss(log_scales, quats, anchors, weights)
        total = total + weights.shape * shape
    return total
