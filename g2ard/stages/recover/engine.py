"""Objective of recovery's engines, and the engine in Rust or on a GPU, which runs whole steps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float32, Mask, Values
from g2ard.rendering.renderer import RasterSettings, arrays_of, view_of
from g2ard.scene.cameras import Cameras, within_frame
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.shape import NEEDLE_UNIT, longer_axes
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Anchors, Regularizers
from g2ard.stages.recover.config import Rates

_MEASURED_VIEWS = 8


def measure_radii(splats: Splats) -> Float32:
    """Return (N,) √(s₁·s₂) of the two longer scales s₁ ≥ s₂, with s₂ at least s₁/100: the unit of a mean's
    rate.

    With the largest scale as unit, needles would move by several widths.

    >>> measure_radii(Splats.create([[0, 0, 0]], scales=[[9.0, 1e-9, 4.0]])).tolist()
    [6.0]
    """
    middle, largest = longer_axes(splats.scales.astype(np.float64)).T
    middle = np.maximum(middle, NEEDLE_UNIT * largest)
    return np.ascontiguousarray(np.sqrt(middle * largest).astype(np.float32))


def measure_typical_share(splats: Splats, cameras: Cameras) -> float:
    """Return the median of f·s₁/z over Gaussians and a few views, as a share of the longer side.

    Views are evenly spaced, and occlusion is ignored. The share is 0 if no view shows a Gaussian.

    >>> from g2ard.scene.cameras import look_at
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1, 0.2, 0.01]])
    >>> views = Cameras.from_lists(
    ...     [look_at([0, -2, 0], [0, 0, 0])], [[[50, 0, 16], [0, 50, 12], [0, 0, 1]]], [(40, 24)], ["v"])
    >>> round(measure_typical_share(dot, views), 6)  # 50 · 0.2 / 2 = 5 pixels of 40
    0.125
    """
    cameras = cameras.recentred(splats.offset)
    largest = splats.scales.max(1, initial=0.0).astype(np.float64)
    view_shares = []
    for view in evenly_spaced(len(cameras), _MEASURED_VIEWS):
        pose = cameras.viewmats[view]
        K = cameras.Ks[view]
        size = np.array([cameras.widths[view], cameras.heights[view]], np.float64)
        at = (splats.means @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        front = at[:, 2] > 0
        depth = np.where(front, at[:, 2], 1.0)
        pixel = at[:, :2] / depth[:, None]
        inside = front & within_frame(*pixel.T, *size)
        focal = K[0, 0] / size.max()
        view_shares.append(largest[inside] / depth[inside] * focal)
    shares = np.concatenate(view_shares)
    if not len(shares):
        return 0.0
    return float(np.median(shares))


TYPICAL_LOSS = 0.02
"""Loss to which the gradients of views are scaled if they count alike."""

LEAST_LOSS = 0.005
"""Loss below which errors are invisible, about 40 dB."""


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
    frozen: Mask | None = None
    relative: bool = False


class FusedEngine:
    """Parameters and optimiser state of a recovery, advanced one view at a time.

    Equivalent to `TorchEngine` up to rounding, on the device in use (`system.devices`). Its state is the same
    on every device. After a `DeviceError` new engines run on the CPU.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        start = objective.start
        anchors = objective.anchors
        if objective.means_in_scales:
            units = measure_radii(start)
        else:
            units = None
        self._trainer = _core.Trainer(arrays_of(start), objective, units)
        self._skipped_before = 0
        self._anchors = (
            anchors.means,
            np.ascontiguousarray(anchors.frames),
            anchors.r_parallel,
            anchors.r_perp,
        )
        self._anchor()
        if objective.frozen is not None:
            self._trainer.freeze(objective.frozen)

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
        """Take one optimiser step on one view; return its photometric loss.

        A view's target and mask are the same in all `fixed` steps, so that the device may keep them.
        """
        objective = self._objective
        loss, _ = self._trainer.step(
            view_of(objective.cameras, view, objective.settings),
            target,
            rates,
            objective.regularizers if regularize else None,
            mask,
            TYPICAL_LOSS if objective.relative else None,
            view if fixed else None,
        )
        return loss

    def splats(self) -> Splats:
        """Return the current scene, with normalised quaternions."""
        means, quats, log_scales, logit_opacities, sh0, shN = self._trainer.arrays()
        length = np.linalg.norm(quats, axis=1, keepdims=True)
        quats = np.where(
            length > 0,
            quats / np.where(length > 0, length, 1),
            [1.0, 0.0, 0.0, 0.0],
        )
        return replace(
            self._objective.start,
            means=means,
            quats=quats.astype(np.float32),
            scales=np.exp(log_scales.astype(np.float64)).astype(np.float32),
            logit_opacities=logit_opacities,
            sh0=sh0,
            shN=shN,
        )

    def state(self) -> dict[str, Values | Callable[[], Values]]:
        """Return everything that a bitwise resume needs.

        Functions return the large arrays, so that a checkpoint holds one at a time.
        """
        rest = self._trainer.state("rest")
        large = {part: partial(self._export, part) for part in ("values", "first", "second")}
        return {**rest, **large, "skipped": np.array(self.skipped)}

    def _export(self, part: str) -> Values:
        return self._trainer.state(part)[part]

    def load(self, state: dict[str, Values]) -> None:
        """Restore a `state`, taking the trainer's arrays out of it to free their memory."""
        self._skipped_before = int(state["skipped"]) - self._trainer.skipped
        self._trainer.load(state)
        self._anchor()

    def _anchor(self) -> None:
        """Give the trainer the anchors, whose copy takes memory, if regularisers pull towards them."""
        if self._objective.regularizers.active:
            self._trainer.anchor(*self._anchors)

    @property
    def counts(self) -> Values:
        """Number of steps that each Gaussian has taken, (N,)."""
        return self._trainer.steps()

    @property
    def skipped(self) -> int:
        """Number of single-Gaussian steps skipped because a gradient was not finite."""
        return self._skipped_before + self._trainer.skipped
