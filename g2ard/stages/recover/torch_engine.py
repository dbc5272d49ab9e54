"""Engine in torch: autograd over the Rust rasteriser and loss, Adam by rows."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from g2ard.scene.splats import Splats
from g2ard.stages.recover.engine import LEAST_LOSS, TYPICAL_LOSS, Objective
from g2ard.stages.recover.extent import extents, share_of_rate
from g2ard.stages.recover.losses import l1_ssim, regularization
from g2ard.stages.recover.rasterize import rasterize
from g2ard.stages.recover.schedule import Rates
from g2ard.stages.recover.selective_adam import SelectiveAdam
from g2ard.stages.recover.sizes import radii


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run torch's own operations on one thread.

    The rasteriser, the loss and Adam have threads of their own, for which torch's would wait in busy loops
    that cost several times the step.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class TorchEngine:
    """`FusedEngine` in torch, with the moments of `SelectiveAdam`.

    With `means_in_scales` the means are optimised as multiples of each Gaussian's initial radius (`radii`):
    Adam ignores the scale of gradients, so a rate of 0.05 moves a Gaussian by 5 % of its size. Subclasses
    replace rendering, loss and device.
    """

    device = torch.device("cpu")

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        splats = objective.start
        self._settings = objective.settings
        self._base = torch.from_numpy(splats.means.astype(np.float32)).to(self.device)
        unit = radii(splats) if objective.means_in_scales else np.ones(len(splats), np.float32)
        self._unit = torch.from_numpy(unit[:, None]).to(self.device)
        start = {
            "means": np.zeros((len(splats), 3), np.float32),
            "log_scales": splats.log_scales,
            "quats": splats.quats,
            "logit_opacities": splats.logit_opacities,
            "sh0": splats.sh0,
            "shN": splats.shN,
        }
        self._parameters = {
            name: torch.from_numpy(array.copy()).to(self.device).requires_grad_()
            for name, array in start.items()
        }
        self._adam = SelectiveAdam({name: p for name, p in self._parameters.items() if p.numel()})

    @_one_thread()
    def step(
        self,
        view: int,
        target: NDArray[np.float32],
        rates: Rates,
        *,
        regularize: bool,
        mask: NDArray[np.bool_] | None = None,
    ) -> float:
        p = self._parameters
        means = self._base + self._unit * p["means"]
        image = self._render(means, view)
        counts = None if mask is None else torch.from_numpy(mask).to(self.device)
        loss = self._loss(image, torch.from_numpy(target).to(self.device), counts)
        total = loss
        if self._objective.relative:
            total = total * (TYPICAL_LOSS / max(float(loss.detach()), LEAST_LOSS))
        if regularize:
            anchors, weights = self._objective.anchors, self._objective.regularizers
            total = total + regularization(means, p["quats"], p["log_scales"], anchors, weights)
        for parameter in p.values():
            parameter.grad = None
        torch.autograd.backward(total)
        self._adam.step(vars(rates), self._shares(means.detach(), view, rates))
        return float(loss.detach())

    def _shares(self, means: Tensor, view: int, rates: Rates) -> dict[str, Tensor]:
        """Return factors on each rate, per row or value, from sizes in this view."""
        if math.isinf(rates.reach) and not rates.finest:
            return {}
        p, near, cameras = self._parameters, self._settings.near_of(view), self._objective.cameras
        largest, axes = extents(means, p["quats"], p["log_scales"], cameras, view, near)
        pixels = rates.reach * float(max(cameras.widths[view], cameras.heights[view]))
        whole, own = (share_of_rate(sizes, pixels, rates.finest) for sizes in (largest, axes))
        return {"means": whole[:, None], "quats": whole[:, None], "log_scales": own}

    def _render(self, means: Tensor, view: int) -> Tensor:
        """Render one view (H, W, 3), differentiably."""
        objective, parameters = self._objective, {**self._parameters, "means": means}
        return rasterize(
            **parameters,
            cameras=objective.cameras,
            index=view,
            background=objective.background,
            settings=self._settings,
        )[0]

    def _loss(self, image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
        return l1_ssim(image, target, self._objective.ssim_weight, mask)

    def splats(self) -> Splats:
        p = {name: value.detach().cpu() for name, value in self._parameters.items()}
        return replace(
            self._objective.start,
            means=(self._base.cpu() + self._unit.cpu() * p["means"]).numpy().copy(),
            quats=torch.nn.functional.normalize(p["quats"], dim=1).numpy().copy(),
            scales=p["log_scales"].double().exp().float().numpy(),
            logit_opacities=p["logit_opacities"].numpy().copy(),
            sh0=p["sh0"].numpy().copy(),
            shN=p["shN"].numpy().copy(),
        )

    def state(self) -> dict[str, NDArray[Any]]:
        arrays = {f"p.{name}": value.detach().cpu().numpy() for name, value in self._parameters.items()}
        arrays["base"], arrays["unit"] = self._base.cpu().numpy(), self._unit.cpu().numpy()
        arrays["skipped"], arrays["counts"] = np.array(self._adam.skipped), self.counts
        return arrays | {name: moment.cpu().numpy() for name, moment in self._adam.moments.items()}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                parameter.copy_(torch.from_numpy(state[f"p.{name}"]))
        self._base = torch.from_numpy(state["base"]).to(self.device)
        self._unit = torch.from_numpy(state["unit"]).to(self.device)
        self._adam.skipped = int(state["skipped"])
        self._adam.counts.copy_(torch.from_numpy(state["counts"]))
        for name, moment in self._adam.moments.items():
            moment.copy_(torch.from_numpy(state[name]))

    @property
    def counts(self) -> NDArray[Any]:
        return self._adam.counts.cpu().numpy()

    @property
    def skipped(self) -> int:
        return self._adam.skipped
