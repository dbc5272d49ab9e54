"""Steps of one recovery, the choice of rates before them, and checkpoints."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

import g2ard.stages.recover.checkpoint as checkpoints
from g2ard.arrays import Float, Int, Mask
from g2ard.errors import DeviceError, InputError, require, require_torch
from g2ard.progress import Progress, silent
from g2ard.rendering.exposure import exposures_of, unexposed
from g2ard.rendering.renderer import settings_for
from g2ard.rendering.targets import RENDERS, Targets, fingerprint_of, kinds_of, mask_of
from g2ard.scene.shape import needle_share
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import Anchors, drift95
from g2ard.stages.recover.config import RecoverConfig, choose_reach, guess_multiplier
from g2ard.stages.recover.engine import FusedEngine, Objective, measure_typical_share
from g2ard.stages.recover.guard import Guard
from g2ard.stages.recover.probe import Probe
from g2ard.stages.recover.report import Regularized
from g2ard.stages.recover.trials import MULTIPLIERS, Trials, count_trial_steps
from g2ard.system.cached import cached_property
from g2ard.system.keys import UNKEYED, key_of, keyed

if TYPE_CHECKING:
    from g2ard.stages.recover.torch_engine import TorchEngine

    Engine = FusedEngine | TorchEngine


_SHORTEST_WITH_GUARD = 20
"""Fewest steps for going back to an earlier scene; shorter recoveries have no steps left to repeat."""

_UNSEEN_UNTIL = 0.5
"""Share of the horizon before which exposures are estimated only if each photo can have been trained on."""

_LOG_POINTS = 10
"""Number of log entries of Drift95 and Needle per recovery."""

Watch = Callable[[int, float, Callable[[], Splats]], None]
"""Callback after every step: its number, the seconds so far, and a function that returns the current scene.
"""

_CHECKPOINT_FIELDS = (
    "done",
    "seconds",
    "multiplier",
    "reach",
    "trials",
    "geometry",
    "skipped_before",
    "tally",
    "limit",
)
"""Attributes of `Loop` that a checkpoint stores, besides the losses, the engine and the guard."""


@dataclass(eq=False)
class Loop:
    """Steps of one recovery.

    Args:
        validation_key: fingerprint of the validation views, for `key`.
        resumed: the part of `seconds` before this call.
        tally: number of steps and their seconds, without and with regularisers.
        exposures: of the photos, (C, 3, 2); None while they agree, see `exposures_of`.
        limit: time limit in seconds, the config's until `time_left` sets it; None without one.
    """

    student: Splats
    targets: Targets
    config: RecoverConfig
    weights: Float | None
    anchors: Anchors
    probe: Probe = field(metadata=UNKEYED)
    guard: Guard = field(metadata=UNKEYED)
    validation_key: str | None
    frozen: Mask | None
    time_left: Callable[[], float] | None = field(default=None, metadata=UNKEYED)
    limit: float | None = field(default=None, metadata=UNKEYED)
    multiplier: float = field(default=1.0, metadata=UNKEYED)
    reach: float = field(default=math.inf, metadata=UNKEYED)
    trials: list[dict[str, float]] = field(default_factory=list, metadata=UNKEYED)
    done: int = field(default=0, metadata=UNKEYED)
    seconds: float = field(default=0.0, metadata=UNKEYED)
    resumed: float | None = field(default=None, metadata=UNKEYED)
    losses: list[float] = field(default_factory=list, metadata=UNKEYED)
    geometry: list[dict[str, float]] = field(default_factory=list, metadata=UNKEYED)
    skipped_before: int = field(default=0, metadata=UNKEYED)
    tally: list[list[float]] = field(default_factory=lambda: [[0, 0.0], [0, 0.0]], metadata=UNKEYED)
    exposures: Float | None = field(default=None, metadata=UNKEYED)
    _epoch: tuple[int, Int] | None = field(default=None, metadata=UNKEYED)

    def __post_init__(self) -> None:
        self.schedule = self.config.schedule.within(self.targets.cameras.extent)
        self.limit = self.config.recovery_time

    @cached_property
    def key(self) -> str:
        """Fingerprint of inputs and contents that a checkpoint must have; computed only with one."""
        inputs = keyed(self) | {"targets": fingerprint_of(self.targets)}
        return key_of([_CHECKPOINT_FIELDS, inputs])

    @cached_property
    def engine(self) -> Engine:
        """Engine, created on first use; another one beside those of trials would double the memory."""
        return self._new_engine()

    @property
    def skipped(self) -> int:
        """Number of single-Gaussian steps skipped because a gradient was not finite."""
        built: Engine | None = vars(self).get("engine")
        return self.skipped_before + (0 if built is None else built.skipped)

    def _drop_engine(self) -> None:
        """Free the engine, the largest part of a recovery's memory."""
        self.skipped_before = self.skipped
        del self.engine

    def _new_engine(self, start: Splats | None = None) -> Engine:
        """Create an engine that begins at `start`, by default at the student."""
        config = self.config
        if start is None:
            student = self.student
        else:
            student = start
        objective = Objective(
            settings=settings_for(self.anchors.means, antialiased=student.antialiased),
            background=config.background,
            ssim_weight=config.ssim_weight,
            start=student,
            cameras=self.targets.cameras.recentred(student.offset),
            anchors=self.anchors,
            regularizers=config.regularizers,
            means_in_scales=config.schedule.means_in_scales,
            frozen=self.frozen,
            relative=len(self.targets.cameras.usual()) < len(self.targets.cameras),
        )
        engine_class = _import_engine(config.engine)
        try:
            return engine_class(objective)
        except DeviceError:  # from now on it is the CPU's
            return engine_class(objective)

    def choose_rates(self, start: float) -> None:
        """Choose reach and multiplier: the schedule's, or from the initial error and short trials.

        The time of the trials counts. `start` is the PSNR before recovery. It alone decides for short
        horizons, and for renders that are not nearly fitted.
        """
        schedule = self.config.schedule
        limit = self.config.recovery_time
        rmse = 10 ** (-start / 20)
        typical = measure_typical_share(self.student, self.targets.cameras)
        if schedule.reach is None:
            self.reach = choose_reach(rmse, typical)
        else:
            self.reach = schedule.reach
        if schedule.multiplier is not None:
            self.multiplier = schedule.multiplier
            return
        self.multiplier = guess_multiplier(rmse)
        if (
            kinds_of(self.targets) == RENDERS
            and limit is None
            and self.multiplier > min(MULTIPLIERS)
        ):
            return
        if steps := count_trial_steps(self.config.horizon, limit):
            if schedule.reach is None:
                tight = choose_reach(0.0, typical)
            else:
                tight = self.reach
            with checkpoints.defer_interrupt() as interrupted:
                trials = Trials(partial(self._trial, steps, interrupted), start, limit)
                self._choose_by_trials(trials, rmse, tight)
            self.trials = [
                {"multiplier": m, "psnr": value} for m, value in sorted(trials.scores.items())
            ]
            self.seconds = trials.seconds

    def _choose_by_trials(self, trials: Trials, rmse: float, tight: float) -> None:
        """Choose the multiplier, and the reach `tight` if all trials lose quality with the present one."""
        guess = self.multiplier
        nearly_fitted = guess <= min(MULTIPLIERS)
        try:
            self.multiplier = trials.search(guess)
            if trials.worsens(self.multiplier) and tight < self.reach:
                self.reach = tight  # better trained than its error suggested
                self.multiplier = trials.search(guess)
            if trials.worsens(self.multiplier):  # on nearly fitted photos a few steps say nothing
                if nearly_fitted:
                    self.multiplier = trials.calm()
                else:
                    self.multiplier = min(guess, self.multiplier)
        except TimeoutError:  # take the best multiplier tried, or a calmer one
            best = trials.best(guess)
            if trials.scores.get(best, -math.inf) >= trials.start:
                self.multiplier = best
            elif nearly_fitted:
                self.multiplier = min(best / 3, guess_multiplier(rmse, 0.01))

    def _trial(
        self,
        steps: int,
        interrupted: Event,
        multiplier: float,
        end: float,
    ) -> float:
        """Return the PSNR after a few steps from the start; raise TimeoutError at `end` (monotonic)."""
        engine = self._new_engine()
        try:
            for step in range(steps):
                if interrupted.is_set():
                    raise KeyboardInterrupt
                if time.monotonic() > end:
                    raise TimeoutError
                self._learn(engine, step, step / steps, multiplier)
            return self.probe.score(engine.splats())
        except DeviceError:
            return self._trial(steps, interrupted, multiplier, end)

    def _learn(
        self,
        engine: Engine,
        step: int,
        share: float,
        multiplier: float,
        *,
        regularize: bool = False,
    ) -> float:
        """Advance an engine by the view of this step, with the rates at this share of the horizon."""
        rates = self.schedule.at(
            share, final=self.config.final, multiplier=multiplier, reach=self.reach
        )
        view = self._view(step)
        if self.exposures is None:
            target = self.targets[view]
            mask = mask_of(self.targets, view)
        else:
            target, mask = unexposed(
                self.targets, view, self.exposures[view], self.config.background
            )
        fixed = self.exposures is None
        return engine.step(
            view,
            target,
            rates,
            regularize=regularize,
            mask=mask,
            fixed=fixed,
        )

    def run(
        self, checkpoint: Path | None, progress: Progress, stage: str, watch: Watch | None
    ) -> tuple[Splats, Float | None]:
        """Take all steps, after those of a checkpoint if it exists.

        Return the scene, and with validation views the (N,) number of views that each Gaussian was seen in,
        estimated from its steps.

        If a GPU fails, the CPU continues from the last checkpoint, or from the start.
        """
        if checkpoint is not None and checkpoint.exists():
            self._resume(checkpoint)
        elif self.time_left is not None:
            self.limit = self.seconds + self.time_left()  # trials have taken the first
        start = copy.deepcopy(self._meta())
        while True:
            try:
                self._run(checkpoint, progress, stage, watch)
                if self.validation_key is None:
                    seen = None
                else:
                    seen = self._estimate_seen()
                end = self.engine.splats()
                self._drop_engine()
                return end, seen
            except DeviceError:  # `system.devices.notes` has the reason
                del self.engine
                seconds = self.seconds
                resumed = self.resumed
                if checkpoint is not None and checkpoint.exists():
                    self._resume(checkpoint)
                else:
                    self._restore(copy.deepcopy(start), {"losses": np.zeros(0)})
                self.seconds = seconds
                self.resumed = resumed

    def _estimate_seen(self) -> Float:
        """Estimate the (N,) number of views that each Gaussian was seen in from its steps."""
        backed_off = self.guard.backed_off
        if backed_off:
            first = int(backed_off[-1]["step"])
        else:
            first = 0
        return self.engine.counts * (len(self.targets.cameras) / max(1, self.done - first))

    def _run(
        self, checkpoint: Path | None, progress: Progress, stage: str, watch: Watch | None
    ) -> None:
        """Take the remaining steps."""
        earlier = self.seconds
        began = time.monotonic()
        saved = time.monotonic()
        with checkpoints.defer_interrupt() as interrupted:
            while self._measure_share() < 1 and self.guard.stopped is None:
                self._step()
                self._look()
                now = time.monotonic()
                self.seconds = earlier + now - began
                self._log()
                if progress is not silent:
                    self._tell(progress, stage)
                if watch is not None:
                    paused = time.monotonic()
                    watch(self.done, self.seconds, self.engine.splats)
                    began += time.monotonic() - paused
                if checkpoint is not None and (
                    interrupted.is_set() or now - saved > checkpoints.PERIOD
                ):
                    self._save(checkpoint)
                    saved = now
                if interrupted.is_set():
                    raise KeyboardInterrupt

    def _measure_share(self) -> float:
        """Return the used share of the steps or of the time limit."""
        if self.limit is not None:
            return self.seconds / self.limit
        return self.done / self.config.horizon

    def _step(self) -> None:
        config = self.config
        step = self.done
        regularize = config.regularizers.active and (step + 1) % config.regularizers.period == 0
        began = time.monotonic()
        loss = self._learn(
            self.engine, step, self._measure_share(), self.multiplier, regularize=regularize
        )
        self.losses.append(loss)
        tally = self.tally[regularize]
        tally[0] += 1
        tally[1] += time.monotonic() - began
        self.done += 1

    def _look(self) -> None:
        """After too large a loss, continue from the best scene with a third of the rates; `run` ends when
        `guard.stopped` is set."""
        share = self._measure_share()
        short = self.config.recovery_time is None and self.config.horizon < _SHORTEST_WITH_GUARD
        if short or not self.guard.is_due(share):
            return
        scene = self.engine.splats()
        self._look_at_exposures(scene, share)
        if self.guard.look(scene, share, self.done) == "back":
            self.multiplier /= 3
            self._drop_engine()  # two engines at once would double the memory
            self.engine = self._new_engine(self.guard.best)

    def _look_at_exposures(self, scene: Splats, share: float) -> None:
        """Estimate the exposures of photos, if they are known to differ or turn out to."""
        decided = self.exposures is not None
        if not decided and self.done < len(self.targets.cameras) and share < _UNSEEN_UNTIL:
            return
        found = exposures_of(scene, self.targets, self.config.background, decided=decided)
        if found is not None and not decided:
            self._score_exposed()
            self.guard.rescore()
        self.exposures = found

    def _score_exposed(self) -> None:
        self.probe.fit_exposures()
        self.guard.before = self.probe.score(self.guard.start)

    def _log(self) -> None:
        """Log Drift95 and Needle at every tenth of the recovery."""
        if len(self.geometry) < int(min(1.0, self._measure_share()) * _LOG_POINTS):
            scene = self.engine.splats()
            figures = {
                "drift95": drift95(self.anchors, scene.means),
                "needle": needle_share(scene.scales),
            }
            self.geometry.append({"step": self.done, **figures})

    @property
    def regularizers(self) -> Regularized:
        """Steps and cost of the regularisers."""
        (plain, plain_seconds), (regularized, regularized_seconds) = self.tally
        if plain and regularized:
            extra = regularized_seconds - regularized * plain_seconds / plain
        else:
            extra = 0.0
        share = max(0.0, extra) / max(plain_seconds + regularized_seconds, 1e-9)
        weights = self.config.regularizers
        return Regularized(int(regularized), share, weights.period if weights.active else 0)

    def _tell(self, progress: Progress, stage: str) -> None:
        speed = self.done / max(self.seconds, 1e-9)
        recent = np.mean(self.losses[-20:])
        total = self.config.horizon
        if self.config.recovery_time is not None:
            share = max(self._measure_share(), 1e-9)
            total = max(self.done, round(self.done / share))
        figures = {"loss": f"{recent:.4f}", "steps/s": f"{speed:.1f}"}
        if self.done < total:  # the report has the result's
            shown, at = self.probe.score_latest(self.engine.splats, self.done, self.seconds)
            figures["PSNR"] = f"{shown:.2f} dB (last measured at step {at:,})"
        progress(stage, self.done, total, figures)

    def curve(self) -> list[float]:
        """Return up to 100 means of the loss over equal parts of the recovery."""
        return [
            float(part.mean()) for part in np.array_split(np.array(self.losses), 100) if len(part)
        ]

    def _view(self, step: int) -> int:
        """Return the view of a step; each epoch has a new random order, see `draw_views`."""
        count = len(self.targets.cameras)
        epoch, position = divmod(step, count)
        if self._epoch is None or self._epoch[0] != epoch:
            self._epoch = epoch, draw_views(self.config.seed, epoch, count, self.weights)
        return int(self._epoch[1][position])

    def _meta(self) -> dict[str, Any]:
        """Return everything that a checkpoint stores besides arrays."""
        return {name: getattr(self, name) for name in _CHECKPOINT_FIELDS} | {
            "guard": self.guard.meta()
        }

    def _save(self, path: Path) -> None:
        arrays = {**self.engine.state(), "losses": np.array(self.losses), **self.guard.arrays()}
        if self.exposures is not None:
            arrays["exposures"] = self.exposures
        checkpoints.save(path, self.key, self._meta(), arrays)

    def _resume(self, path: Path) -> None:
        meta, arrays = checkpoints.load(path, self.key)
        self._restore(meta, arrays)
        self.engine.load(arrays)
        self.resumed = self.seconds

    def _restore(self, meta: dict[str, Any], arrays: dict[str, Any]) -> None:
        """Restore all but the engine, whose arrays remain in `arrays`."""
        self.losses = arrays.pop("losses").tolist()
        self.guard.load(meta["guard"], arrays)
        self.exposures = arrays.pop("exposures", None)
        if self.exposures is not None:
            self._score_exposed()
        for name in _CHECKPOINT_FIELDS:
            setattr(self, name, meta[name])


