"""Views and targets of the commands that train on images or score against them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from g2ard.cli.frame import Run
from g2ard.config.choices import Colour, is_made
from g2ard.errors import InputError
from g2ard.io.detect import run_scene, run_views
from g2ard.io.jsonfile import read_json
from g2ard.io.types import ViewSet
from g2ard.jobs.inputs import load_split_views, load_trained, make_targets, scorable
from g2ard.jobs.view_checks import propose_background, warn_of_sight
from g2ard.jobs.views import views_or_pool
from g2ard.rendering.targets import Targets
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats


def check_teacher(views: Path | None, teacher: Path | None, photos: bool) -> None:
    """Check that there is something to train on or score against: photos of views, or a teacher."""
    if photos and teacher is None:
        raise typer.BadParameter("--photos goes with --teacher; without a teacher, all targets are photos")
    if teacher is None and is_made(views):
        raise typer.BadParameter("--views made needs a --teacher: generated views have no photos")
    if teacher is None and views is None:
        raise typer.BadParameter("give --views, or a --teacher to generate views of")


def teaching_of_run(scenes: Sequence[Path]) -> tuple[Path, Path | None, bool, int | None] | None:
    """Return --views, --teacher, --photos and --size of the first run among the scenes, or None."""
    runs = (path for path in scenes if run_scene(path) != path and run_views(path) != path)
    folder = next(runs, None)
    if folder is None:
        return None
    report = read_json(folder / "report.json")
    against = report.get("against", "teacher renders")
    if against == "photos":
        return folder, None, False, report["config"]["size"]
    teacher = Path(report["config"]["scene"])
    if not teacher.exists():
        raise InputError(
            f"was made from {teacher}, which is not there", path=folder, hint="give {teacher=SCENE}"
        )
    return folder, teacher, "photo" in against, report["config"]["size"]


class Teaching:
    """Source of targets: photos, or renders of a teacher.

    Args:
        chosen: whether the user chose the background.
        photos: use photos where views have them, and renders of the teacher otherwise.
    """

    def __init__(
        self, run: Run, teacher: Path | None, background: Colour, *, chosen: bool, photos: bool = False
    ) -> None:
        self._run, self._teacher, self._photos = run, teacher, photos
        self._background, self._chosen = background, chosen
        self.dense = run.load(teacher) if teacher else None

    def views(self, given: Any) -> Any:
        """Return the given views, or those found beside the teacher, or generated ones."""
        run, beside = self._run, self._teacher
        if self.dense is None:
            return given
        return views_or_pool(
            self.dense, given, beside=beside, seed=run.seed, progress=run.progress, say=run.say
        )

    def training(self, scene: Splats, views: Any, split: str, size: int | None) -> tuple[ViewSet, Targets]:
        """Read a split of the views and return it with its targets; warn if it does not show the scene."""
        chosen = load_trained(views, split, size, self._run.say, unpictured=self.dense is not None)
        warn_of_sight(scene, chosen.cameras, self._run.say)
        return chosen, self.targets(chosen.cameras)

    def targets(self, cameras: Cameras, **options: Any) -> Targets:
        """Return the targets of the views; note if another background fits their photos."""
        if self.dense is None or self._photos:
            propose_background(cameras, self._background, self._chosen, self._run.say)
        return self._made(cameras, progress=self._run.progress, say=self._run.say, **options)

    def held_out(self, views: Any, size: int | None) -> Targets | None:
        """Return the targets of the test views, made on first access; None if there are no such views."""
        pool, _ = load_split_views(views, "all", unpictured=self.dense is not None)
        tested = [i for i, split in enumerate(pool.splits) if split == "test"]
        if not tested:
            return None
        return scorable(self._made(pool.cameras.take(tested).resized(size), lazy=True), self._run.say)

    def _made(self, cameras: Cameras, **options: Any) -> Targets:
        return make_targets(cameras, self.dense, self._background, photos=self._photos, **options)
