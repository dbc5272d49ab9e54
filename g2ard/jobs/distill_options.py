"""Inputs and settings of a distillation, besides the scene and budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from g2ard.config.checks import AtLeastOne, Positive
from g2ard.config.choices import Focus, FormatName, RenderModel, is_made
from g2ard.config.schema import Settings, full_paths, values_of
from g2ard.errors import InputError
from g2ard.jobs.inputs import GivenViews, Views
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.presets import PRESETS, configure
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.rendering.targets import CACHE_BYTES
from g2ard.stages.lift import LiftConfig
from g2ard.stages.recover.anchors import Regularizers
from g2ard.system.cached import cached_property

RECOVERY_SHARE = 0.4
"""Share of a limited time that recovery is expected to get, for which views are planned."""
LEAST_RECOVERY_SHARE = 1 / 20
"""Share of a limited time that recovery gets at least."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DistillOptions(Settings):
    """Inputs and settings of a distillation.

    Args:
        photos: targets: True for photos, skipping views without one; False for renders of the scene; None for
            each view's photo, or a render if it has none (sec. 3.1). A point cloud given with views needs
            their photos; without views, its lift renders the training images.
        format: file format for a budget in bytes, a name in `g2ard.io.scene_formats.FORMATS`.
        time: seconds that the whole run may take; recovery gets what the rest leaves.
        memory: bytes that the run may take; None is no limit.
        settings: values of `DistillConfig` by path, which override the preset.
        use: what the scene is prepared for. Levels are scored in usual views alone; merging has no recovery.
        planned: whether this is for a dry run: the job has a cost, but cannot run. Views are stand-ins, and
            tiles are only planned.

    Others are those of `g2ard.distill`.

    Raises:
        InputError: a value of another type, or out of range.
    """

    views: Views | None = None
    photos: bool | None = None
    held_out: Views | None = None
    beside: str | Path | None = None
    up: Sequence[float] | None = None
    size: AtLeastOne | None = None
    clean: bool = False
    render_model: RenderModel | None = None
    format: FormatName = "ply"
    preset: str = "auto"
    time: Positive | None = None
    memory: AtLeastOne | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    use: Literal["distil", "levels", "merging"] = "distil"
    planned: bool = False
    progress: Progress = silent
    say: Say = unsaid

    @cached_property
    def config(self) -> DistillConfig:
        """Configuration before the scene is measured; its regularisers are a trained scene's unless named."""
        return self.configure()

    @property
    def target_bytes(self) -> int:
        """Bytes of images that targets of one kind of view keep in memory, at most a quarter of it."""
        return CACHE_BYTES if self.memory is None else min(CACHE_BYTES, self.memory // 4)

    @property
    def focus(self) -> Focus | None:
        """Kind of training views to add, see `SelectConfig`; `far` for the paper's methods unless named."""
        config = self.config
        papers = (
            config.select.views_count is not None or not config.recover.schedule.means_in_scales
        )
        return config.select.focus or ("far" if papers else None)

    @property
    def photo_views(self) -> Views | None:
        """Given views whose photos a point cloud learns from."""
        return None if is_made(self.views) or self.photos is False else self.views

    @property
    def recovers(self) -> bool:
        """Whether the scene is recovered after it is merged."""
        return self.use != "merging"

    def request_views(self, beside: str | Path | None) -> GivenViews:
        """Return the views as they are requested, with a path that they may be beside."""
        return GivenViews(
            self.views,
            beside,
            self.up,
            self.config.recover.seed,
            rough=self.planned,
            progress=self.progress,
            say=self.say,
        )

    def configure(
        self, regularizers: Regularizers | None = None, sh_degree: int | None = None
    ) -> DistillConfig:
        """Return the configuration with measured regularisers and a default SH degree."""
        settings = dict(self._full)
        if self.time is not None:
            for path in ("recover.steps", "recover.recovery_time"):
                if path in settings:
                    other = path.rpartition(".")[2]
                    raise InputError(f"excludes {{{other}}}; give one", parameter="time")
            settings["recover.recovery_time"] = RECOVERY_SHARE * self.time
        if sh_degree is not None:
            settings.setdefault("recover.sh_degree", sh_degree)
        if regularizers is not None:
            settings["recover.regularizers"] = regularizers
        return configure(DistillConfig(), self.preset, settings)

    def check_trained(self) -> None:
        """Reject settings that only point clouds use, because the scene is a trained one."""
        for path, default in values_of(LiftConfig()).items():
            if self._full.get(path, default) != default:
                raise InputError(
                    "has no effect on a trained scene, only on point clouds", parameter=path
                )

    def find(self, path: str) -> Any:
        """Return the value of a path in the settings or the preset, or None."""
        return self._full.get(path, PRESETS.get(self.preset, {}).get(path))

    @cached_property
    def _full(self) -> Mapping[str, Any]:
        return full_paths(self.settings, DistillConfig())
