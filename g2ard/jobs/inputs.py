"""Reading the inputs of a run: scenes, views and splits, with a message for every note."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from g2ard.arrays import Mask
from g2ard.config.choices import Axes, RenderModel
from g2ard.errors import InputError
from g2ard.io import Source, read_view_set
from g2ard.io.splits import (
    for_scores,
    for_training,
    not_held_out,
    same_photos,
    split_mask,
    splits_of,
    states_splits,
)
from g2ard.io.types import Cloud, ViewFiles, ViewSet
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.rendering.targets import Targets, with_pixels
from g2ard.scene.cameras import Cameras
from g2ard.scene.regions import in_any
from g2ard.scene.splats import Splats
from g2ard.scene.transform import up_in
from g2ard.stages.lift import guessed_axes, lift
from g2ard.stages.simplify import Pairs, SimplifyConfig

Scene = Splats | str | Path  # a scene, or its path
Numbers = Sequence[float]  # a vector, direction or box
Views = Cameras | ViewSet | ViewFiles | str | Path  # cameras, or the path of views
Split = str | Callable[..., Mask]  # of `split_mask`, or a function like `for_training`


@dataclass(frozen=True, eq=False)
class GivenViews:
    """Views as they are given, and how to find or generate them.

    Args:
        views: cameras in world coordinates, or their path. None takes those found beside the scene, or
            generates some; "made" always generates them.
        beside: path of the scene, beside which cameras may be; None finds none.
        up: (3,) direction away from the ground for generated views; None estimates it.
        seed: seed of generated views.
        shape: width and height of generated views in pixels.
        rough: whether stand-ins of generated views do, as for a dry run: nothing is rendered for them.
        progress: called while views are generated.
        say: called with what was found or generated.
    """

    views: Views | None = None
    beside: str | Path | None = None
    up: Numbers | None = None
    seed: int = 0
    shape: tuple[int, int] = (800, 600)
    rough: bool = False
    progress: Progress = silent
    say: Say = unsaid


def load_scene(
    scene: Splats | Source | str | Path, say: Say = unsaid, render_model: RenderModel | None = None
) -> Splats:
    """Return a scene, which is read unless it is in memory.

    Notes on its file are reported, except those that do not affect rendering: a logit beyond ±16 is α = 0 or
    1 to within 1e-7, and only `g2ard info` reports these.
    """
    if isinstance(scene, Splats):
        return scene
    source = scene if isinstance(scene, Source) else Source(scene, render_model)
    splats = source.whole()
    for note in source.notes:
        if note.code not in _UNREPORTED_NOTES:
            say(f"{source}: {note}")
    return splats


def find_axes(cloud: Cloud, name: str, say: Say = unsaid, progress: Progress = silent) -> Axes:
    """Return the axes of a cloud's coordinates; if neither its format nor a map tells, guess and say so."""
    if cloud.axes is not None:
        return cloud.axes
    axes = guessed_axes(cloud.points.positions, progress)
    up = "xyz"[int(np.argmax(np.abs(up_in(axes))))]
    sign = "−" if min(up_in(axes)) < 0 else ""
    say(
        f"note: {name}: {sign}{up} is taken for up, a guess from its surfaces; results stand upright by it"
    )
    return axes


def read_points(source: Source, name: str, say: Say, *, bare: bool = False) -> Cloud:
    """Read a point cloud, and report its notes under a name; a `bare` one may be without colours."""
    cloud = source.cloud(bare=bare).whole()
    for note in cloud.notes:
        say(f"{name}: {note}")
    return cloud


def lift_cloud(source: Source, progress: Progress = silent, say: Say = unsaid) -> Splats:
    """Read a point cloud, report its notes, and lift it."""
    cloud = read_points(source, str(source), say)
    axes = find_axes(cloud, str(source), say, progress)
    splats = lift(cloud.points.positions, cloud.points.colors, axes=axes, progress=progress)
    discs = plural(len(splats), "disc")
    say(f"{source}: {plural(len(cloud.points), 'point')} lifted to {discs}, as `g2ard lift` does")
    return splats


