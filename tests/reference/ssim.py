"""SSIM naively, in float64 torch: one window at a time by convolution with a dense 11×11 kernel."""

import torch
from torch import Tensor


def kernel() -> Tensor:
    x = torch.arange(-5, 6, dtype=torch.float64)
    g = torch.exp(-(x**2) / (2 * 1.5**2))
    k = g[:, None] * g[None, :]
    return k / k.sum()


def ssim(a: Tensor, b: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean SSIM of two (H, W, C) float64 images; `mask`: (H, W), pixels that count.

    Beyond the edge pixels are black, and count if there is no mask.
    """
    weights = torch.ones(a.shape[:2], dtype=torch.float64) if mask is None else mask.double()
    counts = torch.nn.functional.pad(weights, (5, 5, 5, 5), value=float(mask is None))

    def windows(padded: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(padded[:, None], kernel()[None, None])

    shares = torch.where(weights > 0, windows(counts[None])[0, 0], 1.0)

    def blur(x: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(x.permute(2, 0, 1), (5, 5, 5, 5))
        return windows(torch.where(counts > 0, padded, 0.0)) / shares

    mx, my = blur(a), blur(b)
    xx, yy, xy = blur(a * a) - mx * mx, blur(b * b) - my * my, blur(a * b) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    fraction = (2 * mx * my + c1) * (2 * xy + c2) / ((mx * mx + my * my + c1) * (xx + yy + c2))
    return fraction[:, :, weights > 0].mean()


def l1_ssim(a: Tensor, b: Tensor, weight: float, mask: Tensor | None = None) -> Tensor:
    counts = torch.ones(a.shape[:2], dtype=torch.bool) if mask is None else mask
    return (1 - weight) * (a - b).abs()[counts].mean() + weight * (1 - ssim(a, b, mask))
