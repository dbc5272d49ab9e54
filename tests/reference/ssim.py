"""SSIM naively, in float64 torch: one window at a time by convolution with a dense 11×11 kernel."""

import torch
from torch import Tensor


def kernel() -> Tensor:
    x = torch.arange(-5, 6, dtype=torch.float64)
    g = torch.exp(-(x**2) / (2 * 1.5**2))
    k = g[:, None] * g[None, :]
    return k / k.sum()


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean SSIM of two (H, W, C) float64 images, zero-padded."""

    def blur(x: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(x.permute(2, 0, 1)[:, None], kernel()[None, None], padding=5)

    mx, my = blur(a), blur(b)
    xx, yy, xy = blur(a * a) - mx * mx, blur(b * b) - my * my, blur(a * b) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    fraction = (2 * mx * my + c1) * (2 * xy + c2) / ((mx * mx + my * my + c1) * (xx + yy + c2))
    return fraction.mean()


def l1_ssim(a: Tensor, b: Tensor, weight: float) -> Tensor:
    return (1 - weight) * (a - b).abs().mean() + weight * (1 - ssim(a, b))
