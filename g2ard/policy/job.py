"""A distillation with all decided: what `prepare` gives, and the pipeline on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.policy.inputs import make_targets
from g2ard.policy.views import RunViews
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.scene.splats import Splats
from g2ard.scene.targets import kinds_of

if TYPE_CHECKING:
    from g2ard.pipeline import DistillConfig, Distilled
    from g2ard.policy.fit import Aim
    from g2ard.rendering.renderer import Renderer
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.targets import Targets
    from g2ard.stages.recover.presets import PriorMeasures


@dataclass(frozen=True, eq=False)
class DistillJob:
    """A distillation, ready to run: all is decided, nothing rendered yet.

    Args:
        prior: the dense scene, or the lift of a cloud.
        aims: what one or more budgets came to; what they share is made once.
        views: what is looked at.
        teacher: whose renders the targets are; None where all of them are photos.
        photos_over_renders: of a view that has a photo the target is the photo, the teacher's render of the
            others; always False without a teacher.
        config: of the pipeline.
        weights: (C,) how often each view is drawn, where the views say so.
        lifted: whether `prior` is the lift of a cloud.
        preset: which regularisers, and why.
        measured: what decided it.
        seconds: that preparing it took, reading included.
        cleaned: how many Gaussians of each kind were taken out first; None where nothing was looked for.
        progress: told of all stages.
        say: told in lines what was noticed.
    """

    prior: Splats
    aims: tuple[Aim, ...]
    views: RunViews
    teacher: Splats | None
    photos_over_renders: bool
    config: DistillConfig
    weights: Any
    lifted: bool
    preset: str
    measured: PriorMeasures
    seconds: float = 0.0
    cleaned: dict[str, int] | None = None
    progress: Progress = silent
    say: Say = unsaid

    @property
    def budgets(self) -> tuple[int, ...]:
        """Counts to distil to."""
        return tuple(aim.count for aim in self.aims)

    @property
    def against(self) -> str:
        """What the views are scored against, in words."""
        return kinds_of(self.held_out)

    @cached_property
    def targets(self) -> Targets:
        """What recovery learns from."""
        return self._targets(self.views.train.cameras, lazy=self.config.select.views_count is not None)

    @cached_property
    def held_out(self) -> Targets:
        """Views of their kind to score on, never learned from."""
        return self._targets(self.views.test)

    @cached_property
    def apart(self) -> tuple[Targets | None, Targets | None]:
        """Views of another kind: every second one decides how much of recovery stays, the others are to score
        on; None where there are none, or no teacher to render them."""
        cameras = self.views.apart
        if cameras is None or self.teacher is None or len(cameras) < 2:
            return None, None
        first, second = (self._targets(cameras.take(range(i, len(cameras), 2))) for i in (0, 1))
        return first, second

    def render_targets(self) -> None:
        """Have all targets that are rendered beforehand; `run` does so where it has not been done."""
        _ = self.targets, self.held_out, self.apart
        vars(self).pop("_renderer", None)  # its buffers are larger than the scene

    @cached_property
    def _renderer(self) -> Renderer | None:
        """The teacher's, shared by all targets."""
        from g2ard.rendering.renderer import Renderer

        background = self.config.recover.background
        return None if self.teacher is None else Renderer(self.teacher, background=background)

    def tried(self, cameras: Cameras) -> Targets:
        """Targets of a few views, none of them kept."""
        return self._targets(cameras, lazy=True)

    def _targets(self, cameras: Cameras, *, lazy: bool = False) -> Targets:
        return make_targets(
            cameras,
            self.teacher,
            self.config.recover.background,
            lazy=lazy,
            photos=self.photos_over_renders,
            renderer=self._renderer,
            progress=self.progress,
            say=self.say,
        )

    def run(self, budget: int | None = None, *, work: Path | None = None) -> Distilled:
        """Distil to one of the budgets, the first if none is named.

        Args:
            budget: one of `budgets`.
            work: a folder for what a stopped run leaves, see `g2ard.pipeline.distill`.

        Returns:
            As `g2ard.distill`.
        """
        from g2ard.pipeline import distill as pipeline

        aim = next(aim for aim in self.aims if budget in (None, aim.count))
        self.render_targets()
        done = pipeline(
            self.prior,
            aim.count,
            self.targets,
            self.config,
            weights=self.weights,
            validation=self.apart[0],
            work=work,
            progress=self.progress,
        )
        return replace(done, splats=aim.shrink(done.splats, self.say)[0], held_out=self.held_out)
