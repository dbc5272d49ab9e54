"""Objective and interface of the engines that run recovery's steps."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Anchors, Regularizers
from g2ard.stages.recover.schedule import Rates

TYPICAL_LOSS, LEAST_LOSS = 0.02, 0.005
"""Loss to which the gradients of views are scaled if they count alike, and the loss below which errors are
invisible, about 40 dB."""


@dataclass(frozen=True, eq=False)
class Photometric:
    """Settings for rendering views and comparing them with targets.

    Args:
        settings: the renderer's conventions.
        background: RGB behind the scene.
        ssim_weight: λ in (1−λ)·L1 + λ·(1−SSIM).
    """

    settings: RasterSettings
    background: tuple[float, float, float]
    ssim_weight: float


@dataclass(frozen=True, eq=False)
class Objective(Photometric):
    """Objective, start and variables of an engine.

    Args:
        cameras: cameras of the views, relative to its offset.
        means_in_scales: optimise means in multiples of each Gaussian's initial radius.
        frozen: (N,) bool, Gaussians that stay unchanged; None freezes none.
        relative: whether to descend log(loss) times `TYPICAL_LOSS`, so that views count alike whatever their
            loss; losses below `LEAST_LOSS` count as that.
    """

    start: Splats
    cameras: Cameras
    anchors: Anchors
    regularizers: Regularizers
    means_in_scales: bool
    frozen: NDArray[np.bool_] | None = None
    relative: bool = False


class Engine(Protocol):
    """Parameters and optimiser state of a recovery, advanced one view at a time."""

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

        A view's target and mask are the same in all steps, so an engine may keep them.
        """

    def splats(self) -> Splats:
        """Return the current scene, with normalised quaternions."""

    def state(self) -> dict[str, NDArray[Any]]:
        """Return everything that a bitwise resume needs."""

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Restore a `state`."""

    @property
    def counts(self) -> NDArray[Any]:
        """Number of steps that each Gaussian has taken, (N,)."""

    @property
    def skipped(self) -> int:
        """Number of single-Gaussian steps skipped because a gradient was not finite."""
