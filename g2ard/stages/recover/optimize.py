"""The recovery loop: fixed topology, one view a step, anchors frozen at the start."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.splats import Splats
from g2ard.stages.recover import checkpoint as checkpoints
from g2ard.stages.recover.anchors import Anchors, drift95, needle
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.draw import checked_weights, drawn
from g2ard.stages.recover.guard import Guard
from g2ard.stages.recover.probe import MULTIPLIERS, Probe, calm, search_multiplier, trial_steps
from g2ard.stages.recover.report import (
    Gain,
    Geometry,
    Look,
    RecoverReport,
    Regularized,
    Trial,
    Validation,
)
from g2ard.stages.recover.schedule import Rates, multiplier_for, reach_for
from g2ard.stages.recover.sizes import typical_share
from g2ard.targets import Targets, fingerprint_of, mask_of

__all__ = ["Recovered", "Watch", "recover"]

_TRIAL_STEPS = 20
_TRIAL_SHARE, _CALM_SHARE = 0.1, 0.3
"""Under a time limit: steps of a trial, and the share of the limit that all trials may take; the second where
rates that are too large would spend it on nothing."""

_SHORT = 20
"""Steps under which there is no way back: none would be left to go on with."""

_LOG_POINTS = 10
"""How often Drift95 and Needle are logged over a recovery."""

Watch = Callable[[int, float, Callable[[], Splats]], None]
"""Called after every step with its number, the seconds so far and what gives the scene as it stands."""


@dataclass(frozen=True, eq=False)
class Recovered:
    """The recovered scene and what recovery did.

    Args:
        splats: same count and order as the student.
        report: what was done, in numbers.
    """

    splats: Splats
    report: RecoverReport


class Engine(Protocol):
    """What takes steps: holds parameters and optimiser state."""

    def step(
        self,
        view: int,
        target: NDArray[np.float32],
        rates: Rates,
        *,
        regularize: bool,
        mask: NDArray[np.bool_] | None = None,
    ) -> float: ...

    def splats(self) -> Splats: ...

    def state(self) -> dict[str, NDArray[Any]]: ...

    def load(self, state: dict[str, NDArray[Any]]) -> None: ...

    @property
    def counts(self) -> NDArray[Any]: ...

    @property
    def skipped(self) -> int: ...


def recover(
    student: Splats,
    targets: Targets,
    config: RecoverConfig | None = None,
    *,
    weights: ArrayLike | None = None,
    anchors: Anchors | None = None,
    validation: Targets | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
    stage: str = "recover",
    watch: Watch | None = None,
) -> Recovered:
    """Optimise every attribute of a fixed set of Gaussians against targets (`eq:objective`).

    L = (1−λ)·L1 + λ·(1−SSIM), and every `period` steps + λ_a·L_anchor + λ_s·L_shape. No Gaussian is added
    or removed. Where the steps lose against the student, by PSNR of some training views, recovery goes back,
    and on with a third of the rates; a student that is only made worse is returned as it is.
    A schedule that is not `guarded`, as the paper's, takes all its steps, whatever comes of them.

    Args:
        student: the scene to recover; its offset counts, cameras are in world coordinates.
        targets: photos or teacher renders with their cameras.
        config: see `RecoverConfig`.
        weights: (C,) how often each view is drawn, in proportion; None draws all equally often.
        anchors: frozen geometry; None freezes the student as given. A student that has been recovered before
            wants those of its construction.
        validation: a few views of another kind than `targets` (nearer, or from where people stand), never
            learned from: where they lose, they decide how much of what the steps changed stays, Gaussian by
            Gaussian as it was seen (`recover.guard`), and end a recovery that they only lose by. At
            most eight are looked at.
        checkpoint: a file written every minute and at Ctrl-C; if it is there, recovery goes on from it, and
            the result is bitwise that of never having stopped.
        progress: told of every step, with loss, PSNR of a few training views and steps/s.
        stage: the name progress is reported under.
        watch: called after every step; the time it takes does not count.

    Returns:
        A `Recovered` with as many Gaussians as the student, in its order.

    Raises:
        InputError: no Gaussians, no views, weights that are none, or a checkpoint of another run.
        KeyboardInterrupt: after Ctrl-C, once the checkpoint is written.
    """
    config = config or RecoverConfig()
    if not len(student) or not len(targets.cameras):
        raise InputError(f"recover: {len(student)} Gaussians and {len(targets.cameras)} views: nothing to do")
    if not targets.cameras.facing(student.means.astype(np.float64) + student.offset).any():
        raise InputError(f"recover: none of the {len(targets.cameras)} views sees the scene")
    if config.sh_degree is not None:
        student = student.with_sh_degree(config.sh_degree)
    anchors = anchors or Anchors.of(student, config.regularizers.in_plane)
    validation = validation if config.schedule.guarded else None
    probe = Probe(targets, config.background)
    before = probe.all_of(student)
    often = checked_weights(weights, len(targets.cameras))
    others = None if validation is None else Probe(validation, config.background).all_of
    guard = Guard(probe.all_of, student, before, others, config.schedule.guarded)
    held = None if validation is None else fingerprint_of(validation)
    loop = _Loop(student, targets, config, often, anchors, probe, guard, held)
    if checkpoint is None or not checkpoint.exists():
        loop.choose_rates(before)
    loop.run(checkpoint, progress, stage, watch)
    end = loop.engine.splats()
    result, after, way = guard.judge(end)
    doubt: float | None = 0.0
    if result is end and validation is not None:
        result, doubt = guard.settle(end, loop.views_seen, loop.done)
        after, way = (after, way) if result is end else (probe.all_of(result), float(result is not student))
    return Recovered(
        result,
        RecoverReport(
            steps=loop.done,
            seconds=loop.seconds,
            loss=loop.curve(),
            psnr=Gain(before, after),
            multiplier=loop.multiplier,
            reach=_finite(loop.reach),
            extent=targets.cameras.extent,
            trials=tuple(map(Trial.of, loop.trials)),
            drift95=drift95(anchors, result.means),
            needle=needle(result.scales),
            geometry=tuple(map(Geometry.of, loop.geometry)),
            regularizers=Regularized.of(loop.regularizers),
            backed_off=tuple(map(Look.of, loop.guard.backed_off)),
            stopped=loop.guard.stopped,
            way=way,
            kept_start=way == 0,
            validation=None
            if validation is None
            else Validation(tuple(map(Look.of, guard.validation)), None if doubt is None else _finite(doubt)),
            skipped={"non_finite": loop.skipped},
        ),
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
        probe: Probe,
        guard: Guard,
        held: str | None,
    ) -> None:
        self.targets = targets
        self.config = config
        self.schedule = config.schedule.within(targets.cameras.extent)
        self.weights = weights
        self.anchors = anchors
        self.multiplier = 1.0
        self.reach = math.inf
        self.trials: list[dict[str, float]] = []
        self.student = student
        self.probe = probe
        self.guard = guard
        self._skipped = 0  # by engines before this one
        self.done = 0
        self.seconds = 0.0
        self.losses: list[float] = []
        self.geometry: list[dict[str, float]] = []
        self._seconds_of = {False: [0, 0.0], True: [0, 0.0]}  # regularised? → steps, seconds
        self.key = _fingerprint(student, targets, config, weights, anchors, held)

    @cached_property
    def engine(self) -> Engine:
        """Made when first needed: trials need theirs before, and two at once would double the memory."""
        return self._new_engine()

    @property
    def skipped(self) -> int:
        """Steps of single Gaussians left out because a gradient was not finite."""
        return self._skipped + self.engine.skipped

    @property
    def views_seen(self) -> NDArray[np.float64]:
        """(N,) how many of the views have touched each Gaussian, from the steps it has taken."""
        steps = self.done - (int(self.guard.backed_off[-1]["step"]) if self.guard.backed_off else 0)
        return self.engine.counts * (len(self.targets.cameras) / max(1, steps))

    def _new_engine(self, start: Splats | None = None) -> Engine:
        config, student = self.config, self.student if start is None else start
        engine: Engine = _engine_class(config.engine)(
            student,
            self.targets.cameras.recentred(student.offset),
            anchors=self.anchors,
            regularizers=config.regularizers,
            means_in_scales=config.schedule.means_in_scales,
            ssim_weight=config.ssim_weight,
            background=config.background,
        )
        return engine

    def choose_rates(self, start: float) -> None:
        """The schedule's reach and multiplier, or what the start suggests, and short trials like best.

        The time of the trials counts.

        Args:
            start: PSNR before recovery: where the search begins, and all there is for short horizons.
        """
        rmse = 10 ** (-start / 20)
        typical = typical_share(self.student, self.targets.cameras)
        reach = self.config.schedule.reach
        self.reach = reach_for(rmse, typical) if reach is None else reach
        if self.config.schedule.multiplier is not None:
            self.multiplier = self.config.schedule.multiplier
            return
        guess = multiplier_for(rmse)
        limit = self.config.time_limit
        steps = trial_steps(self.config.horizon) if limit is None else _TRIAL_STEPS
        self.multiplier = guess
        if not steps:
            return
        began, share = time.monotonic(), _TRIAL_SHARE
        seen: dict[float, float] = {}

        def score(multiplier: float) -> float:
            engine = self._new_engine()
            for step in range(steps):
                if limit is not None and time.monotonic() - began > share * limit:
                    raise TimeoutError
                self._learn(engine, step, step / steps, multiplier)
            seen[multiplier] = self.probe.all_of(engine.splats())
            return seen[multiplier]

        nearly_there = guess <= min(MULTIPLIERS)
        try:
            self.multiplier, _ = search_multiplier(score, guess, start)
            tight = reach_for(0.0, typical)
            if seen[self.multiplier] < start and self.config.schedule.reach is None and tight < self.reach:
                self.reach = tight  # not as untrained as it looked
                seen.clear()
                self.multiplier, _ = search_multiplier(score, guess, start)
            if seen[self.multiplier] < start:  # a few steps on photos that are nearly met say nothing
                self.multiplier, share = guess, _CALM_SHARE
                if nearly_there:
                    self.multiplier, _ = calm(score, min(MULTIPLIERS), seen, start)
        except TimeoutError:  # the best of what was seen, or calmer than all of it
            best = max(seen, key=lambda m: seen[m], default=guess)
            if seen.get(best, -math.inf) >= start:
                self.multiplier = best
            elif nearly_there:
                self.multiplier = min(best / 3, multiplier_for(rmse, 0.01))
        self.trials = [{"multiplier": m, "psnr": value} for m, value in sorted(seen.items())]
        self.seconds = time.monotonic() - began

    def _learn(
        self, engine: Engine, step: int, share: float, multiplier: float, *, regularize: bool = False
    ) -> float:
        rates = self.schedule.at(share, final=self.config.final, multiplier=multiplier, reach=self.reach)
        view = self._view(step)
        target, mask = self.targets[view], mask_of(self.targets, view)
        return engine.step(view, target, rates, regularize=regularize, mask=mask)

    def run(self, checkpoint: Path | None, progress: Progress, stage: str, watch: Watch | None) -> None:
        if checkpoint is not None and checkpoint.exists():
            self._resume(checkpoint)
        earlier, began, saved = self.seconds, time.monotonic(), time.monotonic()
        with checkpoints.deferred_interrupt() as interrupted:
            while self._share() < 1 and self.guard.stopped is None:
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
        regularize = config.regularizers.active and (step + 1) % config.regularizers.period == 0
        began = time.monotonic()
        loss = self._learn(self.engine, step, self._share(), self.multiplier, regularize=regularize)
        self.losses.append(loss)
        tally = self._seconds_of[regularize]
        tally[0] += 1
        tally[1] += time.monotonic() - began
        self.done += 1

    def _look(self) -> None:
        """Where too much is lost to come back, go on from the best scene with a third of the rates."""
        share = self._share()
        short = self.config.time_limit is None and self.config.horizon < _SHORT
        if short or not self.guard.due(share):
            return
        if self.guard.look(self.engine.splats(), share, self.done) == "back":
            self.multiplier /= 3
            self._skipped += self.engine.skipped
            del self.engine  # two at once would double the memory
            self.engine = self._new_engine(self.guard.best)

    def _log(self) -> None:
        """Drift95 and Needle at every tenth of the horizon."""
        if len(self.geometry) < int(min(1.0, self._share()) * _LOG_POINTS):
            scene = self.engine.splats()
            figures = {"drift95": drift95(self.anchors, scene.means), "needle": needle(scene.scales)}
            self.geometry.append({"step": self.done, **figures})

    @property
    def regularizers(self) -> dict[str, float]:
        """How many steps were regularised, which share of the time that cost above plain steps, and their
        period, 0 where none has weight."""
        (plain, plain_s), (held, held_s) = self._seconds_of[False], self._seconds_of[True]
        extra = held_s - held * plain_s / plain if plain and held else 0.0
        weights = self.config.regularizers
        return {
            "steps": held,
            "share": max(0.0, extra) / max(plain_s + held_s, 1e-9),
            "period": weights.period if weights.active else 0,
        }

    def _tell(self, progress: Progress, stage: str) -> None:
        speed = self.done / max(self.seconds, 1e-9)
        recent = np.mean(self.losses[-20:])
        total = self.config.horizon
        if self.config.time_limit is not None:
            total = max(self.done, round(self.done / max(self._share(), 1e-9)))
        shown, at = self.probe.latest(self.engine.splats, self.done, self.seconds)
        figures = {"loss": f"{recent:.4f}", "PSNR": f"{shown:.2f} @{at}", "steps/s": f"{speed:.1f}"}
        progress(stage, self.done, total, figures)

    def curve(self) -> list[float]:
        """Up to 100 means of the loss over equal stretches of the horizon."""
        return [float(part.mean()) for part in np.array_split(np.array(self.losses), 100) if len(part)]

    def _view(self, step: int) -> int:
        """Views in a fresh random order each epoch; depends on seed, weights and step alone."""
        count = len(self.targets.cameras)
        epoch, position = divmod(step, count)
        return int(drawn(self.config.seed, epoch, count, self.weights)[position])

    def _save(self, path: Path) -> None:
        meta = {
            "done": self.done,
            "seconds": self.seconds,
            "multiplier": self.multiplier,
            "reach": _finite(self.reach),
            "trials": self.trials,
            "geometry": self.geometry,
            "seconds_of": [self._seconds_of[False], self._seconds_of[True]],
            "skipped": self._skipped,
            "guard": self.guard.meta(),
        }
        arrays = {**self.engine.state(), "losses": np.array(self.losses), **self.guard.arrays()}
        checkpoints.save(path, self.key, meta, arrays)

    def _resume(self, path: Path) -> None:
        meta, arrays = checkpoints.load(path, self.key)
        self.losses = arrays.pop("losses").tolist()
        self.guard.load(meta["guard"], arrays)
        self._skipped = int(meta["skipped"])
        self.engine.load(arrays)
        self.done, self.seconds = int(meta["done"]), float(meta["seconds"])
        self.multiplier = float(meta["multiplier"])
        self.reach = math.inf if meta["reach"] is None else float(meta["reach"])
        self.trials, self.geometry = list(meta["trials"]), list(meta["geometry"])
        self._seconds_of = dict(zip((False, True), meta["seconds_of"], strict=True))


def _finite(reach: float) -> float | None:
    """JSON knows no infinity."""
    return None if math.isinf(reach) else reach


def _engine_class(name: str) -> Any:
    if name == "fused":
        from g2ard.stages.recover.fused_engine import FusedEngine

        return FusedEngine
    if name == "torch":
        from g2ard.stages.recover.torch_engine import TorchEngine

        return TorchEngine
    if name == "gsplat":
        from g2ard.stages.recover.gsplat_engine import GsplatEngine

        return GsplatEngine
    raise InputError(f"engine: expected fused, torch or gsplat, got {name!r}")


def _fingerprint(
    student: Splats,
    targets: Targets,
    config: RecoverConfig,
    weights: NDArray[np.float64] | None,
    anchors: Anchors,
    validation: str | None,
) -> str:
    often = [] if weights is None else [repr(weights.tolist())]
    parts = (repr(config), student.fingerprint(), fingerprint_of(targets), *often)
    parts = parts if validation is None else (*parts, validation)
    digest = hashlib.sha256("\n".join(parts).encode())
    for held in (anchors.means, anchors.frames, anchors.r_parallel, anchors.r_perp):
        digest.update(np.ascontiguousarray(held).tobytes())
    return digest.hexdigest()
