"""The rasteriser as a differentiable torch function, for custom losses and optimisers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import g2ard._core as _core
from g2ard.config.choices import BLACK
from g2ard.errors import InputError, require
from g2ard.rendering.renderer import RasterSettings, View, view_of
from g2ard.scene.cameras import Cameras

_NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")

_idle: list[_core.Rasterizer] = []
"""Rasterizers that no backward pass needs any more, kept to reuse their buffers."""


class _Lease:
    """Exclusive use of a Rasterizer while an autograd node may need its forward pass."""

    def __init__(self) -> None:
        try:
            self.rasterizer = _idle.pop()
        except IndexError:
            self.rasterizer = _core.Rasterizer()

    def __del__(self) -> None:
        if len(_idle) < 4:  # more would only waste memory
            _idle.append(self.rasterizer)


def _numpy(tensor: Tensor) -> np.ndarray[Any, Any]:
    return tensor.detach().contiguous().numpy()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, view: View, settings: RasterSettings, background: list[float], *params: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.lease = _Lease()
        ctx.save_for_backward(*params)
        ctx.set_materialize_grads(False)
        arrays = tuple(_numpy(p) for p in params)
        image, alpha, depth, _ = ctx.lease.rasterizer.forward(arrays, view, settings, background)
        return torch.from_numpy(image), torch.from_numpy(alpha), torch.from_numpy(depth)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, alpha, depth = (None if g is None else _numpy(g.float()) for g in grads)
        params = ctx.saved_tensors
        if image is None:
            like = depth if alpha is None else alpha
            if like is None:
                return (None,) * (3 + len(params))
            image = np.zeros((*like.shape, 3), np.float32)
        arrays = tuple(_numpy(p) for p in params)
        out = ctx.lease.rasterizer.backward(arrays, image, alpha, depth)
        return (None, None, None, *(torch.from_numpy(g) for g in out))


def rasterize(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    cameras: Cameras,
    index: int,
    background: Sequence[float] = BLACK,
    settings: RasterSettings | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render a view on the CPU, differentiable in all six parameter tensors.

    Calls are independent: several views may be rendered before one backward pass. Results are equal to the
    bit for any number of threads.

    Args:
        means: (N, 3) float32, in the coordinates of `cameras`.
        quats: (N, 4) float32 wxyz, any length; zero means no rotation.
        log_scales: (N, 3) float32, natural logarithms.
        logit_opacities: (N,) float32.
        sh0: (N, 1, 3) float32.
        shN: (N, K−1, 3) float32, SH degree 0–3.
        cameras: the views' cameras.
        index: index of the view.
        background: RGB behind the scene; not differentiated.
        settings: conventions; None means gsplat's, not antialiased.

    Returns:
        image (H, W, 3), alpha (H, W) and depth (H, W) = Σ αT·z (not divided by alpha), float32.

    Raises:
        InputError: a tensor that is not float32 on the CPU, mismatched shapes, or an index out of range.

    >>> import torch
    >>> from g2ard.scene.cameras import Cameras, look_at
    >>> views = Cameras.from_lists(
    ...     [look_at([0, -2, 0], [0, 0, 0])], [[[50, 0, 16], [0, 50, 12], [0, 0, 1]]], [(32, 24)], ["front"])
    >>> means = torch.zeros(1, 3, requires_grad=True)
    >>> image, alpha, depth = rasterize(
    ...     means, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), -2.0), torch.zeros(1),
    ...     torch.ones(1, 1, 3), torch.zeros(1, 0, 3), views, 0)
    >>> image[:, :16].sum().backward()  # to light the left half up, move left
    >>> bool(means.grad[0, 0] < 0)
    True
    """
    settings = settings or RasterSettings()
    if settings.antialiased is None:
        settings = replace(settings, antialiased=False)
    if not 0 <= index < len(cameras):
        raise InputError(f"expected a view index below {len(cameras)}, got {index}")
    params = (means, quats, log_scales, logit_opacities, sh0, shN)
    for name, tensor in zip(_NAMES, params, strict=True):
        fits = tensor.dtype == torch.float32 and tensor.device.type == "cpu"
        require(name, f"{tensor.dtype} on {tensor.device}", fits, "float32 on the CPU")
    colour = [float(c) for c in background]
    out: tuple[Tensor, Tensor, Tensor] = _Rasterize.apply(
        view_of(cameras, index, settings), settings, colour, *params
    )
    return out
