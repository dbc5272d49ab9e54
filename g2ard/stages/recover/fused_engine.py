"""Engine that runs whole steps in Rust or on a GPU: forward, loss, backward, regularisers and sparse Adam."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.rendering.renderer import arrays_of, view_of
from g2ard.scene.splats import Splats
from g2ard.stages.recover.engine import TYPICAL_LOSS, Objective
from g2ard.stages.recover.schedule import Rates
from g2ard.stages.recover.sizes import radii


class FusedEngine:
    """Parameters and optimiser state of a recovery, advanced one view at a time.

    Equivalent to `TorchEngine` up to rounding, on the device in use (`system.devices`). Its state is the same
    on every device. After a `DeviceError` new engines run on the CPU.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        start, anchors = objective.start, objective.anchors
        units = radii(start) if objective.means_in_scales else None
        self._trainer = _core.Trainer(arrays_of(start), objective, units)
        self._skipped_before = 0
        self._anchors = (
            anchors.means,
            np.ascontiguousarray(anchors.frames),
            anchors.r_parallel,
            anchors.r_perp,
        )
        self._trainer.anchor(*self._anchors)
        if objective.frozen is not None:
            self._trainer.freeze(objective.frozen)

    def step(
        self,
        view: int,
        target: NDArray[np.float32],
        rates: Rates,
        *,
        regularize: bool,
        mask: NDArray[np.bool_] | None = None,
    ) -> float:
        """Take one optimiser step on one view; return its photometric loss.

        A view's target and mask are the same in all steps, so that the device may keep them.
        """
        objective = self._objective
        loss, _ = self._trainer.step(
            view_of(objective.cameras, view, objective.settings),
            target,
            rates,
            objective.regularizers if regularize else None,
            mask,
            TYPICAL_LOSS if objective.relative else None,
            view,
        )
        return loss

    def splats(self) -> Splats:
        """Return the current scene, with normalised quaternions."""
        means, quats, log_scales, logit_opacities, sh0, shN = self._trainer.arrays()
        length = np.linalg.norm(quats, axis=1, keepdims=True)
        quats = np.where(length > 0, quats / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])
        return replace(
            self._objective.start,
            means=means,
            quats=quats.astype(np.float32),
            scales=np.exp(log_scales.astype(np.float64)).astype(np.float32),
            logit_opacities=logit_opacities,
            sh0=sh0,
            shN=shN,
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """Return everything that a bitwise resume needs."""
        return {**self._trainer.state(), "skipped": np.array(self.skipped)}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        self._skipped_before = int(state["skipped"]) - self._trainer.skipped
        self._trainer.load(state)
        self._trainer.anchor(*self._anchors)

    @property
    def counts(self) -> NDArray[Any]:
        """Number of steps that each Gaussian has taken, (N,)."""
        return self._trainer.state()["steps"]

    @property
    def skipped(self) -> int:
        """Number of single-Gaussian steps skipped because a gradient was not finite."""
        return self._skipped_before + self._trainer.skipped
