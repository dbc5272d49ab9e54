"""The recovery loop: fixed topology, one view a step, anchors frozen at the start."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.errors import InputError
from g2ard.metrics import psnr
from g2ard.progress import Progress, silent
from g2ard.recover import checkpoint as checkpoints
from g2ard.recover.anchors import PRESETS, Anchors, Regularizers, drift95, needle
from g2ard.recover.draw import checked_weights, drawn
from g2ard.recover.schedule import TUNED, Rates, Schedule, multiplier_for
from g2ard.splats import Splats
from g2ard.targets import Targets, fingerprint_of

__all__ = ["RecoverConfig", "Recovered", "recover"]

_PROBE_VIEWS = 8
"""Views whose error tells how good the start is."""


@dataclass(frozen=True)
class RecoverConfig:
    """How recovery goes.

    Args:
        schedule: rates, horizon and decay.
        steps: overrides the schedule's horizon.
        time_limit: seconds; the horizon becomes what fits into them, so that the result depends on the
            machine's speed.
        regularizers: weights of L_anchor and L_shape (`tab:s_recovery`).
        sh_degree: of the result; None keeps the student's.
        ssim_weight: λ in (1−λ)·L1 + λ·(1−SSIM); 0.2 as 3DGS has it.
        background: RGB behind the scene.
        final: whether this is the recovery at the target count; the paper decays rounds differently.
        seed: of the order of views.
        engine: "fused" takes whole steps in Rust; "torch" goes through autograd and torch's Adam, with the
            same result to rounding but for Gaussians that a view does not touch.
    """

    schedule: Schedule = TUNED
    steps: int | None = None
    time_limit: float | None = None
    regularizers: Regularizers = PRESETS["trained"]
    sh_degree: int | None = None
    ssim_weight: float = 0.2
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    final: bool = True
    seed: int = 0
    engine: Literal["fused", "torch"] = "fused"

    @property
    def horizon(self) -> int:
        """Steps this recovery takes."""
        if self.steps is not None:
            return self.steps
        return self.schedule.steps if self.final else self.schedule.round_steps


@dataclass(frozen=True, eq=False)
class Recovered:
    """The recovered scene and what recovery did.

    Args:
        splats: same count and order as the student.
        report: steps, seconds, loss (one mean per 1 % of the horizon), psnr {before, after} over a sample of
            the training views, multiplier, drift95, needle, skipped.
    """

    splats: Splats
    report: dict[str, Any] = field(default_factory=dict)


class Engine(Protocol):
    """What takes steps: holds parameters and optimiser state."""

    def step(self, view: int, target: NDArray[np.float32], rates: Rates, *, regularize: bool) -> float: ...

    def splats(self) -> Splats: ...

    def state(self) -> dict[str, NDArray[Any]]: ...

    def load(self, state: dict[str, NDArray[Any]]) -> None: ...

    @property
    def skipped(self) -> int: ...


def recover(
    student: Splats,
    targets: Targets,
    config: RecoverConfig | None = None,
    *,
    weights: ArrayLike | None = None,
    anchors: Anchors | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
    stage: str = "recover",
) -> Recovered:
    """Optimise every attribute of a fixed set of Gaussians against targets (`eq:objective`).

    L = (1−λ)·L1 + λ·(1−SSIM), and every `period` steps + λ_a·L_anchor + λ_s·L_shape. No Gaussian is added
    or removed.

    Args:
        student: the scene to recover; its offset counts, cameras are in world coordinates.
        targets: photos or teacher renders with their cameras.
        config: see `RecoverConfig`.
        weights: (C,) how often each view is drawn, in proportion; None draws all equally often.
        anchors: frozen geometry; None freezes the student as given.
        checkpoint: a file written every minute and at Ctrl-C; if it is there, recovery goes on from it, and
            the result is bitwise that of never having stopped.
        progress: told of every step, with loss, PSNR of the step's view and steps/s.
        stage: the name progress is reported under.

    Returns:
        A `Recovered` with as many Gaussians as the student, in its order.

    Raises:
        InputError: no Gaussians, no views, weights that are none, or a checkpoint of another run.
        KeyboardInterrupt: after Ctrl-C, once the checkpoint is written.
    """
    config = config or RecoverConfig()
    if not len(student) or not len(targets.cameras):
        raise InputError(f"recover: {len(student)} Gaussians and {len(targets.cameras)} views: nothing to do")
    if config.sh_degree is not None:
        student = student.with_sh_degree(config.sh_degree)
    anchors = anchors or Anchors.of(student)
    before = _sample_error(student, targets, config)
    multiplier = config.schedule.multiplier
    if multiplier is None:
        multiplier = multiplier_for(10 ** (-before / 20))
    often = checked_weights(weights, len(targets.cameras))
    loop = _Loop(student, targets, config, often, anchors, multiplier)
    loop.run(checkpoint, progress, stage)
    result = loop.engine.splats()
    after = _sample_error(result, targets, config)
    return Recovered(
        result,
        {
            "steps": loop.done,
            "seconds": loop.seconds,
            "loss": loop.curve(),
            "psnr": {"before": before, "after": after},
            "multiplier": multiplier,
            "drift95": drift95(anchors, result.means),
            "needle": needle(result.scales),
            "skipped": {"non_finite": loop.engine.skipped},
        },
    )


class _Loop:
    """The steps of one recovery; what a resume must bring back lives in `engine`, `done` and `losses`."""

    def __init__(
        self,
        student: Splats,
        targets: Targets,
        config: RecoverConfig,
        weights: NDArray[np.float64] | None,
        anchors: Anchors,
        multiplier: float,
    ) -> None:
        self.targets = targets
        self.config = config
        self.weights = weights
        self.multiplier = multiplier
        self.engine: Engine = _engine_class(config.engine)(
            student,
            targets.cameras.recentred(student.offset),
            anchors=anchors,
            regularizers=config.regularizers,
            means_in_scales=config.schedule.means_in_scales,
            ssim_weight=config.ssim_weight,
            background=config.background,
        )
        self.done = 0
        self.seconds = 0.0
        self.losses: list[float] = []
        self.key = _fingerprint(student, targets, config, weights)

    def run(self, checkpoint: Path | None, progress: Progress, stage: str) -> None:
        if checkpoint is not None and checkpoint.exists():
            self._resume(checkpoint)
        earlier, began, saved = self.seconds, time.monotonic(), time.monotonic()
        with checkpoints.deferred_interrupt() as interrupted:
            while self._share() < 1:
                self._step()
                now = time.monotonic()
                self.seconds = earlier + now - began
                self._tell(progress, stage)
                if checkpoint is not None and (interrupted.is_set() or now - saved > checkpoints.PERIOD):
                    self._save(checkpoint)
                    saved = now
                if interrupted.is_set():
                    raise KeyboardInterrupt

    def _share(self) -> float:
        """How much of the horizon, of steps or of seconds, has been used."""
        if self.config.time_limit is not None:
            return self.seconds / self.config.time_limit
        return self.done / self.config.horizon

    def _step(self) -> None:
        config, step = self.config, self.done
        rates = config.schedule.at(self._share(), final=config.final, multiplier=self.multiplier)
        view = self._view(step)
        regularize = config.regularizers.active and (step + 1) % config.regularizers.period == 0
        self.losses.append(self.engine.step(view, self.targets[view], rates, regularize=regularize))
        self.done += 1

    def _tell(self, progress: Progress, stage: str) -> None:
        speed = self.done / max(self.seconds, 1e-9)
        recent = np.mean(self.losses[-20:])
        total = self.config.horizon
        if self.config.time_limit is not None:
            total = max(self.done, round(self.done / max(self._share(), 1e-9)))
        progress(stage, self.done, total, {"loss": f"{recent:.4f}", "steps/s": f"{speed:.1f}"})

    def curve(self) -> list[float]:
        """Up to 100 means of the loss over equal stretches of the horizon."""
        return [float(part.mean()) for part in np.array_split(np.array(self.losses), 100) if len(part)]

    def _view(self, step: int) -> int:
        """Views in a fresh random order each epoch; depends on seed, weights and step alone."""
        count = len(self.targets.cameras)
        epoch, position = divmod(step, count)
        return int(drawn(self.config.seed, epoch, count, self.weights)[position])

    def _save(self, path: Path) -> None:
        meta = {"done": self.done, "seconds": self.seconds, "multiplier": self.multiplier}
        checkpoints.save(path, self.key, meta, {**self.engine.state(), "losses": np.array(self.losses)})

    def _resume(self, path: Path) -> None:
        meta, arrays = checkpoints.load(path, self.key)
        self.losses = arrays.pop("losses").tolist()
        self.engine.load(arrays)
        self.done, self.seconds = int(meta["done"]), float(meta["seconds"])
        self.multiplier = float(meta["multiplier"])


def _engine_class(name: str) -> Any:
    if name == "fused":
        from g2ard.recover.fused_engine import FusedEngine

        return FusedEngine
    if name == "torch":
        from g2ard.recover.torch_engine import TorchEngine

        return TorchEngine
    raise InputError(f"engine: expected fused or torch, got {name!r}")


def _sample_error(splats: Splats, targets: Targets, config: RecoverConfig) -> float:
    """Mean PSNR over a few evenly spaced training views."""
    from g2ard.render import render

    count = len(targets.cameras)
    sample = np.unique(np.linspace(0, count - 1, min(count, _PROBE_VIEWS)).round().astype(int))
    scores = []
    for view in sample:
        image = render(splats, targets.cameras, int(view), background=config.background).image
        scores.append(psnr(np.clip(image, 0, 1), targets[int(view)]))
    return float(np.mean(scores))


def _fingerprint(
    student: Splats, targets: Targets, config: RecoverConfig, weights: NDArray[np.float64] | None
) -> str:
    often = [] if weights is None else [repr(weights.tolist())]
    parts = (repr(config), student.fingerprint(), fingerprint_of(targets), *often)
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
