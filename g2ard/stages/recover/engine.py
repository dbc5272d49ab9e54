"""Objective of the engines that run recovery's steps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Anchors, Regularizers

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
