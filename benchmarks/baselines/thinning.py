"""Training of a dense scene while a strategy thins it to an exact count, over `g2ard.rasterize` on the CPU.

Rates, weights and coordinates are those of `benchmarks.baselines.mcmc`, without its terms on opacity and
size.
"""

from __future__ import annotations

import time
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines import mcmc
from g2ard.config.choices import BLACK, Colour
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import Targets
from g2ard.scene.splats import Splats
from g2ard.scene.transform import transform
from g2ard.stages.recover.loop import draw_views
from g2ard.stages.recover.losses import l1_ssim
from g2ard.stages.recover.optimize import Watch
from g2ard.stages.recover.rasterize import rasterize

__all__ = ["Strategy", "Training"]


class Strategy(Protocol):
    """Addition of a method to plain training."""

    def penalty(self, training: Training) -> Tensor | float:
        """Return a term of the loss."""

    def after(self, training: Training, step: int) -> None:
        """Act on the scene after a step, counted from 1; the last leaves the exact count."""


class Training:
    """Parameters and optimiser of a run, in coordinates where cameras reach a distance of 1."""

    def __init__(
        self,
        prior: Splats,
        targets: Targets,
        steps: int,
        *,
        background: Colour = BLACK,
        seed: int = 0,
    ) -> None:
        torch.manual_seed(seed)
        self.steps, self.seed, self._fill = steps, seed, background
        middle, extent = mcmc._frame(targets.cameras)
        self._cameras = mcmc._within(targets.cameras, middle, extent)
        self.views = [mcmc._tensors(targets, view, False) for view in range(len(targets.cameras))]
        self._settings = RasterSettings(antialiased=prior.antialiased, near=mcmc._NEAR)
        self._model = prior.render_model
        self._world = np.diag([extent] * 3 + [1.0])
        self._world[:3, 3] = middle
        inner = transform(prior, np.linalg.inv(self._world))
        self.values = {
            "means": torch.from_numpy((inner.means + inner.offset).astype(np.float32)),
            "quats": torch.tensor(inner.quats),
            "log_scales": torch.tensor(np.log(inner.scales)),
            "logit_opacities": torch.tensor(inner.logit_opacities),
            "sh0": torch.tensor(inner.sh0),
            "shN": torch.tensor(inner.shN),
        }
        rates = mcmc._RATES
        rates = {**rates, "log_scales": rates["scales"], "logit_opacities": rates["opacities"]}
        self._optimizers: dict[str, Any] = {
            name: torch.optim.Adam([value.requires_grad_()], lr=rates[name], eps=1e-15, fused=True)
            for name, value in self.values.items()
        }

    def run(self, strategy: Strategy, watch: Watch | None = None) -> tuple[Splats, float]:
        """Train on one view per step; return the scene and the seconds without `watch`."""
        spent, now = 0.0, time.monotonic()
        for step in range(1, self.steps + 1):
            epoch, turn = divmod(step - 1, len(self.views))
            view = int(draw_views(self.seed, epoch, len(self.views))[turn])
            rate = mcmc._RATES["means"] * mcmc._EXTENT * 0.01 ** (step / self.steps)
            self._optimizers["means"].param_groups[0]["lr"] = rate
            loss: Any = self.loss(view, self.rendered(view)) + strategy.penalty(self)
            loss.backward()
            for optimizer in self._optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            strategy.after(self, step)
            if watch is not None and step % mcmc._WATCHED == 0:
                spent += time.monotonic() - now
                watch(step, spent, self.splats)
                now = time.monotonic()
        return self.splats(), spent + time.monotonic() - now

    def rendered(
        self, view: int, settings: RasterSettings | None = None, **other: Tensor
    ) -> Tensor:
        """Render a view, with some tensors replaced by others."""
        how = settings or self._settings
        values = {**self.values, **other}
        image, _, _ = rasterize(
            **values, cameras=self._cameras, index=view, background=self._fill, settings=how
        )
        return image

    def loss(self, view: int, image: Tensor) -> Tensor:
        """Return the L1 and SSIM loss of a rendered view."""
        target, mask = self.views[view]
        if mask is not None:
            image, target = image * mask, target * mask
        return l1_ssim(image, target, mcmc._SSIM_WEIGHT)

    def keep(self, rows: Tensor) -> None:
        """Keep some Gaussians, with their moments."""
        for name, old in self.values.items():
            optimizer = self._optimizers[name]
            new = old.detach()[rows].requires_grad_()
            moments = optimizer.state.pop(old, {})
            optimizer.state[new] = {
                key: m[rows] if m.shape == old.shape else m for key, m in moments.items()
            }
            optimizer.param_groups[0]["params"] = [new]
            self.values[name] = new

    def splats(self) -> Splats:
        """Return the scene in world coordinates."""
        arrays = {name: value.detach().numpy().copy() for name, value in self.values.items()}
        scales = np.exp(arrays.pop("log_scales"))
        scene = Splats.create(**arrays, scales=scales, render_model=self._model)
        return transform(scene, self._world)
