"""gsplat's rasteriser on an NVIDIA GPU. torch and gsplat are imported on first use."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import BLACK
from g2ard.errors import InputError, missing
from g2ard.rendering.renderer import RasterSettings, Renderer, settings_for
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from torch import Tensor

DEVICE = "cuda"
"""torch's name of the device."""


def check_cuda(asked: str = "engine") -> None:
    """Check that gsplat can run; `asked` is the argument that requested it, engine or device.

    Raises:
        InputError: torch finds no CUDA device.
        MissingDependencyError: gsplat is not installed.
    """
    import torch

    if not torch.cuda.is_available():
        other = "{device=cpu}" if asked == "device" else "{engine=fused}"
        raise InputError(
            "torch finds no CUDA device",
            parameter=asked,
            hint=f"gsplat needs an NVIDIA GPU, torch for CUDA, and gsplat; {other} needs none",
        )
    if find_spec("gsplat") is None:
        raise missing("gsplat's renderer", "gsplat", parameter=asked)


def rasterized(
    parameters: dict[str, Tensor], cameras: Cameras, view: int, background: Any, settings: RasterSettings
) -> Tensor:
    """Render one view (H, W, 3) with gsplat, differentiably.

    Args:
        parameters: means, quats, log_scales, logit_opacities, sh0 and shN, on the device.
        settings: only the near plane and antialiasing; gsplat has its own conventions.
    """
    import torch
    from gsplat import rasterization

    device = parameters["means"].device
    coefficients = torch.cat([parameters["sh0"], parameters["shN"]], 1)
    image, _, _ = rasterization(
        means=parameters["means"],
        quats=parameters["quats"],
        scales=parameters["log_scales"].exp(),
        opacities=parameters["logit_opacities"].sigmoid(),
        colors=coefficients,
        viewmats=torch.from_numpy(cameras.viewmats[view]).float().to(device)[None],
        Ks=torch.from_numpy(cameras.Ks[view]).float().to(device)[None],
        width=int(cameras.widths[view]),
        height=int(cameras.heights[view]),
        sh_degree=round(coefficients.shape[1] ** 0.5) - 1,
        backgrounds=torch.tensor([background], dtype=torch.float32, device=device),
        near_plane=settings.near_of(view),
        rasterize_mode="antialiased" if settings.antialiased else "classic",
        packed=False,
    )
    return image[0]


class CudaRenderer:
    """Renderer for scores with gsplat on a GPU: `g2ard.Renderer.clipped` within rounding."""

    def __init__(
        self, splats: Splats, *, background: Sequence[float] = BLACK, settings: RasterSettings | None = None
    ) -> None:
        import torch

        splats = splats.narrowed()
        self._offset, self.background = splats.offset, [float(c) for c in background]
        self._settings = settings_for(splats.means, settings, antialiased=splats.antialiased)
        names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
        arrays = ((name, np.asarray(getattr(splats, name), np.float32)) for name in names)
        self._parameters = {name: torch.from_numpy(array).to(DEVICE) for name, array in arrays}

    def clipped(self, camera: Camera) -> NDArray[np.float32]:
        """Render the (H, W, 3) image clipped to [0, 1]."""
        return self.image(camera).clip(0, 1)

    def image(self, camera: Camera) -> NDArray[np.float32]:
        """Render the (H, W, 3) image."""
        import torch

        here = Cameras.of([camera]).recentred(self._offset)
        with torch.inference_mode():
            image = rasterized(self._parameters, here, 0, self.background, self._settings)
        found: NDArray[np.float32] = image.cpu().numpy()
        return found


def renderer_on(
    device: str, splats: Splats, background: Sequence[float], settings: RasterSettings | None
) -> Renderer | CudaRenderer:
    """Return a renderer for scores: gsplat's on "cuda", unless the settings ask for INRIA's conventions."""
    fits = device == "cuda" and (settings or RasterSettings()).convention == "gsplat"
    return (CudaRenderer if fits else Renderer)(splats, background=background, settings=settings)