def say_regions(splats: Splats, config: SimplifyConfig, name: str, say: Say) -> None:
    """Say how many Gaussians lie in the regions to keep; raise InputError if none do."""
    if isinstance(config, Pairs) and config.keep_region:
        inside = int(in_any(splats, config.keep_region).sum())
        if not inside:
            raise InputError(
                f"contains none of the {len(splats):,} Gaussians of {name}; "
                "see their extent with `g2ard info`",
                parameter="keep_region",
            )
        share = inside / len(splats)
        times = f"{config.keep_times:g} times"
        say(f"{plural(inside, 'Gaussian')} in the regions to keep ({share:.1%}) count {times}")


_UNREPORTED_NOTES = ("clamped_logits",)


def load_views(
    views: Views, split: str, size: int | None, say: Say = unsaid, *, unpictured: bool = False
) -> Cameras:
    """Read the views of a split at a longer side; `unpictured` keeps views without a photo among others."""
    return load_view_sets(views, [split], size, say, unpictured=unpictured)[0].cameras


def load_view_sets(
    views: Views,
    splits: Sequence[Split],
    size: int | None,
    say: Say = unsaid,
    *,
    unpictured: bool = False,
) -> list[ViewSet]:
    """Read views once and return several splits at a longer side, with their weights."""
    found, path = _read_views(views, say, unpictured=unpictured)
    return [found.take(_choose_split(found, path, split)).fitted(size) for split in splits]


def split_views(
    views: Views, held_out: Views | None, say: Say = unsaid, *, unpictured: bool = False
) -> tuple[ViewSet, Cameras]:
    """Return the views to learn from and those to score; no view scored is among the first.

    Whatever a job learns from photos takes them from the first, which is made once.

    Args:
        held_out: views to score; None scores the test split of `views`.
    """
    load = partial(load_view_sets, size=None, say=say, unpictured=unpictured)
    if held_out is None:
        train, test = load(views, ["train", "test"])
        return train, test.cameras
    (train,) = load(views, [for_training])
    (test,) = load(held_out, [for_scores])
    return drop_held_out(train, test.cameras, say), test.cameras


def drop_held_out(train: ViewSet, held_out: Cameras, say: Say = unsaid) -> ViewSet:
    """Remove held-out views from training views, and report how many were removed."""
    keep = not_held_out(train.cameras, held_out)
    if not keep.any():
        raise InputError(
            f"held-out views: they include all {plural(len(keep), 'view')} for training; hold out fewer, or "
            "train on others"
        )
    if not keep.all():
        say(f"held out from training: {len(keep) - int(keep.sum())} of {plural(len(keep), 'view')}")
    return train.take(keep)


def load_split_views(
    views: Views, split: str, say: Say = unsaid, *, unpictured: bool = False
) -> tuple[ViewSet, Mask]:
    """Read all views with their splits, stated or by the rule, and the mask of the views in `split`."""
    found, path = _read_views(views, say, unpictured=unpictured)
    mask = _choose_split(found, path, split)
    return replace(found, splits=splits_of(path, found.cameras.names, found.splits)), mask


def _choose_split(views: ViewSet, path: Path | None, split: Split) -> Mask:
    """Return the mask of the views in a split; a photo of the test split trains under no other name."""
    names = views.cameras.names
    photos = views.cameras.image_paths
    choose = partial(split_mask, which=split) if isinstance(split, str) else split
    mask: Mask = choose(path, names, stated=views.splits)
    if split != "train" and (split is not for_training or not states_splits(path, views.splits)):
        return mask
    tested = [word == "test" for word in splits_of(path, names, views.splits)]
    left = mask & ~same_photos(
        photos, [photo for photo, test in zip(photos, tested, strict=True) if test]
    )
    if not left.any():
        raise InputError(
            "no view is left for training: each photo is in the test split too", path=path
        )
    return left


def _read_views(views: Views, say: Say, *, unpictured: bool = False) -> tuple[ViewSet, Path | None]:
    """Return the views, and their path if they were read."""
    if isinstance(views, ViewSet):
        return views, None
    if not isinstance(views, str | Path | ViewFiles):
        return ViewSet(views), None
    views_read = read_view_set(views, unpictured=unpictured)
    for note in views_read.notes:
        say(f"{views}: {note}")
    return views_read, views.path if isinstance(views, ViewFiles) else Path(views)


def drop_unscorable(targets: Targets, say: Say = unsaid) -> Targets:
    """Return the targets that have a valid pixel, and report the number of the others."""
    kept = with_pixels(targets)
    if skipped := len(targets.cameras) - len(kept.cameras):
        say(f"{plural(skipped, 'photo')} not scored: the mask leaves no pixel")
    return kept
