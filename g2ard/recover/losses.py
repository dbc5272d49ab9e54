"""The photometric loss, fused in Rust: forward and backward in one call."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from g2ard import _core
from g2ard.errors import InputError

__all__ = ["l1_ssim"]


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        a, b = (t.detach().contiguous().numpy() for t in (image, target))
        loss, gradient = _core.l1_ssim(a, b, ssim_weight)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * grads[0], None, None


def l1_ssim(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """(1 − λ)·L1 + λ·(1 − SSIM), means over pixels and channels (3DGS's loss, its λ = 0.2 the default).

    SSIM has an 11×11 Gaussian window, σ 1.5, zero-padded, and values in 0–1. The sums have a fixed order.

    Args:
        image: (H, W, C) float32 on the CPU; the loss is differentiated with respect to it.
        target: (H, W, C) float32 on the CPU.
        ssim_weight: λ in [0, 1].

    Returns:
        The loss, a scalar.

    Raises:
        InputError: other shapes or types.

    >>> import torch
    >>> x = torch.rand(20, 30, 3, requires_grad=True)
    >>> l1_ssim(x, x.detach()).item()
    0.0
    """
    for name, tensor in (("image", image), ("target", target)):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu" or tensor.ndim != 3:
            raise InputError(
                f"{name}: expected (H, W, C) float32 on the CPU, "
                f"got {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}"
            )
    loss: Tensor = _L1Ssim.apply(image, target, ssim_weight)
    return loss
