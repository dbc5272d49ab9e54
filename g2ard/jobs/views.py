"""Views of a run: given, found beside the scene, or generated; and views of other kinds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from g2ard.config.choices import is_made
from g2ard.errors import InputError
from g2ard.io.splits import for_scores, for_training, split_mask, splits_of
from g2ard.io.types import ViewSet
from g2ard.jobs.inputs import Views, drop_held_out, load_view_sets, load_views
from g2ard.jobs.view_checks import as_pool, check_sight, found_views, warn_of_sight
from g2ard.pipeline.run_views import RunViews
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.scene.cameras import USUAL, Cameras, rows_by_kind
from g2ard.scene.splats import Splats

if TYPE_CHECKING:
    from g2ard.jobs.distill_options import DistillOptions
    from g2ard.pipeline.config import SelectConfig
    from g2ard.poses import Pool
Up = Sequence[float] | None

_POOL_VIEWS, _POOL_GROWTH, _NEAR_SHARE = 160, 2.0, 0.25
"""Generated pool: number of poses, growth factor if views show little of the scene, and share of nearer
poses. Every 8th pose is held out for scoring.
"""
_ANYWHERE_SHARE, _LEAST_ANYWHERE_SHARE = 0.4, 0.05
"""Share of the training views that look from anywhere, if other views hold nothing of the scene; if they hold
a share h, 1−h times that, and none below the second share.
"""
_VIEWS_APART = 24
"""Number of near views, and of each further kind that trains: one half validates recovery, the other is
scored."""
_POOL_GAUSSIANS = 4_000_000
"""Size of a tiled scene from which the pool grows in proportion."""
_POOL_SAMPLE = 200_000
"""Gaussians that poses are planned on."""

_WEIGHT_VIEWS, _WEIGHT_ROWS = 96, 100_000
"""Size of the pool for simplification, of which as many are used as the scene needs, and the Gaussians that
it is planned on.
"""


def views_of(
    prior: Splats,
    options: DistillOptions,
    *,
    beside: str | Path | None = None,
    teach: bool = True,
    represents: float = 1.0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> RunViews:
    """Choose views for recovery and for scoring.

    Args:
        prior: the dense scene.
        options: the views, or None for those found beside the scene or generated; `focus`, the kind of views
            added to views that are given without photos or generated.
        beside: path beside which to look for cameras.
        teach: whether the scene can render targets; otherwise views without a photo are skipped and no views
            are generated.
        represents: Gaussians per row if `prior` is a sample of a larger scene; the pool grows with it.
    """
    views_beside = None
    if options.views is None and beside is not None:
        wanted = ["train"] if options.held_out is not None else ["train", "test"]
        views_beside = found_views(beside, prior, wanted, say)
    given = views_beside or options.views
    plan = partial(
        _planned,
        prior,
        up=options.up,
        seed=options.config.recover.seed,
        represents=represents,
        progress=progress,
    )
    load = partial(load_view_sets, size=options.size, say=say, unpictured=teach)
    spare = round(_VIEWS_APART * _times(prior, represents))
    select = replace(options.config.select, focus=options.focus)
    if given is None or is_made(given):
        if not teach:
            raise InputError(
                "generated views have no photos", parameter="photos", hint="give {views} that have them"
            )
        held_out = None if options.held_out is None else load(options.held_out, [for_scores])[0].cameras
        return _generated(plan(_POOL_VIEWS, grow=_POOL_GROWTH), held_out, options.size, select, spare, say)
    if options.held_out is None:
        train, test = load(given, ["train", "test"])
    else:
        (train,), (test,) = load(given, [for_training]), load(options.held_out, [for_scores])
        train = drop_held_out(train, test.cameras, say)
    if not views_beside:
        check_sight(prior, train.cameras, say)
    elif not options.size:
        train, test = (replace(part, cameras=as_pool(part.cameras)) for part in (train, test))
    if not teach or any(train.cameras.image_paths):
        if options.config.select.focus:
            say("warning: --focus has no effect on views with photos")
        select = replace(select, focus="far")
    if not teach:
        return RunViews(train, test.cameras)
    try:
        planned = plan(_VIEWS_APART)
    except InputError:  # the scene has no room for poses
        return RunViews(train, test.cameras)
    train, apart = _mixed(train, planned, select, spare, options.size, say)
    return RunViews(train, test.cameras, apart)


def _generated(
    planned: Pool, held_out: Cameras | None, size: int | None, select: SelectConfig, spare: int, say: Say
) -> RunViews:
    """Split a pool into views for training and for scoring; all train if `held_out` are scored."""
    names = planned.cameras.names
    held_back = split_mask(None, names, "test") if held_out is None else np.zeros(len(names), bool)
    usual = ViewSet(planned.cameras, splits=tuple(np.where(held_back, "test", "train").tolist()))
    train, apart = _mixed(usual.take(~held_back), planned, select, spare, None, say)
    test = planned.cameras.take(held_back)
    pool = ViewSet(
        Cameras.of([*train.cameras, *test]),
        splits=("train",) * len(train.cameras) + ("test",) * len(test),
    )
    say(f"poses: {_of(planned, pool.cameras)}")
    train, test = train.resized(size), test.resized(size)
    if held_out is not None:
        train, test = drop_held_out(train, held_out, say), held_out
    return RunViews(train, test, apart and apart.resized(size), pool, planned.unseen)


def _mixed(
    train: ViewSet, planned: Pool, select: SelectConfig, spare: int, size: int | None, say: Say
) -> tuple[ViewSet, Cameras | None]:
    """Add views of other kinds to training views, and return them with `spare` further views of each kind.

    There are also as many near views if none train.
    """
    usual = len(train.cameras)
    share = _ANYWHERE_SHARE * (1 - planned.held)
    if select.focus in ("far", "anywhere") or share <= _LEAST_ANYWHERE_SHARE:
        share = 0.0
    counts = {"near": 0, "anywhere": round(usual * share / (1 - share))}
    if select.focus not in (None, "far"):
        times = select.focus_share / (1 - select.focus_share)
        counts[select.focus] = round((usual + counts["anywhere"]) * times)
    more, apart = [], []
    for kind, count in counts.items():
        cameras = planned.more(kind, count + spare) if count or kind == "near" else []
        if cameras and kind == "anywhere" != select.focus:  # half as wide, because they see little
            cameras = [*Cameras.of(cameras).resized(cameras[0].width // 2)]
        taken = min(count, max(len(cameras) - spare, len(cameras) // 2))
        if kind == select.focus and taken < 0.9 * count:
            say(f"warning: --focus {kind}: the scene has room for {taken} such views, {count} are wanted")
        more += cameras[:taken]
        apart += cameras[taken:]
    others = Cameras.of(apart).resized(size) if apart else None
    if not more:
        return train, others
    weights = np.ones(usual) if train.weights is None else train.weights / train.weights.mean()
    return ViewSet(
        Cameras.of([*train.cameras, *more]).resized(size),
        train.notes,
        train.splits and train.splits + ("train",) * len(more),
        np.append(weights, np.ones(len(more))),  # drawn equally often
    ), others


def views_or_pool(
    scene: Splats,
    views: Views | None,
    *,
    beside: str | Path | None = None,
    count: int | None = None,
    up: Up = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Views:
    """Return given views, views found beside the scene, or a generated pool with every 8th view held out.

    Args:
        count: size of a generated pool; None chooses like `distill`.

    Other arguments are those of `views_of`.
    """
    from g2ard.poses import plan_pool

    if views is not None and not is_made(views):
        return views
    if views is None and beside is not None and (found := found_views(beside, scene, [], say)):
        return found
    if count is None:
        planned = _planned(scene, _POOL_VIEWS, up=up, seed=seed, progress=progress, grow=_POOL_GROWTH)
    else:
        planned = plan_pool(scene, count, up=up, seed=seed, rows=_POOL_SAMPLE, progress=progress)
    say(f"poses: {_of(planned, planned.cameras)}")
    return ViewSet(planned.cameras, splits=splits_of(None, planned.cameras.names))


def _of(pool: Pool, cameras: Cameras) -> str:
    """Describe a pool, and views of further kinds, briefly."""
    kinds = [pool.kind, *(kind for kind in rows_by_kind(cameras.kinds) if kind != USUAL)]
    guess = "; the up direction is a guess" if "guess" in pool.why else ""
    return f"{len(cameras)}, {' + '.join(kinds)}{guess}"


def cameras_for_weights(
    scene: Splats,
    views: Views | None,
    method: str,
    *,
    beside: str | Path | None = None,
    up: Up = None,
    seed: int = 0,
    represents: float = 1.0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Cameras | None:
    """Choose views for simplification's visibility: given, found beside the scene, or generated.

    Args:
        views: as for `views_of`; the training split is used.
        method: `fast` uses only given or requested views, `paper` none.

    Other arguments are those of `views_of`.

    Returns:
        The cameras, or None for no views.
    """
    from g2ard.poses import plan_pool

    made = is_made(views)
    if method == "paper" and views is not None:
        say("paper uses no views")
    if method == "paper" and made:
        return None
    if views is None and beside is not None and method == "default":
        views_beside = found_views(beside, scene, ["train"], say)
        if views_beside:
            return as_pool(load_views(views_beside, "train", None, say))
    if views is not None and not made:
        given = load_views(views, "train", None, say)
        warn_of_sight(scene, given, say)
        return given
    if method != "default" and not made:
        return None
    try:
        times = _times(scene, represents)
        pool = plan_pool(
            scene,
            round(_WEIGHT_VIEWS * times),
            up=up,
            seed=seed,
            rows=round(_WEIGHT_ROWS * times),
            near=_NEAR_SHARE,
            for_weights=True,
            represents=represents,
            progress=progress,
        )
    except InputError as e:
        say(f"continuing without views: {e}")
        return None
    return pool.cameras


def _planned(
    prior: Splats,
    count: int,
    *,
    up: Up,
    seed: int,
    progress: Progress,
    grow: float = 1.0,
    represents: float = 1.0,
) -> Pool:
    """Plan a pool of `count` to `grow` × `count` views."""
    from g2ard.poses import plan_pool

    times = _times(prior, represents)
    return plan_pool(
        prior,
        round(count * times),
        up=up,
        seed=seed,
        rows=round(_POOL_SAMPLE * times),
        grow=grow,
        near=_NEAR_SHARE,
        represents=represents,
        progress=progress,
    )


def _times(prior: Splats, represents: float) -> float:
    return pool_times(len(prior) * represents) if represents > 1 else 1.0


def pool_times(count: float) -> float:
    """Return the growth factor of the pool for a tiled scene of `count` Gaussians."""
    return max(1.0, count / _POOL_GAUSSIANS)
