"""Engine for NVIDIA GPUs: gsplat's rasteriser, torch's loss, Adam by rows."""

from __future__ import annotations

from importlib.util import find_spec

import torch
from torch import Tensor

from g2ard.errors import InputError, missing
from g2ard.stages.recover.engine import Objective
from g2ard.stages.recover.losses import l1_ssim_anywhere
from g2ard.stages.recover.torch_engine import TorchEngine


def check_cuda() -> None:
    """Check that gsplat can run.

    Raises:
        InputError: torch finds no CUDA device.
        MissingDependencyError: gsplat is not installed.
    """
    if not torch.cuda.is_available():
        raise InputError(
            "torch finds no CUDA device",
            parameter="engine",
            hint="gsplat needs an NVIDIA GPU, torch for CUDA and g2ard[cuda]; {engine='fused'} needs none",
        )
    if find_spec("gsplat") is None:
        raise missing("the engine 'gsplat'", "g2ard[cuda]", parameter="engine")


class GsplatEngine(TorchEngine):
    """`TorchEngine` on the GPU; gsplat adds gradients atomically, so runs differ in the last bits."""

    device = torch.device("cuda")

    def __init__(self, objective: Objective) -> None:
        check_cuda()
        super().__init__(objective)
        self._viewmats = torch.from_numpy(objective.cameras.viewmats).float().to(self.device)
        self._Ks = torch.from_numpy(objective.cameras.Ks).float().to(self.device)

    def _render(self, means: Tensor, view: int) -> Tensor:
        from gsplat import rasterization

        p, objective = self._parameters, self._objective
        coefficients = torch.cat([p["sh0"], p["shN"]], 1)
        image, _, _ = rasterization(
            means=means,
            quats=p["quats"],
            scales=p["log_scales"].exp(),
            opacities=p["logit_opacities"].sigmoid(),
            colors=coefficients,
            viewmats=self._viewmats[view][None],
            Ks=self._Ks[view][None],
            width=int(objective.cameras.widths[view]),
            height=int(objective.cameras.heights[view]),
            sh_degree=round(coefficients.shape[1] ** 0.5) - 1,
            backgrounds=torch.tensor([objective.background], device=self.device),
            near_plane=self._settings.near_of(view),
            rasterize_mode="antialiased" if self._settings.antialiased else "classic",
            packed=False,
        )
        return image[0]

    def _loss(self, image: Tensor, target: Tensor) -> Tensor:
        return l1_ssim_anywhere(image, target, self._objective.ssim_weight)