def write_finite(reach: float) -> float | None:
    """Return `reach`, or None for infinity, which JSON lacks."""
    return None if math.isinf(reach) else reach


def _import_engine(name: str) -> type[Engine]:
    """Return the engine class of a name in `RecoverConfig.engine`, importing its packages on demand."""
    if name == "fused":
        return FusedEngine
    require_torch("engine 'torch'")
    from g2ard.stages.recover.torch_engine import TorchEngine

    return TorchEngine


def check_weights(weights: ArrayLike | None, count: int) -> Float | None:
    """Check the weights of `count` views and return them with mean 1; None stays None.

    Raises:
        InputError: another length, or values that are negative, not finite, or all zero.
    """
    if weights is None:
        return None
    values = np.asarray(weights, np.float64)
    require(
        "weights",
        f"shape {values.shape}",
        values.shape == (count,),
        f"{count} weights, one per view",
    )
    bad = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
    if len(bad):
        raise InputError(
            f"view {bad[0]}: {values[bad[0]]} is not a number ≥ 0", parameter="weights"
        )
    if not values.any():
        raise InputError("all are zero, so no view can be drawn", parameter="weights")
    values = values / values.max()  # their sum must not overflow
    return values / values.mean()


def draw_views(seed: int, epoch: int, count: int, weights: Float | None = None) -> Int:
    """Return the `count` views of an epoch, in a random order that depends only on the arguments.

    Without weights, every view appears once. With (count,) weights w from `check_weights`, view v appears
    ⌊w_v⌋ or ⌈w_v⌉ times, w_v on average (systematic sampling). This is far less noisy than independent draws,
    and equal weights change no bit.

    >>> import numpy as np
    >>> np.bincount(draw_views(0, 0, 4, np.array([2.0, 1.0, 1.0, 0.0]))).tolist()
    [2, 1, 1]
    """
    views = np.arange(count)
    if weights is not None:
        ends = np.cumsum(weights)
        ticks = (views + np.random.default_rng((seed, epoch, 1)).random()) * (ends[-1] / count)
        views = np.minimum(np.searchsorted(ends, ticks, side="right"), np.flatnonzero(weights)[-1])
    return np.random.default_rng((seed, epoch)).permutation(views)
