"""Prepared scene of a study: its prior, and its views and targets for training and scoring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.runner import folder_of, scene_key
from benchmarks.study import SceneSpec, Study
from benchmarks.views import hidden_targets
from g2ard import io
from g2ard.errors import InputError
from g2ard.io.splits import for_scores, for_training, not_held_out, split_mask, splits_of
from g2ard.io.types import ViewSet
from g2ard.poses import make_pool
from g2ard.progress import plural
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import Photos, PhotosOrRenders, Targets, TeacherRenders
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.lift import lift
from g2ard.stages.simplify import simplify

__all__ = ["PROTOCOLS", "Workspace", "budget_of", "kinds_for", "reduced"]

PROTOCOLS: dict[str, tuple[str, ...]] = {
    "all": ("pool", "near", "standing", "anywhere"),
    "pool": ("pool",),
    "standing": ("near", "standing"),
    "anywhere": ("anywhere",),
    "other": ("near", "standing", "anywhere"),
}
"""Protocol → kinds of views to score; photos exist for the pool, and for a scene's further score views."""

_POOL = 128
_MAX_LOGIT = 20.0
"""Largest logit. Opacities of exactly 1 become 1 − 2e-9, since some programs cannot read infinite logits."""


def kinds_for(protocol: str, scene: SceneSpec) -> tuple[str, ...]:
    """Return the kinds of views to score.

    Raises:
        InputError: photos, and a protocol that needs renders.
    """
    if scene.targets != "photos":
        return PROTOCOLS[protocol]
    if protocol not in ("all", "pool"):
        raise InputError("protocol: expected 'pool' for photos; other views need a trained scene")
    return ("pool", *list(scene.score)[1:])


def budget_of(count: int, ratio: float) -> int:
    """Return the count for a ratio."""
    return max(1, int(np.floor(count / ratio + 0.5)))


def reduced(splats: Splats, ratio: float, views: Cameras) -> Splats:
    """Simplify a scene by a ratio with visibility from views; 1 returns the scene."""
    budget = budget_of(len(splats), ratio)
    if budget == len(splats):
        return splats
    return simplify(splats, budget, visibility=visibility_source(views)).splats


