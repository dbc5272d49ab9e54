"""Inputs and settings of a distillation beside its scene and budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from g2ard.pipeline import DistillConfig
    from g2ard.policy.inputs import Views
    from g2ard.stages.recover.anchors import Regularizers


@dataclass(frozen=True, eq=False, kw_only=True)
class DistillOptions:
    """Inputs of a distillation, and the settings of its configuration.

    Args:
        views: cameras in world coordinates, or where they lie; None takes those beside the scene, or makes
            a pool of poses if there are none; "made" always makes one. Their test split is held out.
        photos: True for the views' photos as targets, and no view without one; False for the scene's renders;
            None for the photo of each view that has one, and the scene's render of the others (sec. 3.1). A
            cloud has no renders to learn from: its lift is no picture of the place.
        held_out: views to score on instead.
        beside: where to look for cameras, if the scene is no path.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        size: pixels that the longer side of views is shrunk to.
        clean: first take out what no picture of the scene needs (`g2ard.stages.clean`).
        format: of the file that a budget in bytes speaks of: ply, compressed.ply, sog, spz, glb or splat.
        preset: settings by name, see `g2ard.config.presets`.
        settings: values of `DistillConfig` by path, which win over the preset's.
    """

    views: Views | None = None
    photos: bool | None = None
    held_out: Views | None = None
    beside: str | Path | None = None
    up: Sequence[float] | None = None
    size: int | None = None
    clean: bool = False
    format: str = "ply"
    preset: str = "auto"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def config(self) -> DistillConfig:
        """The configuration before the scene is measured: with a trained scene's regularisers unless named.

        Raises:
            InputError: an unknown preset or setting, or a value out of its range.
        """
        return self.configured()

    def configured(
        self, regularizers: Regularizers | None = None, sh_degree: int | None = None
    ) -> DistillConfig:
        """Return the configuration for measured regularisers, and a degree of SH if no setting says one."""
        from g2ard.config.presets import configured
        from g2ard.pipeline import DistillConfig

        settings = dict(self._full)
        if sh_degree is not None:
            settings.setdefault("recover.sh_degree", sh_degree)
        if regularizers is not None:
            settings["recover.regularizers"] = regularizers
        return configured(DistillConfig(), self.preset, settings)

    def named(self, path: str) -> Any:
        """Return the value of a path in the settings or else in the preset; None if neither has one."""
        from g2ard.config.presets import PRESETS

        return self._full.get(path, PRESETS.get(self.preset, {}).get(path))

    @cached_property
    def _full(self) -> Mapping[str, Any]:
        from g2ard.config.paths import full_paths
        from g2ard.pipeline import DistillConfig

        return full_paths(self.settings, DistillConfig())
