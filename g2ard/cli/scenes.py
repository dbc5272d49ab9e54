"""Reading what commands take: scenes, views and targets, with a line for all that was noticed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.cameras import Cameras
    from g2ard.cli.frame import Run
    from g2ard.io import ViewSet
    from g2ard.splats import Splats
    from g2ard.stages.render import RasterSettings
    from g2ard.targets import Targets

__all__ = [
    "drop_held_out",
    "load_for_training",
    "load_held_out",
    "load_scene",
    "load_split_views",
    "load_splits",
    "load_trained",
    "load_view_sets",
    "load_views",
    "make_targets",
    "recovery_engine",
    "trained_on",
]


def recovery_engine(run: Run) -> Literal["fused", "gsplat"]:
    """What takes recovery's steps on the device asked for.

    Raises:
        InputError: CUDA was asked for and is not to be had.
    """
    if run.device != "cuda":
        return "fused"
    from g2ard.stages.recover.gsplat_engine import check_cuda

    check_cuda()
    return "gsplat"


def trained_on(split: str) -> str:
    """What to call the views that a command has fitted."""
    return "training views" if split == "train" else f"{split} views"


def load_scene(run: Run, path: Path) -> Splats:
    """Read a scene and say what was noticed."""
    from g2ard.io import read_scene

    scene = read_scene(path)
    for note in scene.notes:
        run.say(f"{path}: {note}")
    return scene.splats


def load_views(run: Run, path: Path, split: str, size: int | None, *, unpictured: bool = False) -> Cameras:
    """Read views, pick a split, shrink them; `unpictured` keeps views without a photo beside others.

    Raises:
        InputError: the file has no views, or the split is empty.
    """
    return load_view_sets(run, path, [split], size, unpictured=unpictured)[0].cameras


def load_splits(run: Run, path: Path, splits: list[str], size: int | None) -> list[Cameras]:
    """Read views once and give each of several splits, shrunk.

    Raises:
        InputError: as `load_views`.
    """
    return [found.cameras for found in load_view_sets(run, path, splits, size)]


def load_view_sets(
    run: Run, path: Path, splits: list[str], size: int | None, *, unpictured: bool = False
) -> list[ViewSet]:
    """As `load_splits`, with the views' weights where the file has them.

    Raises:
        InputError: as `load_views`.
    """
    from g2ard.splits import split_mask

    found = _read(run, path, unpictured=unpictured)
    masks = [split_mask(path, found.cameras.names, split, stated=found.splits) for split in splits]
    return [found.take(mask).resized(size) for mask in masks]


def load_for_training(run: Run, path: Path, size: int | None) -> ViewSet:
    """The views to train on of a file beside which another is given to score on: its train split where it
    states splits, else all.

    Raises:
        InputError: as `load_views`, and as `g2ard.splits.for_training`.
    """
    from g2ard.splits import for_training

    found = _read(run, path)
    return found.take(for_training(path, found.cameras.names, found.splits)).resized(size)


def load_held_out(run: Run, path: Path, size: int | None) -> ViewSet:
    """The views of a file given to score on.

    Raises:
        InputError: as `load_views`, and as `g2ard.splits.for_scores`.
    """
    from g2ard.splits import for_scores

    found = _read(run, path)
    return found.take(for_scores(path, found.cameras.names, found.splits)).resized(size)


def drop_held_out(run: Run, train: ViewSet, held_out: Cameras) -> ViewSet:
    """The views to train on that are none of those to score on; says how many were.

    Raises:
        InputError: all of them are.
    """
    from g2ard.errors import InputError
    from g2ard.splits import not_held_out

    keep = not_held_out(train.cameras, held_out)
    if not keep.any():
        raise InputError(f"--held-out: all {len(keep)} views to train on are held out")
    if not keep.all():
        run.say(f"{len(keep) - int(keep.sum())} of {len(keep)} views are held out: not trained on")
    return train.take(keep)


def load_trained(run: Run, path: Path, split: str, size: int | None) -> ViewSet:
    """The views of a split to train on, shrunk; says so if that makes training views of held-out ones.

    Raises:
        InputError: as `load_views`.
    """
    pool, mask = load_split_views(run, path, split)
    chosen = pool.take(mask)
    held_out = chosen.splits.count("test")
    if held_out:
        run.say(f"--split {split}: {held_out} of the {len(chosen.cameras)} views trained on are test views")
    return chosen.resized(size)


def load_split_views(run: Run, path: Path, split: str) -> tuple[ViewSet, NDArray[np.bool_]]:
    """All views, each with the split it belongs to, stated or by the rule; and which of them `split` means.

    Raises:
        InputError: as `load_views`.
    """
    from dataclasses import replace

    from g2ard.splits import split_mask, splits_of

    found = _read(run, path)
    names = found.cameras.names
    mask = split_mask(path, names, split, stated=found.splits)
    return replace(found, splits=splits_of(path, names, found.splits)), mask


def _read(run: Run, path: Path, *, unpictured: bool = False) -> ViewSet:
    from g2ard.io import read_view_set

    found = read_view_set(path, unpictured=unpictured)
    for note in found.notes:
        run.say(f"{path}: {note}")
    return found


def make_targets(
    run: Run,
    cameras: Cameras,
    teacher: Splats | None,
    background: tuple[float, float, float],
    *,
    lazy: bool = False,
    photos: bool = False,
    settings: RasterSettings | None = None,
) -> Targets:
    """The teacher's renders (`lazy`: when first asked for), or the photos where no teacher is given; with
    `photos` the photo of each view that has one, and the teacher's render of the others."""
    from g2ard.io.exposures import find_exposures
    from g2ard.targets import Photos, PhotosOrRenders, TeacherRenders

    if teacher is not None and not photos:
        return TeacherRenders(
            teacher, cameras, background=background, settings=settings, lazy=lazy, progress=run.progress
        )
    exposures = find_exposures(cameras)
    if exposures:
        run.say(f"exposure.json: {len(exposures)} photos brought to the scene's own colours")
    if teacher is None:
        return Photos(cameras, exposures=exposures)
    return PhotosOrRenders(
        cameras,
        teacher,
        background=background,
        exposures=exposures,
        settings=settings,
        lazy=lazy,
        progress=run.progress,
    )
