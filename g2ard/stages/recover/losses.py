"""The photometric loss: fused in Rust on the CPU, in plain torch elsewhere."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from g2ard import _core
from g2ard.errors import InputError

__all__ = ["l1_ssim", "l1_ssim_anywhere"]

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


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
                f"expected (H, W, C) float32 on the CPU, "
                f"got {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}",
                parameter=name,
            )
    loss: Tensor = _L1Ssim.apply(image, target, ssim_weight)
    return loss


def l1_ssim_anywhere(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """`l1_ssim` in torch's own operations, for tensors on any device.

    >>> import torch
    >>> x, y = torch.rand(2, 20, 30, 3)
    >>> bool((l1_ssim_anywhere(x, y) - l1_ssim(x, y)).abs() < 1e-5)
    True
    """
    x, y = (t.permute(2, 0, 1)[:, None] for t in (image, target))
    offsets = torch.arange(_WINDOW, device=image.device, dtype=image.dtype) - _WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    weights = weights / weights.sum()

    def blurred(t: Tensor) -> Tensor:
        t = conv2d(t, weights.view(1, 1, 1, -1), padding=(0, _WINDOW // 2))
        return conv2d(t, weights.view(1, 1, -1, 1), padding=(_WINDOW // 2, 0))

    mean_x, mean_y = blurred(x), blurred(y)
    var_x = (blurred(x * x) - mean_x**2).clamp_min(0)
    var_y = (blurred(y * y) - mean_y**2).clamp_min(0)
    both = blurred(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + _C1) * (2 * both + _C2)
    ssim = above / ((mean_x**2 + mean_y**2 + _C1) * (var_x + var_y + _C2))
    return (1 - ssim_weight) * (x - y).abs().mean() + ssim_weight * (1 - ssim.mean())
