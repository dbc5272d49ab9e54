"""Start of a distillation: a trained scene, a lifted point cloud, or points of photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.io.types import Cloud, Points, ViewSet
from g2ard.jobs.budget import Budget
from g2ard.jobs.distill_options import DistillOptions
from g2ard.jobs.inputs import Views, find_axes, load_scene, read_points, split_views
from g2ard.jobs.start_points import (
    choose_count,
    find_sparse_file,
    is_sparse_file,
    keep_seen_points,
    read_sparse_points,
    scatter_points,
    top_up_points,
)
from g2ard.pipeline.dense import Dense, InMemory
from g2ard.progress import Say
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.lift import in_axes, lift, lift_rows
from g2ard.stages.photo_points.colors import colored
from g2ard.stages.photo_points.rays import distinct

if TYPE_CHECKING:
    from g2ard.jobs.dense import Opened

Given = Splats | Points | Source | None
"""Input of a distillation; None starts from photos alone."""

_NO_PHOTOS = (
    "no photos: the lifted points render the training images; photos, given as views, show more"
)


@dataclass(frozen=True, eq=False)
class Start:
    """The dense scene as read or lifted.

    Args:
        dense: the scene.
        name: its name in errors.
        beside: path beside which cameras may be.
        given: number of Gaussians, the first ones, from points that were not found in the photos.
        lifted: whether it was lifted from points.
        needs_photos: whether only photos can be its targets, as for points that go with photos.
        from_photos: whether the points, or some of them, were found in the photos, by COLMAP or here.
        usual: count of the result, if no budget is given.
        views: the views to learn from and those to score, if the points needed them, see `split_views`.
    """

    dense: Dense
    name: str
    beside: str | Path | None
    given: int
    lifted: bool = False
    needs_photos: bool = False
    from_photos: bool = False
    usual: int | None = None
    views: tuple[ViewSet, Cameras] | None = None


def describe_tiled_start(scene: Source, options: DistillOptions, tiles: Opened) -> Start:
    """Describe a scene in tiles, or the lift of a point cloud."""
    lifted = scene.kind == "points"
    with_photos = tiles.views is not None
    if lifted and not with_photos:
        options.say(_NO_PHOTOS)
    return Start(
        tiles.dense,
        str(scene),
        options.beside or (None if lifted else scene.path),
        len(tiles.dense.sample),
        lifted,
        with_photos,
        views=tiles.views,
    )


def read_start(scene: Given, budget: Budget | None, options: DistillOptions) -> Start:
    """Read the dense scene, or lift points; with photos they are topped up to the budget."""
    progress = options.progress
    say = options.say
    if isinstance(scene, Splats):
        options.check_trained()
        return Start(InMemory(scene.narrowed()), "scene", options.beside, len(scene))
    progress("read", 0, 0)
    if isinstance(scene, Source) and scene.kind == "splats":
        options.check_trained()
        splats = load_scene(scene.drawn_as(options.render_model), say)
        return Start(InMemory(splats), str(scene), options.beside or scene.path, len(splats))
    if options.photo_views is not None:
        return _read_photo_start(scene, options.photo_views, budget, options)
    if scene is None:
        raise InputError(
            "missing; without a scene, pass photos with poses as views", parameter="scene"
        )
    name = "cloud" if isinstance(scene, Points) else str(scene)
    cloud = _as_cloud(scene) if isinstance(scene, Points) else read_points(scene, name, say)
    xyz = cloud.points.positions
    rgb = cloud.points.colors
    axes = find_axes(cloud, name, say, progress)
    splats = lift(xyz, rgb, axes=axes, **vars(options.config.lift), progress=progress)
    say(_NO_PHOTOS)
    return Start(InMemory(splats), name, options.beside, len(splats), lifted=True)


def _read_photo_start(
    scene: Points | Source | None, views: Views, budget: Budget | None, options: DistillOptions
) -> Start:
    """Lift a cloud that goes with photos, or the photos' own points, topped up to the budget."""
    progress = options.progress
    say = options.say
    split = split_views(views, options.held_out, say)
    train = split[0].cameras
    cloud, name, of_photos = _read_cloud(scene, views, train, say)
    points: Points | None = None
    if cloud is not None:
        own = (
            cloud.points
            if options.planned
            else colored(cloud, train, name, progress=progress, say=say)
        )
        points = distinct(own)
    found = 0 if points is None else len(points)
    usual = None
    if budget is None:
        usual = choose_count(train, options.size, found, say)
    wanted = usual or (budget and budget.count) or 0
    if points is None and budget is not None and not wanted:
        raise InputError(
            "needs sparse points, and there are none",
            parameter=budget.kind,
            path=str(views),
            hint="give {count=COUNT}",
        )
    if points is None or scene is None or found < wanted:
        of_photos = True
        if options.planned:
            points = scatter_points(points, train, wanted)
        else:
            points = top_up_points(
                points,
                train,
                wanted,
                background=options.config.recover.background,
                seed=options.config.recover.seed,
                progress=progress,
                say=say,
            )
    # Each point has its disc, for as many are needed, also where positions are equal about another middle.
    splats, _ = lift_rows(
        points.positions, points.colors, options.config.lift, progress, merge=False
    )
    splats = in_axes(splats, (cloud and cloud.axes) or "RDF")
    return Start(
        InMemory(splats),
        name,
        options.beside,
        0 if scene is None else found,
        lifted=True,
        needs_photos=True,
        from_photos=of_photos,
        usual=usual,
        views=split,
    )


def _read_cloud(
    scene: Points | Source | None, views: Views, train: Cameras, say: Say
) -> tuple[Cloud | None, str, bool]:
    """Return a cloud, or that stored with the views, its name in errors, and whether it was found in photos.

    It may be without colours. Points found in photos are those of training views.
    """
    if isinstance(scene, Points):
        return _as_cloud(scene), "cloud", False
    file = find_sparse_file(views)
    if scene is None:
        return read_sparse_points(file, say, train), "cloud" if file is None else str(file), True
    source = scene
    of_photos = file is not None and is_sparse_file(scene, views)
    if file is not None and of_photos:
        chosen = Source(file)
        chosen.through = scene.through
        source = keep_seen_points(chosen, train)
    return read_points(source, str(scene), say, bare=True), str(scene), of_photos


def _as_cloud(points: Points) -> Cloud:
    return Cloud(points, (), np.any(points.colors, axis=1))
