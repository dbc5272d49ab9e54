"""A prepared distillation: what was decided, its targets, and how it runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from g2ard.arrays import Float
from g2ard.jobs.budget_search import ResolvedBudget
from g2ard.jobs.distill_options import LEAST_RECOVERY_SHARE
from g2ard.jobs.memory import TilePlan
from g2ard.jobs.run_views import is_untouched
from g2ard.jobs.teaching import RunTargets, Teaching
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.dense import Dense
from g2ard.pipeline.distill import Distilled, RunViews, plan_round_counts
from g2ard.pipeline.distill import distill as pipeline
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.rendering.targets import Subset, fill
from g2ard.scene.samples import evenly_spaced, take_evenly
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.anchors import PriorMeasures
from g2ard.system.cached import cached_property

_TIMED = 8
"""Views in which scoring is timed."""


@dataclass(frozen=True, eq=False)
class DistillJob:
    """A prepared distillation: everything is decided, nothing rendered yet.

    Args:
        dense: the dense scene, or a lifted point cloud.
        budget: the resolved budget.
        teaching: source of the targets.
        lifted: whether the scene was lifted from points.
        preset: the regularisers chosen, and why.
        recovers: whether the scene is recovered, or only merged.
        cleaned: number of Gaussians removed by kind of clutter; None without cleaning.
        began, prepared: when the preparation began and ended.
        time: limit of the whole run in seconds; None without one.
        plan: of the dense scene's tiles; None if it is in memory.
    """

    dense: Dense
    budget: ResolvedBudget
    views: RunViews
    teaching: Teaching
    config: DistillConfig
    lifted: bool
    preset: str
    measured: PriorMeasures
    recovers: bool = True
    cleaned: dict[str, int] | None = None
    began: float = 0.0
    prepared: float = 0.0
    time: float | None = None
    progress: Progress = silent
    say: Say = unsaid
    plan: TilePlan | None = None

    @property
    def prior(self) -> Splats:
        """The dense scene, or a sample of one in tiles."""
        return self.dense.sample

    @property
    def total(self) -> int:
        """Gaussians of the dense scene."""
        return self.dense.total

    @property
    def sh_degree(self) -> int:
        """SH degree of the result."""
        given = self.config.recover.sh_degree
        return self.prior.sh_degree if given is None else given

    @property
    def renders(self) -> bool:
        """Whether any target may be a render of the dense scene."""
        return self.teaching.render is not None

    @property
    def photos(self) -> list[Path]:
        """The photos and masks that targets may be."""
        views = (self.views.train.cameras, self.views.test) if self.teaching.photos else ()
        paths = (path for cameras in views for path in (*cameras.image_paths, *cameras.mask_paths))
        return list(dict.fromkeys(path for path in paths if path is not None))

    @property
    def weights(self) -> Float | None:
        """(C,) sampling weight per training view, if the views state them."""
        return self.views.train.weights if self.config.select.weighted else None

    def is_kept(self, count: int) -> bool:
        """Return whether the scene already is the result: it fits, and its renders are the targets."""
        untouched = is_untouched(self.config.recover, self.prior, count, self.total)
        return not self.teaching.photos and untouched

    def steps(self, count: int) -> int:
        """Return the steps of all recoveries: after each round, if there are rounds, and of the last."""
        recover = self.config.recover
        like = take_evenly(self.prior, count)
        last = recover.final_steps(like, self.views.train.cameras, of_photos=self.teaching.photos)
        rounds = plan_round_counts(self.dense, count, self.config)
        return last + len(rounds) * recover.schedule.round_steps

    @cached_property
    def targets(self) -> RunTargets:
        """Targets of the views."""
        return RunTargets.of(self.teaching, self.views)

    def run(self, work: Path | None = None) -> Distilled:
        """Distil the scene; `work` is the folder for resuming, see `g2ard.pipeline.distill`."""
        targets = self.targets
        for scored in filter(None, (targets.held_out, targets.apart)):
            fill(scored, self.progress)
        limited = None if self.time is None else partial(self.time_left, self.time)
        done = self.reduce(self.dense, self.budget.count, work, time_left=limited)
        splats = self.budget.shrink(done.splats, self.say)
        return replace(done, splats=splats, held_out=done.match_exposures(targets.held_out))

    def reduce(
        self,
        scene: Dense,
        count: int,
        work: Path | None,
        time_left: Callable[[], float] | None = None,
    ) -> Distilled:
        """Simplify and recover the dense scene, or one derived from it."""
        return pipeline(
            scene,
            count,
            self.targets.train,
            self.config,
            weights=self.weights,
            merging=self.views.merging,
            validation=self.targets.validation,
            work=work,
            progress=self.progress,
            time_left=time_left,
        )

    def time_left(self, limit: float) -> float:
        """Return the seconds for recovery, of a limit for the whole run, after all that comes before it.

        Scoring comes after it. Recovery gets at least a twentieth.
        """
        scoring = self._scoring_seconds()
        spent = time.monotonic() - self.began
        left = limit - spent - scoring
        least = LEAST_RECOVERY_SHARE * limit
        if left < least:
            self.say(
                f"warning: {limit:g} s are short; after {spent:.1f} s recovery still gets {least:.1f} s"
            )
        return max(left, least)

    def _scoring_seconds(self) -> float:
        """Measure how long scoring takes: of the scene before and after recovery, in all views for scores.

        The dense scene is rendered in some of them. A result takes less, which leaves time for the pages.
        """
        targets = self.targets
        some = Subset(targets.held_out, evenly_spaced(len(targets.held_out.cameras), _TIMED))
        began = time.monotonic()
        evaluate(self.prior, some, background=self.config.recover.background)
        seconds = time.monotonic() - began
        scored = filter(None, (targets.held_out, targets.apart, targets.twice))
        pixels = sum(int(part.cameras.pixels.sum()) for part in scored)
        return 2 * seconds * pixels / int(some.cameras.pixels.sum())
