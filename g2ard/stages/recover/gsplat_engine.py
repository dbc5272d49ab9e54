"""Engine for NVIDIA GPUs: gsplat's rasteriser, torch's loss, Adam by rows."""

import torch
from torch import Tensor

from g2ard.rendering.cuda import DEVICE, check_cuda, rasterized
from g2ard.stages.recover.engine import Objective
from g2ard.stages.recover.losses import l1_ssim_anywhere
from g2ard.stages.recover.torch_engine import TorchEngine


class GsplatEngine(TorchEngine):
    """`TorchEngine` on the GPU; gsplat adds gradients atomically, so runs differ in the last bits."""

    device = torch.device(DEVICE)

    def __init__(self, objective: Objective) -> None:
        check_cuda()
        super().__init__(objective)

    def _render(self, means: Tensor, view: int) -> Tensor:
        objective, parameters = self._objective, {**self._parameters, "means": means}
        return rasterized(parameters, objective.cameras, view, objective.background, self._settings)

    def _loss(self, image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
        return l1_ssim_anywhere(image, target, self._objective.ssim_weight, mask)
