"""Engine in torch: autograd over the Rust rasteriser; Adam by rows."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import g2ard._core as _core
from g2ard.arrays import Float32, Mask, Values
from g2ard.scene.splats import Splats
from g2ard.stages.recover.config import Rates
from g2ard.stages.recover.engine import LEAST_LOSS, TYPICAL_LOSS, Objective, measure_radii
from g2ard.stages.recover.losses import l1_ssim, measure_extents, regularization, share_of_rate
from g2ard.stages.recover.rasterize import rasterize


class SelectiveAdam:
    """`torch.optim.Adam` by rows (Gaussians), like in the fused engine.

    A row whose gradients are all zero keeps its values and moments, and each row has its own step count t: p
    ← p − lr · m/(1 − β₁ᵗ) / (√(v/(1 − β₂ᵗ)) + ε), with the bias terms in float64. A row with a gradient that
    is not finite, or over 1e18, is skipped too, and counted. A step is one pass in Rust, with the bits of any
    number of threads.

    Args:
        parameters: (N, …) tensors by name.
    """

    skipped = 0
    """Number of row steps skipped because a gradient was not finite."""

    counts: Tensor
    """(N,) int64 number of steps of each row."""

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        self._parameters = parameters
        self.moments = {
            f"{key}.{name}": torch.zeros_like(p) for name, p in parameters.items() for key in "mv"
        }
        first = next(iter(parameters.values()))
        self.counts = torch.zeros(len(first), dtype=torch.int64)

    @torch.no_grad()
    def step(self, rates: Mapping[str, float], shares: Mapping[str, Tensor]) -> None:
        """Take one step for every row that has a gradient.

        Args:
            rates: learning rate of each parameter, and `momentum`, β₁.
            shares: factors on the rates of some parameters, per row or value.
        """
        rows = [self._arrays(name, rates[name], shares.get(name)) for name in self._parameters]
        self.skipped += _core.adam_rows(rows, self.counts.numpy(), rates["momentum"])

    def _arrays(self, name: str, rate: float, share: Tensor | None) -> tuple[Any, ...]:
        """Return a parameter, its moments, gradient, rate and share for the kernel, without copies."""
        p = self._parameters[name]
        m = self.moments[f"m.{name}"]
        v = self.moments[f"v.{name}"]
        assert p.grad is not None
        held = (t.numpy() for t in (p.detach(), m, v, p.grad.contiguous()))
        return *held, rate, None if share is None else share.contiguous().numpy()


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

    With `means_in_scales` the means are optimised as multiples of each Gaussian's initial radius
    (`measure_radii`): Adam ignores the scale of gradients, so a rate of 0.05 moves a Gaussian by 5 % of its
    size.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        splats = objective.start
        self._settings = objective.settings
        self._base = torch.from_numpy(splats.means.astype(np.float32))
        if objective.means_in_scales:
            unit = measure_radii(splats)
        else:
            unit = np.ones(len(splats), np.float32)
        self._unit = torch.from_numpy(unit[:, None])
        start = {
            "means": np.zeros((len(splats), 3), np.float32),
            "log_scales": splats.log_scales,
            "quats": splats.quats,
            "logit_opacities": splats.logit_opacities,
            "sh0": splats.sh0,
            "shN": splats.shN,
        }
        self._parameters = {
            name: torch.from_numpy(array.copy()).requires_grad_() for name, array in start.items()
        }
        self._adam = SelectiveAdam({name: p for name, p in self._parameters.items() if p.numel()})

    @_one_thread()
    def step(
        self,
        view: int,
        target: Float32,
        rates: Rates,
        *,
        regularize: bool,
        mask: Mask | None = None,
        fixed: bool = True,
    ) -> float:
        p = self._parameters
        means = self._base + self._unit * p["means"]
        image = self._render(means, view)
        if mask is None:
            counts = None
        else:
            counts = torch.from_numpy(mask)
        loss = l1_ssim(image, torch.from_numpy(target), self._objective.ssim_weight, counts)
        total = loss
        if self._objective.relative:
            total = total * (TYPICAL_LOSS / max(float(loss.detach()), LEAST_LOSS))
        if regularize:
            anchors = self._objective.anchors
            weights = self._objective.regularizers
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
        p = self._parameters
        near = self._settings.near_of(view)
        cameras = self._objective.cameras
        largest, axes = measure_extents(
            means,
            p["quats"],
            p["log_scales"],
            cameras,
            view,
            near,
        )
        pixels = rates.reach * float(max(cameras.widths[view], cameras.heights[view]))
        whole, own = (share_of_rate(sizes, pixels, rates.finest) for sizes in (largest, axes))
        return {"means": whole[:, None], "quats": whole[:, None], "log_scales": own}

    def _render(self, means: Tensor, view: int) -> Tensor:
        """Render one view (H, W, 3), differentiably."""
        objective = self._objective
        parameters = {**self._parameters, "means": means}
        return rasterize(
            **parameters,
            cameras=objective.cameras,
            index=view,
            background=objective.background,
            settings=self._settings,
        )[0]

    def splats(self) -> Splats:
        p = {name: value.detach() for name, value in self._parameters.items()}
        return replace(
            self._objective.start,
            means=(self._base + self._unit * p["means"]).numpy().copy(),
            quats=torch.nn.functional.normalize(p["quats"], dim=1).numpy().copy(),
            scales=p["log_scales"].double().exp().float().numpy(),
            logit_opacities=p["logit_opacities"].numpy().copy(),
            sh0=p["sh0"].numpy().copy(),
            shN=p["shN"].numpy().copy(),
        )

    def state(self) -> dict[str, Values]:
        arrays = {f"p.{name}": value.detach().numpy() for name, value in self._parameters.items()}
        arrays["base"] = self._base.numpy()
        arrays["unit"] = self._unit.numpy()
        arrays["skipped"] = np.array(self._adam.skipped)
        arrays["counts"] = self.counts
        return arrays | {name: moment.numpy() for name, moment in self._adam.moments.items()}

    def load(self, state: dict[str, Values]) -> None:
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                parameter.copy_(torch.from_numpy(state[f"p.{name}"]))
        self._base = torch.from_numpy(state["base"])
        self._unit = torch.from_numpy(state["unit"])
        self._adam.skipped = int(state["skipped"])
        self._adam.counts.copy_(torch.from_numpy(state["counts"]))
        for name, moment in self._adam.moments.items():
            moment.copy_(torch.from_numpy(state[name]))

    @property
    def counts(self) -> Values:
        return self._adam.counts.numpy()

    @property
    def skipped(self) -> int:
        return self._adam.skipped
