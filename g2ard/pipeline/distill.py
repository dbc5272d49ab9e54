"""The whole pipeline: select, simplify, freeze anchors and recover, in rounds."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float, Mask, Values
from g2ard.config.checks import checks_arguments
from g2ard.io.types import ViewSet
from g2ard.pipeline.config import DistillConfig, SelectConfig
from g2ard.pipeline.dense import Dense, InMemory, as_dense, load_whole
from g2ard.pipeline.steps import Steps
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.targets import (
    Exposed,
    Photos,
    PhotosOrRenders,
    Subset,
    Targets,
    checked_targets,
)
from g2ard.report.run import DistillReport, RoundReport, StageSeconds, ViewsReport
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import Evaluation
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.loop import check_weights
from g2ard.stages.recover.optimize import Watch
from g2ard.stages.select import CoverageOptions, select
from g2ard.stages.simplify.reduce import SimplifyReport
from g2ard.system.shown import Shown


@dataclass(frozen=True, eq=False)
class RunViews:
    """Views of a run.

    Args:
        train: views for training, of the usual and other kinds.
        test: usual views for scoring, or all views for scoring that are given.
        validation: views of other kinds that limit recovery's changes; None if there are none.
        apart: further views of other kinds, for scoring.
        pool: the whole generated pool, written beside the result.
        full: the usual views for scoring at their own size, if a requested size shrank them.
        unseen: share of the sampled matter that no view of the pool sees.
        twice: a few of the usual views for scoring at twice their size, if they were generated.
        guess: how the up direction of generated views was guessed; None if it is more than a guess.
        merging: generated views that weigh Gaussians while they are merged, as `simplify` plans them, because
            those for training crowd where the compact scene is weak. None: the training views.
    """

    train: ViewSet
    test: Cameras
    validation: Cameras | None = None
    apart: Cameras | None = None
    pool: ViewSet | None = None
    unseen: float | None = None
    full: Cameras | None = None
    twice: Cameras | None = None
    guess: str | None = None
    merging: Cameras | None = None

    @property
    def untrained(self) -> list[Cameras]:
        """Views that need a target, but do not train."""
        return [
            cameras for cameras in (self.test, self.validation, self.apart) if cameras is not None
        ]

    def resized(self, longest: int) -> RunViews:
        """Shrink all views for training and scoring."""
        return replace(
            self,
            train=self.train.resized(longest),
            test=self.test.resized(longest),
            validation=self.validation and self.validation.resized(longest),
            apart=self.apart and self.apart.resized(longest),
        )


__all__ = ["DistillConfig", "Distilled", "SelectConfig", "distill"]

_FINAL = "final"
"""Name of the last recovery."""


@dataclass(frozen=True, eq=False)
class Distilled(Shown):
    """A compact scene and a report.

    Args:
        splats: exactly `budget` Gaussians.
        simplified: the scene before recovery at its final count: the anchors of the final recovery, and the
            reference of Drift95.
        report: views, rounds and times.
        held_out: held-out targets for scoring; None if the caller has their own.
        scores: of `splats` in held-out views at their own size; None without such views.
    """

    splats: Splats
    simplified: Splats
    report: DistillReport
    held_out: Targets | None = None
    scores: Evaluation | None = None

    def __repr__(self) -> str:
        gain = self.report.rounds[-1].recover[-1:]
        scores = f", {gain[0].psnr}" if gain else ""
        if self.scores is not None:
            scores = f", PSNR {self.scores.psnr:.2f} dB in {self.scores.scored_in}"
        return f"Distilled({plural(len(self.splats), 'Gaussian')}{scores})"

    def match_exposures(self, held_out: Targets) -> Targets:
        """Return the targets, to be scored after a fit of exposures if the training photos differ."""
        recoveries = (recovery for entry in self.report.rounds for recovery in entry.recover)
        return Exposed(held_out) if any(done.exposure for done in recoveries) else held_out


@checks_arguments
def distill(
    prior: Splats | Dense,
    budget: int,
    targets: Targets,
    config: DistillConfig | None = None,
    *,
    weights: ArrayLike | None = None,
    merging: Cameras | None = None,
    validation: Targets | None = None,
    work: Path | None = None,
    progress: Progress = silent,
    watch: Watch | None = None,
    time_left: Callable[[], float] | None = None,
) -> Distilled:
    """Distil a dense prior into exactly `budget` Gaussians.

    The scene is simplified in one step, or, if the schedule has `round_steps`, in rounds of N_r = max(N_S,
    ⌈0.75·N_{r−1}⌉) with recovery after each. Of a scene in tiles, the first round merges to the largest of
    these counts that a tile may have.

    Args:
        prior: a trained scene or a lifted point cloud, in memory or in tiles; cameras are in world
            coordinates, including its offset.
        budget: N_S, at most the prior's count.
        targets: photos, or the prior's own renders.
        config: see `DistillConfig`.
        weights: (C,) sampling weight of each view; None computes them.
        merging: views that weigh Gaussians while they are merged; None takes those of `targets`.
        validation: views of another kind, not trained on, that limit recovery's changes if they lose quality,
            see `g2ard.stages.recover.recover`.
        work: folder for finished steps and checkpoints. The same call resumes from it, and one with other
            settings repeats only the steps that depend on them.
        progress: called by all stages.
        watch: called after every step of every recovery, see `g2ard.stages.recover.recover`.
        time_left: returns the time limit of the last recovery in seconds when it begins.

    Returns:
        The compact scene with its unrecovered version and report.

    Raises:
        InputError: the budget does not fit, or no view sees the prior.
        KeyboardInterrupt: after Ctrl-C; the same call resumes from `work`.
    """
    config = config or DistillConfig()
    targets = checked_targets(targets)
    dense = as_dense(prior)
    if validation is not None:
        validation = checked_targets(validation, "validation")
    schedule = config.recover.schedule
    steps = Steps(work, progress)
    counts = plan_round_counts(dense, budget, config)
    given = check_weights(weights, len(targets.cameras))
    photos = isinstance(targets, Photos | PhotosOrRenders)
    total = dense.total
    protected = None
    selecting = 0.0
    log = []
    for number, count in enumerate(counts, start=1):
        if number == 1 or config.select.reselect:
            began = time.monotonic()
            rows, weighed, views = select_views(
                dense.sample, targets.cameras, config, given, progress
            )
            chosen = targets if rows is None else Subset(targets, rows)
            selecting += time.monotonic() - began
        drawn = (chosen, validation) if budget < total else ()  # it may be its own teacher
        simplified, report, protected = _simplify_round(
            steps,
            number,
            dense,
            count,
            budget,
            targets.cameras if merging is None else merging,
            config,
            protected,
            progress,
            drawn,
        )
        scene = simplified
        recoveries = []
        names = [f"round-{number}"] if schedule.round_steps else []
        if number == len(counts):
            names.append(_FINAL)
        for name in names:
            final = name == _FINAL
            scene, recovery = steps.recover(
                name,
                scene,
                chosen,
                _configure_recovery(
                    config.recover, scene, chosen.cameras, len(counts), photos, final
                ),
                built=simplified,
                weights=weighed,
                validation=validation,
                filled=bool(drawn),
                stage="recover" if final else f"recover {name}",
                watch=watch,
                skip_same=True,
                time_left=time_left if final else None,
            )
            recoveries.append(recovery)
        dense = InMemory(scene)
        log.append(RoundReport(count, report, tuple(recoveries)))
    seconds = StageSeconds(
        targets=steps.filling,
        select=selecting,
        simplify=sum(entry.simplify.seconds or 0.0 for entry in log),
        recover=sum(recovery.seconds for entry in log for recovery in entry.recover),
        resumed=steps.resumed,
    )
    return Distilled(scene, simplified, DistillReport(tuple(log), seconds, views))


def plan_round_counts(dense: Dense, budget: int, config: DistillConfig) -> list[int]:
    """Return the count after each round. Those that memory does not hold are passed over."""
    if not config.recover.schedule.round_steps:
        return [budget]
    counts = config.simplify.rounds(dense.total, budget, recovered=True)
    return [count for count in counts if count <= dense.most_rows and count > budget] + [budget]


def select_views(
    scene: Splats, cameras: Cameras, config: DistillConfig, given: Values | None, progress: Progress
) -> tuple[Values | None, Values | None, ViewsReport | None]:
    """Select the views that see `scene`; return their rows, None for all, their weights and a report.

    Given weights override those of the selection.
    """
    how = config.select
    if how.views_count is None and (given is not None or not how.weighted):
        return None, given, None
    policy = how.policy if how.views_count is not None else "auto"
    chosen = select(
        scene,
        cameras,
        how.count_of(len(cameras)),
        policy=policy,
        options=how if isinstance(how, CoverageOptions) else None,
        progress=progress,
    )
    order = np.argsort(chosen.order)
    weights = chosen.weights[order] if how.weighted else None
    if given is not None:
        weights = given[chosen.order[order]]
    report = ViewsReport(
        policy=policy,
        candidates=len(cameras),
        chosen=[cameras.names[i] for i in chosen.order],
        weighted=weights is not None,
        refused=[cameras.names[i] for i in chosen.refused],
        left_out=chosen.left_out,
    )
    return chosen.order[order], weights, report


def choose_draw_weights(
    scene: Splats, train: ViewSet, config: DistillConfig, progress: Progress = silent
) -> Float | None:
    """Return the weights by which all training views are drawn, as stated or selected; 0 is never drawn.

    None draws them equally often.
    """
    given = train.weights if config.select.weighted else None
    rows, weights, _ = select_views(scene, train.cameras, config, given, progress)
    if weights is None or rows is None:
        return weights
    every = np.zeros(len(train.cameras))
    every[rows] = weights
    return every


def _simplify_round(
    steps: Steps,
    number: int,
    dense: Dense,
    count: int,
    budget: int,
    cameras: Cameras,
    config: DistillConfig,
    protected: Mask | None,
    progress: Progress,
    drawn: Sequence[Targets | None],
) -> tuple[Splats, SimplifyReport, Mask]:
    """Simplify to the count of a round; return the scene, a report and the flags for the next round.

    Args:
        drawn: targets that the recovery to come draws, rendered first.
    """
    blind = config.simplify.method == "paper" or count == dense.total
    content = [
        config.simplify,
        count,
        budget,
        None if blind else cameras,
        protected,
        *dense.identity(),
    ]

    def step(_: Path | None) -> tuple[Splats, SimplifyReport, dict[str, Any]]:
        steps.fill(*drawn)
        began = time.monotonic()
        done = dense.merge(
            count,
            None if blind else cameras,
            config.simplify,
            protected=protected,
            final_budget=budget,
            progress=progress,
        )
        report = replace(done.report, seconds=time.monotonic() - began)
        flags = np.zeros(count, bool) if done.protected is None else done.protected
        return load_whole(done.splats), report, {"protected": flags}

    name = f"simplified-{number}"
    like = dense.sample
    done, report, arrays = steps.run(name, like, lambda: content, SimplifyReport, step)
    if config.recover.sh_degree is not None:
        done = done.with_sh_degree(config.recover.sh_degree)
    return done, report, arrays["protected"]


def _configure_recovery(
    config: RecoverConfig,
    scene: Splats,
    cameras: Cameras,
    rounds: int,
    of_photos: bool,
    final: bool,
) -> RecoverConfig:
    """Return the settings of one recovery: the steps of the last one, or its share of the time for all."""
    schedule = config.schedule
    limit = config.recovery_time
    if limit is None:
        steps = config.final_steps(scene, cameras, of_photos=of_photos) if final else None
        return replace(config, steps=steps, final=final)
    last = schedule.steps if config.steps is None else config.steps
    limit = (
        limit * (last if final else schedule.round_steps) / (last + rounds * schedule.round_steps)
    )
    return replace(config, steps=None, recovery_time=limit, final=final)
