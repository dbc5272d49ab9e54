"""The whole pipeline: select, simplify, freeze anchors and recover, in rounds."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard.config.checks import checks_arguments
from g2ard.io.types import ViewSet
from g2ard.pipeline.config import DistillConfig, SelectConfig
from g2ard.pipeline.steps import Steps
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.targets import Photos, PhotosOrRenders, Subset, Targets, checked_targets, fill
from g2ard.rendering.visibility import visibility_source
from g2ard.report.run import DistillReport, RoundReport, StageSeconds, ViewsReport
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.draw import checked_weights
from g2ard.stages.recover.optimize import Watch
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.select import SurfaceOptions, select
from g2ard.stages.simplify import simplify
from g2ard.stages.simplify.report import SimplifyReport


@dataclass(frozen=True, eq=False)
class RunViews:
    """Views of a run.

    Args:
        train: views for training, of the usual and other kinds.
        test: usual views for scoring.
        apart: views of other kinds; None if there are none.
        pool: the whole generated pool, written beside the result.
        full: the usual views for scoring at their own size, if a requested size shrank them.
        unseen: share of the sampled matter that no view of the pool sees.
    """

    train: ViewSet
    test: Cameras
    apart: Cameras | None = None
    pool: ViewSet | None = None
    unseen: float | None = None
    full: Cameras | None = None

    def resized(self, longest: int) -> RunViews:
        """Shrink all views for training and scoring."""
        apart = self.apart and self.apart.resized(longest)
        return replace(self, train=self.train.resized(longest), test=self.test.resized(longest), apart=apart)


__all__ = ["DistillConfig", "Distilled", "SelectConfig", "distill"]

_FINAL = "final"
"""Name of the last recovery."""


@dataclass(frozen=True, eq=False)
class Distilled:
    """A compact scene and a report.

    Args:
        splats: exactly `budget` Gaussians.
        simplified: the scene before recovery at its final count: the anchors of the final recovery, and the
            reference of Drift95.
        report: views, rounds and times.
        held_out: held-out targets for scoring; None if the caller has their own.
    """

    splats: Splats
    simplified: Splats
    report: DistillReport
    held_out: Targets | None = None

    def __repr__(self) -> str:
        gain = self.report.rounds[-1].recover[-1:]
        scores = f", {gain[0].psnr}" if gain else ""
        return f"Distilled({plural(len(self.splats), 'Gaussian')}{scores})"


@checks_arguments
def distill(
    prior: Splats,
    budget: int,
    targets: Targets,
    config: DistillConfig | None = None,
    *,
    weights: ArrayLike | None = None,
    validation: Targets | None = None,
    work: Path | None = None,
    progress: Progress = silent,
    watch: Watch | None = None,
) -> Distilled:
    """Distil a dense prior into exactly `budget` Gaussians.

    The scene is simplified in one step, or, if the schedule has `round_steps`, in rounds of N_r = max(N_S,
    ⌈0.75·N_{r−1}⌉) with recovery after each.

    Args:
        prior: a trained scene or a lifted point cloud; cameras are in world coordinates, including its
            offset.
        budget: N_S, at most the prior's count.
        targets: photos, or the prior's own renders.
        config: see `DistillConfig`.
        weights: (C,) sampling weight of each view; None computes them.
        validation: views of another kind, not trained on, that limit recovery's changes if they lose quality,
            see `g2ard.stages.recover.recover`.
        work: folder for finished steps and checkpoints. The same call resumes from it, and one with other
            settings repeats only the steps that depend on them.
        progress: called by all stages.
        watch: called after every step of every recovery, see `g2ard.stages.recover.recover`.

    Returns:
        The compact scene with its unrecovered version and report.

    Raises:
        InputError: the budget does not fit, or no view sees the prior.
        KeyboardInterrupt: after Ctrl-C; the same call resumes from `work`.
    """
    config, targets, prior = config or DistillConfig(), checked_targets(targets), prior.narrowed()
    if validation is not None:
        validation = checked_targets(validation, "validation")
    counts = [budget]
    if config.recover.schedule.round_steps > 0:
        counts = config.simplify.rounds(len(prior), budget, recovered=True)
    rounds = _Rounds(
        prior,
        budget,
        targets,
        config,
        len(counts),
        Steps(work),
        checked_weights(weights, len(targets.cameras)),
        validation=validation,
        progress=progress,
        watch=watch,
    )
    for number, count in enumerate(counts, start=1):
        rounds.advance(number, count, final=number == len(counts))
    seconds = StageSeconds(**rounds.seconds, resumed=rounds.steps.resumed)
    report = DistillReport(tuple(rounds.log), seconds, rounds.supervision.report)
    return Distilled(rounds.state, rounds.simplified, report)


@dataclass(frozen=True, eq=False)
class _Supervision:
    """Training targets with sampling weights, and a report of their selection."""

    targets: Targets
    weights: Any
    report: ViewsReport | None

    @classmethod
    def of(
        cls, scene: Splats, targets: Targets, config: DistillConfig, weights: Any, progress: Progress
    ) -> _Supervision:
        """Select the views that see `scene`; given `weights` override those of the selection."""
        cameras = targets.cameras
        how = config.select
        if how.views_count is None and (weights is not None or not how.weighted):
            return cls(targets, weights, None)
        policy = how.policy if how.views_count is not None else "auto"
        chosen = select(
            scene,
            cameras,
            how.count_of(len(cameras)),
            policy=policy,
            seed=config.recover.seed,
            options=how if isinstance(how, SurfaceOptions) else None,
            progress=progress,
        )
        rows = np.argsort(chosen.order)
        subset = Subset(targets, chosen.order[rows])
        if weights is not None:
            weights = weights[chosen.order[rows]]
        elif how.weighted:
            weights = chosen.weights[rows]
        report = ViewsReport(
            policy=policy,
            candidates=len(cameras),
            chosen=[cameras.names[i] for i in chosen.order],
            weighted=weights is not None,
            refused=[cameras.names[i] for i in chosen.refused],
            left_out=chosen.left_out,
        )
        return cls(subset, weights, report)


@dataclass(eq=False)
class _Rounds:
    """State of the rounds: scene, protection flags and log."""

    prior: Splats
    budget: int
    targets: Targets
    config: DistillConfig
    count: int
    steps: Steps
    weights: Any = None
    validation: Targets | None = None
    progress: Progress = silent
    watch: Watch | None = None

    def __post_init__(self) -> None:
        self.state = self.simplified = self.prior
        self.protected: Any = None
        self.log: list[RoundReport] = []
        self.seconds = {"targets": 0.0, "select": 0.0, "simplify": 0.0, "recover": 0.0}
        self._select(self.prior)

    def advance(self, number: int, count: int, *, final: bool) -> None:
        """Run one round: simplify to `count` and recover; the final round adds the final recovery."""
        if self.config.select.reselect and number > 1:
            self._select(self.state)
        simplified, recovered = self._simplify(number, count), []
        if self.config.recover.schedule.round_steps > 0:
            recovered.append(self._recover(f"round-{number}", final=False))
        if final:
            recovered.append(self._recover(_FINAL, final=True))
        self.log.append(RoundReport(count, simplified, tuple(recovered)))

    def _select(self, scene: Splats) -> None:
        began = time.monotonic()
        self.supervision = _Supervision.of(scene, self.targets, self.config, self.weights, self.progress)
        self.seconds["select"] += time.monotonic() - began
        began = time.monotonic()
        if self.budget < len(self.prior) and not self.steps.has(_FINAL):  # otherwise few may be drawn
            for targets in filter(None, (self.supervision.targets, self.validation)):
                fill(targets, self.progress)
        self.seconds["targets"] += time.monotonic() - began

    def _simplify(self, number: int, count: int) -> SimplifyReport:
        cameras, scene, config = self.targets.cameras, self.state, self.config.simplify
        blind = config.method == "paper" or count == len(scene)

        def settings() -> object:
            kept = None if self.protected is None else np.packbits(self.protected).tobytes()
            return config, count, self.budget, None if blind else cameras.fingerprint(), kept

        def step(_: Path | None) -> tuple[Splats, SimplifyReport, dict[str, Any]]:
            began = time.monotonic()
            done = simplify(
                scene,
                count,
                config=config,
                visibility=None if blind else visibility_source(cameras, progress=self.progress),
                protected=self.protected,
                final_budget=self.budget,
                progress=self.progress,
            )
            report = replace(done.report, seconds=time.monotonic() - began)
            return done.splats, report, {"protected": done.protected}

        self.state, report, arrays = self.steps.run(
            f"simplified-{number}", scene, settings, SimplifyReport, step
        )
        self.protected = arrays["protected"]
        self.seconds["simplify"] += report.seconds or 0.0
        if self.config.recover.sh_degree is not None:
            self.state = self.state.with_sh_degree(self.config.recover.sh_degree)
        self.simplified = self.state
        return report

    def _recover(self, name: str, *, final: bool) -> RecoverReport:
        limit = self._time_limit(final)
        self.state, report = self.steps.recover(
            name,
            self.state,
            self.supervision.targets,
            replace(
                self.config.recover,
                steps=self._steps() if final and limit is None else None,
                recovery_time=limit,
                final=final,
            ),
            built=self.simplified,
            weights=self.supervision.weights,
            validation=self.validation,
            progress=self.progress,
            stage="recover" if final else f"recover {name}",
            watch=self.watch,
            skip_same=True,
        )
        self.seconds["recover"] += report.seconds
        return report

    def _steps(self) -> int:
        photos = isinstance(self.targets, Photos | PhotosOrRenders)
        cameras = self.supervision.targets.cameras
        return self.config.recover.final_steps(self.state, cameras, photos=photos)

    def _time_limit(self, final: bool) -> float | None:
        """Return this recovery's share of the time limit for all."""
        config, schedule = self.config.recover, self.config.recover.schedule
        if config.recovery_time is None:
            return None
        final_steps = schedule.steps if config.steps is None else config.steps
        all_steps = final_steps + self.count * schedule.round_steps
        return config.recovery_time * (final_steps if final else schedule.round_steps) / all_steps
