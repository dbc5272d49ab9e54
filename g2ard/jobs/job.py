"""A fully prepared distillation and its run."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.jobs.inputs import make_targets, scorable
from g2ard.jobs.measured_budget import Aim
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.distill import Distilled
from g2ard.pipeline.distill import distill as pipeline
from g2ard.pipeline.run_views import RunViews
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Targets, kinds_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.recover.auto_preset import PriorMeasures
from g2ard.system.cached import cached_property

_FULL_PIXELS = 32_000_000
"""Pixels of the views that are scored at their own size after a requested one."""


@dataclass(frozen=True, eq=False)
class DistillJob:
    """A prepared distillation: everything is decided, nothing rendered yet.

    Args:
        prior: the dense scene, or a lifted point cloud.
        aim: the resolved budget.
        teacher: the scene rendered for targets; None if all targets are photos.
        photos_over_renders: use photos where views have them and renders for the rest; always False without a
            teacher.
        preset: the regularisers chosen, and why.
        cleaned: number of Gaussians removed by kind of clutter; None without cleaning.
    """

    prior: Splats
    aim: Aim
    views: RunViews
    teacher: Splats | None
    photos_over_renders: bool
    config: DistillConfig
    lifted: bool
    preset: str
    measured: PriorMeasures
    cleaned: dict[str, int] | None = None
    progress: Progress = silent
    say: Say = unsaid

    @property
    def reads_photos(self) -> bool:
        """Whether any target may be a photo."""
        return self.teacher is None or self.photos_over_renders

    @property
    def against(self) -> str:
        """Kinds of the scoring targets, as text for summaries."""
        return kinds_of(self.held_out)

    @property
    def weights(self) -> NDArray[np.float64] | None:
        """(C,) sampling weight per training view, if the views state them."""
        return self.views.train.weights if self.config.select.weighted else None

    def is_kept(self, count: int) -> bool:
        """Return whether the scene already is the result: it fits, and its renders are the targets."""
        degree = self.config.recover.sh_degree
        return (
            not self.reads_photos
            and count == len(self.prior)
            and (degree is None or degree >= self.prior.sh_degree)
            and self.config.recover.schedule.guarded
        )

    @cached_property
    def targets(self) -> Targets:
        """Training targets."""
        few = self.config.select.views_count is not None or self.is_kept(self.aim.count)
        return self.targets_for(self.views.train.cameras, self._renderer, lazy=few)

    @cached_property
    def held_out(self) -> Targets:
        """Held-out targets of the same kind that have a valid pixel, for scoring only."""
        return scorable(self.targets_for(self.views.test, self._renderer), self.say)

    @cached_property
    def validation(self) -> Targets | None:
        """Every second view of another kind, for validation during recovery; None as for `apart`."""
        return self._every_second_apart(0)

    @cached_property
    def apart(self) -> Targets | None:
        """The others of these views, for scoring; None without such views or a teacher to render them."""
        return self._every_second_apart(1)

    @cached_property
    def full_size(self) -> Targets | None:
        """Held-out targets at the views' own size, made on access; None if no size shrank them.

        Of large views there are only as many as `_FULL_PIXELS` hold, evenly spaced.
        """
        cameras = self.views.full
        if cameras is None:
            return None
        largest = int((cameras.widths * cameras.heights).max())
        some = evenly_spaced(len(cameras), max(1, _FULL_PIXELS // largest))
        return scorable(self.targets_for(cameras.take(some), lazy=True))

    def _every_second_apart(self, first: int) -> Targets | None:
        cameras = self.views.apart
        if cameras is None or self.teacher is None or len(cameras) < 2:
            return None
        unused = first == 0 and self.is_kept(self.aim.count)
        return self.targets_for(cameras.take(range(first, len(cameras), 2)), self._renderer, lazy=unused)

    def render_targets(self) -> None:
        """Render all targets that are not lazy; `run` calls this too."""
        _ = self.targets, self.held_out, self.validation, self.apart
        vars(self).pop("_renderer", None)  # its buffers are larger than the scene

    @cached_property
    def _renderer(self) -> Renderer | None:
        """Renderer of the teacher, shared by all targets."""
        background = self.config.recover.background
        return None if self.teacher is None else Renderer(self.teacher, background=background)

    def targets_for(
        self, cameras: Cameras, renderer: Renderer | None = None, *, lazy: bool = False
    ) -> Targets:
        """Return targets of this job's kind for views; see `g2ard.jobs.inputs.make_targets`."""
        return make_targets(
            cameras,
            self.teacher,
            self.config.recover.background,
            lazy=lazy,
            photos=self.photos_over_renders,
            renderer=renderer,
            progress=self.progress,
            say=self.say,
        )

    def run(self, work: Path | None = None) -> Distilled:
        """Distil the scene; `work` is the folder for resuming, see `g2ard.pipeline.distill`."""
        self.render_targets()
        done = pipeline(
            self.prior,
            self.aim.count,
            self.targets,
            self.config,
            weights=self.weights,
            validation=self.validation,
            work=work,
            progress=self.progress,
        )
        return replace(done, splats=self.aim.shrink(done.splats, self.say), held_out=self.held_out)