class Workspace:
    """Lazily loaded scene of a study, with intermediate files in `folder`."""

    def __init__(self, work: Path, study: Study, scene: SceneSpec) -> None:
        self.work, self.study, self.scene = work, study, scene

    @cached_property
    def folder(self) -> Path:
        """The folder of intermediate files."""
        folder = folder_of(self.work, self.study, self.scene)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @cached_property
    def key(self) -> str:
        """A hash of the scene, its files and its views."""
        return scene_key(self.study, self.scene)

    @cached_property
    def place(self) -> Path:
        """The base of the scene's paths; generates the city if the scene is one."""
        if self.scene.synth is None:
            return self.study.folder
        from benchmarks.synth import CityConfig, write_city

        town = self.folder / "city"
        if not town.is_dir():
            options = dict(self.scene.synth)
            if "size" in options:
                options["size"] = tuple(options["size"])
            write_city(town, CityConfig(sky=self.scene.background, **options))
        return town

    @cached_property
    def lifted(self) -> bool:
        """Whether the prior is lifted from a point cloud."""
        return io.kind(self.place / self.scene.prior) != "splats"

    @cached_property
    def splats(self) -> Splats:
        """The prior, with finite logits."""
        source = self.place / self.scene.prior
        if self.lifted:
            points = io.read_points(source)
            every = evenly_spaced(len(points.positions), self.scene.points or len(points.positions))
            return lift(
                points.positions[every], None if points.colors is None else points.colors[every]
            )
        splats = io.read_splats(source)
        logits = np.clip(splats.logit_opacities, -_MAX_LOGIT, _MAX_LOGIT)
        return replace(splats, logit_opacities=logits)

    @cached_property
    def prior_file(self) -> Path:
        """The prior as a .ply."""
        path = self.folder / "prior.ply"
        if not path.exists():
            io.write_splats(path, self.splats)
        return path

    @cached_property
    def train(self) -> Path:
        """The training views at the study's size, without those that are scored."""
        path = self.folder / "train.json"
        if not path.exists():
            self.write_views(path, self._training(), "train")
        return path

    @property
    def train_cameras(self) -> Cameras:
        """The training views."""
        return io.read_view_set(self.train, unpictured=True).cameras

    def _training(self) -> Cameras:
        if self.scene.train is None:
            return self._pool("train")
        whole = self.place / self.scene.train
        if self.scene.score:
            return self._apart(whole, for_training)
        return self.views(whole, "train")

    def write_views(self, path: Path, cameras: Cameras, what: str) -> None:
        """Write views to "train" or "adapt" on, without those that are scored."""
        keep = np.ones(len(cameras), bool)
        for name, scored in self.scored.items():
            if what == "adapt" or name != "adapt-val":  # new appearance may show trained places
                keep &= not_held_out(cameras, scored)
        if not keep.any():
            raise InputError(
                f"all {plural(len(keep), 'view')} to {what} on are scored; none remain"
            )
        io.write_views(path, cameras.take(keep), splits=["train"] * int(np.count_nonzero(keep)))

    @property
    def dropped(self) -> int:
        """The number of views that were dropped from training because they are scored."""
        return len(self._training()) - len(self.train_cameras)

    def read(self, path: Path) -> ViewSet:
        """Read views; those without photos are kept if the scene's targets allow it."""
        return io.read_view_set(path, unpictured=self.scene.targets == "either")

    def views(self, path: Path, split: str) -> Cameras:
        """Return a split of a file's views at the study's size."""
        found = self.read(path)
        return self.small(found, split_mask(path, found.cameras.names, split, stated=found.splits))

    def small(self, found: ViewSet, mask: NDArray[np.bool_]) -> Cameras:
        """Select views and shrink them to the study's size."""
        return found.take(mask).resized(self.study.size).cameras

    def _apart(self, path: Path, chosen: Callable[..., NDArray[np.bool_]]) -> Cameras:
        """Return the views that `for_training` or `for_scores` chooses."""
        found = self.read(path)
        return self.small(found, chosen(path, found.cameras.names, found.splits))

    def _pool(self, split: str) -> Cameras:
        """Return a split of a generated pool; every 8th view is scored."""
        path = self.folder / "pool.json"
        if not path.exists():
            pool = make_pool(self.splats, _POOL, seed=self.study.pool_seed)
            io.write_views(path, pool, splits=splits_of(None, pool.names))
        return self.views(path, split)

    @cached_property
    def scored(self) -> dict[str, Cameras]:
        """Split → views to score on."""
        if self.scene.score:
            score = self.scene.score.items()
            there = {name: self.place / path for name, path in score if name not in self.missing}
            return {name: self._apart(path, for_scores) for name, path in there.items()}
        if self.scene.train is not None:
            return {"test": self.views(self.place / self.scene.train, "test")}
        return {"test": self._pool("test")}

    @cached_property
    def missing(self) -> dict[str, Path]:
        """The optional views to score on whose files do not exist, by name."""
        paths = {name: self.place / path for name, path in self.scene.score.items()}
        return {
            name: p for name, p in paths.items() if name in self.scene.optional and not p.exists()
        }

    def notes(self) -> list[str]:
        """Return missing optional files, and counts that differ from those the scene expects."""
        notes = [
            f"{name}: {path} does not exist, so no row has it"
            for name, path in self.missing.items()
        ]
        found = {name: len(cameras) for name, cameras in self.scored.items()}
        if "prior" in self.scene.expects:
            found["prior"] = len(self.splats)
        found["train"] = len(self.train_cameras)
        for name, wanted in self.scene.expects.items():
            if found.get(name, wanted) != wanted:
                unit = "Gaussian" if name == "prior" else "view"
                notes.append(f"{name}: {plural(found[name], unit)}, the paper has {wanted:,}")
        return notes

    def targets(
        self, cameras: Cameras, settings: RasterSettings | None = None, **options: Any
    ) -> Targets:
        """Return the targets of views: photos, or renders of the prior."""
        if self.scene.targets == "photos":
            return Photos(cameras, background=self.scene.background, **options)
        if self.lifted:
            raise InputError(
                f"scene {self.scene.name}: a point cloud has no renders; set targets = 'photos'"
            )
        kind = TeacherRenders if self.scene.targets == "teacher" else PhotosOrRenders
        look = {"background": self.scene.background, "settings": settings, **options}
        return kind(teacher=self.splats, cameras=cameras, **look)

    def scaled(self, kind: str, scale: float) -> Targets:
        """Return the targets of a kind of views at a multiple of their size."""
        targets = self.kinds_of_views[kind]
        if scale == 1:
            return targets
        cameras = targets.cameras
        longest = int(np.maximum(cameras.widths, cameras.heights).max())
        return self.targets(cameras.scaled(round(scale * longest)), lazy=True)

    @cached_property
    def kinds_of_views(self) -> dict[str, Targets]:
        """Kind of views → targets: "pool" (those scored first), and the protocol's others if there is room.

        No method sees the others.
        """
        found = {"pool": self.targets(next(iter(self.scored.values())))}
        wanted = kinds_for(getattr(self.study, "protocol", "all"), self.scene)
        found |= {
            name: self.targets(cameras) for name, cameras in self.scored.items() if name in wanted
        }
        source, study, background = self.place / self.scene.prior, self.study, self.scene.background
        return found | hidden_targets(
            self.splats,
            source,
            wanted,
            seed=study.pool_seed,
            size=study.size,
            background=background,
        )
