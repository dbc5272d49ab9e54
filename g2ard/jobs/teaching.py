"""Targets of a command: photos of its views, or renders of a teacher."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from g2ard.config.choices import Colour, RenderModel, is_made
from g2ard.errors import InputError
from g2ard.io.types import ViewSet
from g2ard.jobs.inputs import GivenViews, Views, load_scene, load_split_views, make_targets, scorable
from g2ard.jobs.run_views import shrunk, views_or_pool, within_pixels
from g2ard.jobs.view_checks import check_photos, propose_background, warn_of_sight
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.rendering.targets import Targets
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.splats import Splats
from g2ard.system.cached import cached_property


def check_teacher(views: Views | None, teacher: Splats | str | Path | None) -> None:
    """Check that there is something to train on or score against: photos of views, or a teacher."""
    if teacher is None and is_made(views):
        raise InputError("generated views have no photos", parameter="views", hint="give {teacher=SCENE}")
    if teacher is None and views is None:
        raise InputError("there are no targets", hint="give {views}, or a {teacher} to generate views of")


@dataclass(frozen=True, eq=False)
class Teaching:
    """Source of targets: photos, or renders of a teacher.

    Args:
        teacher: the dense scene, or its path; None if all targets are photos.
        chosen: whether the user chose the background.
        photos: use photos where views have them, and renders of the teacher otherwise. Photos that show
            nothing of the scene are accepted then.
        render_model: overrides what the teacher's file says.
        seed: seed of generated views.
        rough: whether this is for a dry run, see `GivenViews`.
    """

    teacher: Splats | str | Path | None
    background: Colour
    chosen: bool
    photos: bool = False
    render_model: RenderModel | None = None
    seed: int = 0
    rough: bool = False
    progress: Progress = silent
    say: Say = unsaid

    @cached_property
    def dense(self) -> Splats | None:
        """The teacher, if there is one."""
        return None if self.teacher is None else load_scene(self.teacher, self.say, self.render_model)

    def views(self, given: Views | None, student: Splats | None = None) -> Views:
        """Return the given views, or those found beside the teacher, or generated ones.

        With a student, generated views are those that recover it, see `views_or_pool`.
        """
        if self.dense is None:
            assert given is not None  # `check_teacher`
            return given
        beside = None if isinstance(self.teacher, Splats) else self.teacher
        return views_or_pool(
            self.dense,
            GivenViews(given, beside, seed=self.seed, rough=self.rough),
            student=student,
            progress=self.progress,
            say=self.say,
        )

    def training(self, scene: Splats, views: Views, split: str, size: int | None) -> tuple[ViewSet, Targets]:
        """Read a split of the views and return it with its targets; reject photos of another scene."""
        pool, mask = load_split_views(views, split, self.say, unpictured=self.dense is not None)
        chosen = pool.take(mask).fitted(size)
        if held_out := chosen.splits.count("test"):
            count = len(chosen.cameras)
            self.say(f"split {split}: {held_out} of the {count} views trained on are test views")
        warn_of_sight(scene, chosen.cameras, self.say)
        targets = self.targets(chosen.cameras)
        self.check_photos(scene, chosen.cameras)
        return chosen, targets

    def check_photos(self, scene: Splats, cameras: Cameras) -> None:
        """Reject photos that do not show the scene, unless they are insisted on."""
        if self.dense is None or self.photos:
            check_photos(scene, cameras, self.background, self.say, insisted=self.photos)

    def targets(self, cameras: Cameras, **options: Any) -> Targets:
        """Return the targets of the views; note if another background fits their photos."""
        if (self.dense is None or self.photos) and not self.rough:
            propose_background(cameras, self.background, self.chosen, self.say)
        return self._made(cameras, say=self.say, **options)

    def full_size(self, cameras: Cameras, size: int | None, **options: Any) -> Targets | None:
        """Return the targets of unshrunk views; None if `size` shrinks none of them.

        Of large views there are only some, see `within_pixels`.
        """
        if shrunk(cameras, size) is None:
            return None
        return scorable(self._made(within_pixels(cameras), **options))

    def held_out(self, views: Views, size: int | None) -> Targets | None:
        """Return the targets of the test views; None if there are no such views."""
        cameras = self._split(views, "test")
        if cameras is None:
            return None
        return scorable(self._made(cameras.fitted(size)), self.say)

    def validation(self, views: Views, size: int | None) -> Targets | None:
        """Return the renders of the views of other kinds in split `val`, or None."""
        cameras = None if self.dense is None or self.photos else self._split(views, "val")
        if cameras is None or USUAL in cameras.kinds:
            return None
        return self._made(cameras.fitted(size), say=self.say)

    def _split(self, views: Views, name: str) -> Cameras | None:
        """Return the views of a split, or None if it is empty."""
        pool, _ = load_split_views(views, "all", unpictured=self.dense is not None)
        rows = [i for i, split in enumerate(pool.splits) if split == name]
        return pool.cameras.take(rows) if rows else None

    def _made(self, cameras: Cameras, **options: Any) -> Targets:
        return make_targets(cameras, self.dense, self.background, mixed=self.photos, **options)
