"""Targets of a command: photos of its views, or renders of the dense scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from g2ard.config.choices import Colour, is_made
from g2ard.errors import InputError
from g2ard.io.exposures import find_exposures
from g2ard.jobs.inputs import Scene, Views, drop_unscorable, load_split_views
from g2ard.jobs.run_views import limit_pixels
from g2ard.jobs.view_checks import check_photos, propose_background, warn_of_sight
from g2ard.pipeline.distill import RunViews
from g2ard.progress import Say, plural, unsaid
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import CACHE_BYTES, Photos, PhotosOrRenders, Targets, TeacherRenders
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.splats import Splats
from g2ard.system.cached import cached_property


def check_teacher(views: Views | None, teacher: Scene | None) -> None:
    """Check that there is something to train on or score against: photos of views, or a teacher."""
    if teacher is None and is_made(views):
        raise InputError(
            "generated views have no photos", parameter="views", hint="give {teacher=SCENE}"
        )
    if teacher is None and views is None:
        raise InputError(
            "there are no targets", hint="give {views}, or a {teacher} to generate views of"
        )


@dataclass(frozen=True, eq=False)
class Teaching:
    """Source of targets: photos, renders of the dense scene, or renders where views have no photo.

    Args:
        render: renders the dense scene in some views; None if all targets are photos.
        photos: whether targets are photos where views have them.
        background: RGB behind scenes and transparent pixels.
        chosen: whether the user chose the background.
        insisted: whether photos that show nothing of the scene are accepted.
        rough: whether this is for a dry run, which looks at no photo for its background.
        limit: bytes of photos that memory keeps per set of targets, see `Photos`.
    """

    render: Callable[[Cameras], Targets] | None
    photos: bool
    background: Colour
    chosen: bool
    insisted: bool = False
    rough: bool = False
    say: Say = unsaid
    limit: int = CACHE_BYTES

    @classmethod
    def by(
        cls,
        teacher: Splats | None,
        background: Colour,
        *,
        chosen: bool,
        insisted: bool,
        settings: RasterSettings | None = None,
        rough: bool = False,
        say: Say = unsaid,
    ) -> Teaching:
        """Return the source for commands with a `--teacher`, all whose targets are photos without one.

        Args:
            insisted: use photos where views have them, also those that show nothing of the scene.
            settings: conventions of renders.
        """
        render = None
        if teacher is not None:
            render = partial(
                TeacherRenders, teacher, background=background, settings=settings, lazy=True
            )
        return cls(render, insisted or teacher is None, background, chosen, insisted, rough, say)

    def check_photos(self, scene: Splats, cameras: Cameras, *, renders: bool = False) -> None:
        """Reject photos of another scene, see `g2ard.jobs.view_checks.check_photos`."""
        if self.photos:
            insisted = self.insisted
            check_photos(
                scene, cameras, self.background, self.say, insisted=insisted, renders=renders
            )

    def propose_background(self, cameras: Cameras) -> None:
        """Note if another background fits the photos."""
        if self.photos and not self.rough:
            propose_background(cameras, self.background, self.chosen, self.say)

    def targets(self, cameras: Cameras, say: Say = unsaid) -> Targets:
        """Return the targets of views, made on access."""
        if self.render is not None and not self.photos:
            return self.render(cameras)
        exposures = find_exposures(cameras)
        if exposures:
            say(f"exposure.json: corrected the exposure of {plural(len(exposures), 'photo')}")
        kind: Callable[..., Targets] = Photos
        if self.render is not None:
            kind = partial(PhotosOrRenders, teacher=self.render)
        return kind(cameras, background=self.background, exposures=exposures, limit=self.limit)

    def full_size(self, cameras: Cameras | None) -> Targets | None:
        """Return targets of views at their own size, of large views only some (`limit_pixels`).

        None without such views.
        """
        return None if cameras is None else drop_unscorable(self.targets(limit_pixels(cameras)))


@dataclass(frozen=True, eq=False)
class RunTargets:
    """Targets of the views of a run, made on access.

    Args:
        train: targets for training.
    """

    teaching: Teaching
    views: RunViews
    train: Targets

    @classmethod
    def of(cls, teaching: Teaching, views: RunViews) -> RunTargets:
        """Return the targets of some views. Notes on the photos for training are the first that are said."""
        return cls(teaching, views, teaching.targets(views.train.cameras, teaching.say))

    @cached_property
    def held_out(self) -> Targets:
        """Targets for scoring that have a valid pixel."""
        say = self.teaching.say
        return drop_unscorable(self.teaching.targets(self.views.test, say), say)

    @cached_property
    def validation(self) -> Targets | None:
        """Targets that limit recovery, None without such views."""
        return self._of(self.views.validation)

    @cached_property
    def apart(self) -> Targets | None:
        """Targets in views of other kinds for scoring, None without such views."""
        return self._of(self.views.apart)

    @cached_property
    def full(self) -> Targets | None:
        """Held-out targets at the views' own size, None if no size shrank them."""
        return self.teaching.full_size(self.views.full)

    @cached_property
    def twice(self) -> Targets | None:
        """Some of the held-out targets at twice their size, see `RunViews`."""
        return self._of(self.views.twice)

    def _of(self, cameras: Cameras | None) -> Targets | None:
        return None if cameras is None else self.teaching.targets(cameras)


def read_views(
    teaching: Teaching, scene: Splats, views: Views, split: str, size: int | None
) -> RunViews:
    """Read views that train in a split; if it is `train`, the splits `test` and `val` score and validate.

    Photos of another scene are rejected. Only renders in views of other kinds validate.
    """
    pool, mask = load_split_views(
        views, split, teaching.say, unpictured=teaching.render is not None
    )
    train = pool.take(mask).fitted(size)
    if held_out := train.splits.count("test"):
        count = len(train.cameras)
        teaching.say(f"split {split}: {held_out} of the {count} views trained on are test views")
    warn_of_sight(scene, train.cameras, teaching.say)
    teaching.propose_background(train.cameras)
    teaching.check_photos(scene, train.cameras)

    def others(name: str) -> Cameras:
        rows = [row for row, word in enumerate(pool.splits) if word == name and split == "train"]
        return pool.cameras.take(rows).fitted(size)

    validation = others("val")
    validates = len(validation) and not teaching.photos and USUAL not in validation.kinds
    return RunViews(train, others("test"), validation if validates else None)
