"""Views of a run: given, found beside the scene, or generated; and views of other kinds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from g2ard.arrays import Float
from g2ard.config.checks import AtLeastOne, checks_arguments
from g2ard.errors import InputError
from g2ard.io.detect import run_views
from g2ard.io.splits import for_scores, split_mask, splits_of
from g2ard.io.types import ViewSet
from g2ard.jobs.inputs import (
    GivenViews,
    Views,
    drop_held_out,
    load_view_sets,
    load_views,
    split_views,
)
from g2ard.jobs.view_checks import check_sight, size_like_pool, take_or_find_views, warn_of_sight
from g2ard.jobs.viewer_frame import find_shared_up
from g2ard.pipeline.config import SelectConfig
from g2ard.pipeline.dense import Dense, InMemory
from g2ard.pipeline.distill import RunViews, choose_draw_weights
from g2ard.poses import Pool, best_views, plan_pool, turntable
from g2ard.poses.zooms import zoomed
from g2ard.progress import Progress, Say, direction, plural, unsaid
from g2ard.scene.cameras import USUAL, Camera, Cameras, rows_by_kind
from g2ard.scene.samples import evenly_spaced, take_evenly
from g2ard.scene.splats import Splats
from g2ard.stages.recover.config import RecoverConfig, count_steps_for_renders
from g2ard.stages.select.light import complete
from g2ard.stages.simplify import simplify

if TYPE_CHECKING:
    from g2ard.jobs.distill_options import DistillOptions

_SHAPE = (800, 600)
"""Width and height of generated views in pixels, unless another size is requested."""

FULL_PIXELS = 8_000_000
"""Pixels of the views that are scored at their own size after a requested one."""

_POOL_VIEWS = 128
"""Generated usual views."""
_TRAINING_VIEWS = 112
"""Usual views that train: every 8th is held out for scoring."""
_POOL_GROWTH = 2.0
"""Largest factor on the usual views if a view shows little of the scene."""
_OFFERED_VIEWS = 64
"""Views of each other kind from which training views are chosen."""
_VIEWS_APART = 16
"""Further views of each other kind: one half validates recovery, the other is scored."""
_POOL_STEPS = 1400
"""Steps for which the whole pool is used: runs of few steps plan, render and score few views."""
_POOL_POWER = 0.6
"""Power of the share of these steps that is the share of the pool used."""
_LEAST_SHARE = 0.15
"""Least share of the pool used."""
_STEP_SECONDS = 0.03
"""Time of a step that a time limit is divided by, as on two cores."""
_LEAST_SCORED = 6
"""Least usual views that are scored."""
_LEAST_APART = 8
"""Least views of each other kind that validate and are scored."""
_TWICE = "usual at 2×"
"""Kind of views that are scored at twice their size."""
_TWICE_VIEWS = 4
"""Number of these views in a whole pool."""
_TWICE_LONGEST = 2400
"""Longest side of these views in pixels."""
_OTHER_KINDS = ("near", "standing", "anywhere")
_COMPACT_ROWS = 100_000
"""Most Gaussians of the compact scene that the choice is measured on."""
_POOL_GAUSSIANS = 4_000_000
"""Size of a scene from which the pool grows in proportion."""
_POOL_SAMPLE = 200_000
"""Gaussians that poses are planned on."""

_ROUGH = "estimated"
"""Kind of the stand-ins of dry runs."""
_ROUGH_ROWS = 10_000
"""Gaussians that place these stand-ins."""
_USUAL_OTHERS = 0.4
"""Views of other kinds that join usual ones, over their number: 0.4 to 0.6 on playbot and autzen."""

_WEIGHT_VIEWS = 80
"""Usual views that weigh Gaussians, of which as many are used as the scene needs."""
_WEIGHT_ROWS = 100_000
"""Gaussians that these views are planned on."""
_WEIGHT_OTHERS = {"near": 8, "anywhere": 16}
"""Views of other kinds beside these: usual ones may all stand outside a closed room (decision 0040)."""


def choose_views(
    dense: Dense,
    options: DistillOptions,
    count: int,
    *,
    given: tuple[ViewSet, Cameras] | None = None,
    beside: str | Path | None = None,
    teach: bool = True,
) -> RunViews:
    """Choose views for recovery and for scoring.

    Usual views are given, found or generated. Views of other kinds that resolve what these leave unresolved
    join them (`g2ard.stages.select.light`), measured on the scene merged to `count` by the method `fast`.

    Args:
        dense: the dense scene.
        options: the views, or None for those found beside the scene or generated; `focus`, the kind of views
            added to views that are given without photos or generated.
        count: Gaussians of the compact scene.
        given: the result of `split_views` if the views are read already.
        beside: path beside which to look for cameras.
        teach: whether the scene can render targets; otherwise views without a photo are skipped and no views
            are generated.
    """
    prior = dense.sample
    say = options.say
    wanted = ["train"] if options.held_out is not None else ["train", "test"]
    asked = options.request_views(beside)
    found, are_found = take_or_find_views(asked, prior, wanted)
    select = replace(options.config.select, focus=options.focus)
    mix = partial(_add_other_kinds, dense=dense, given=asked, count=count, size=options.size)
    if found is None:
        if not teach:
            raise InputError(
                "generated views have no photos",
                parameter="photos",
                hint="give {views} that have them",
            )
        held_out = None
        if options.held_out is not None:
            held_out = load_view_sets(options.held_out, [for_scores], None, say, unpictured=teach)[
                0
            ].cameras
        planned = _plan_views(dense, asked, _POOL_VIEWS, grow=_POOL_GROWTH)
        share = 1.0
        if options.recovers:
            share = choose_pool_share(options.config.recover, prior, planned.cameras)
        views = _split_pool(
            planned,
            held_out,
            options.size,
            partial(
                mix,
                select=select,
                share=share,
                learns=not is_untouched(options.config.recover, prior, count, dense.total),
            ),
            options.use,
            say,
            share=share,
        )
        if not options.recovers or options.config.simplify.method == "paper":
            return views
        return replace(views, merging=choose_weighing_views(dense, replace(asked, say=unsaid)))
    train, test = given or split_views(found, options.held_out, say, unpictured=teach)
    if not are_found:
        check_sight(prior, train.cameras, say)
    else:
        train = replace(train, cameras=size_like_pool(train.cameras))
        test = size_like_pool(test)
    full = keep_larger(test, options.size)
    # photos that are not read do not limit it
    if options.size is not None and options.photos is False:
        train = replace(train, cameras=train.cameras.scaled(options.size))
        test = test.scaled(options.size)
    train = train.fitted(options.size)
    test = test.fitted(options.size)
    if not teach or any(train.cameras.image_paths):
        if options.config.select.focus:
            say("warning: --focus has no effect on views with photos")
        select = replace(select, focus="far")
    if not teach:
        return RunViews(train, test, full=full)
    try:
        planned = _plan_views(dense, asked, _OFFERED_VIEWS)
    except InputError:  # the scene has no room for poses
        return RunViews(train, test, full=full)
    weigh = partial(choose_draw_weights, prior, train, options.config, options.progress)
    train, others, _ = mix(train, planned, select=select, weigh=weigh)
    return RunViews(train, test, *_halve_others(others), full=full)


def is_untouched(recover: RecoverConfig, prior: Splats, count: int, total: int) -> bool:
    """Return whether a scene already is the result if its renders are the targets."""
    degree = recover.sh_degree
    return (
        count == total
        and (degree is None or degree >= prior.sh_degree)
        and recover.schedule.guarded
    )


def choose_pool_share(recover: RecoverConfig, scene: Splats, pool: Cameras) -> float:
    """Return the share of a generated pool that a recovery of a scene uses."""
    schedule = recover.schedule
    if not schedule.means_in_scales:
        return 1.0
    if recover.recovery_time is not None:
        steps = recover.recovery_time / _STEP_SECONDS
    else:
        steps = recover.steps or count_steps_for_renders(
            scene, pool, schedule.for_renders * schedule.steps
        )
    return min(1.0, max(_LEAST_SHARE, (steps / _POOL_STEPS) ** _POOL_POWER))


def keep_larger(cameras: Cameras, size: int | None) -> Cameras | None:
    """Return the views if `size` shrinks any of them, otherwise None."""
    larger = size is not None and bool((cameras.sides > size).any())
    return cameras if larger else None


def limit_pixels(cameras: Cameras) -> Cameras:
    """Return as many of the views as `FULL_PIXELS` hold, evenly spaced."""
    largest = int(cameras.pixels.max())
    return take_evenly(cameras, max(1, FULL_PIXELS // largest))


def _split_pool(
    planned: Pool,
    held_out: Cameras | None,
    size: int | None,
    mix: Callable[..., _Mixed],
    use: str,
    say: Say,
    *,
    share: float = 1.0,
) -> RunViews:
    """Split a pool into views for training and for scoring; all train if `held_out` are scored.

    Args:
        share: share of the pool that is used.
    """
    names = planned.cameras.names
    held_back = split_mask(None, names, "test") if held_out is None else np.zeros(len(names), bool)
    usual = take_spread_prefix(planned.cameras.take(~held_back), share)
    test = take_spread_prefix(planned.cameras.take(held_back), share, _LEAST_SCORED)
    train, others, unseen = mix(ViewSet(usual, splits=("train",) * len(usual)), planned)
    pool = ViewSet(
        Cameras.of([*train.cameras, *test]),
        splits=("train",) * len(train.cameras) + ("test",) * len(test),
    ).fitted(size)  # runs are compared in the views that they write
    scored = test if held_out is None else held_out
    counts = _count_uses(use, len(train.cameras), len(scored), len(others or ()))
    say(f"views: {counts}; {_describe_kinds(planned, pool.cameras)}")
    train = train.fitted(size)
    if held_out is not None:
        train = drop_held_out(train, held_out, say)
    full = keep_larger(scored, size)
    scored = scored.fitted(size)
    twice = None
    if use == "distil" and held_out is None:
        twice = _double_size(scored, max(2, round(share * _TWICE_VIEWS)))
    guess = planned.why.rpartition("; ")[2] if "guess" in planned.why else None
    return RunViews(train, scored, *_halve_others(others), pool, unseen, full, twice, guess)


def _halve_others(others: Cameras | None) -> tuple[Cameras | None, Cameras | None]:
    """Return every second one of further views of other kinds, which validate, and the rest for scoring."""
    if others is None or len(others) < 2:
        return None, None
    validation, apart = (others.take(range(first, len(others), 2)) for first in (0, 1))
    return validation, apart


def _double_size(cameras: Cameras, count: int) -> Cameras | None:
    """Return some views at twice their size, None if that is very large."""
    longest = 2 * int(cameras.sides.max())
    if longest > _TWICE_LONGEST:
        return None
    some = take_evenly(cameras, count).scaled(longest)
    return replace(some, kinds=(_TWICE,) * len(some))


def take_spread_prefix(cameras: Cameras, share: float, least: int = 1) -> Cameras:
    """Return a share of the views, each next one farthest from those before; fewer are a prefix of more."""
    wanted = max(least, round(share * len(cameras)))
    if wanted >= len(cameras):
        return cameras
    spread = max(float(np.ptp(cameras.positions, axis=0).max()), np.finfo(float).tiny)
    places = np.concatenate([cameras.positions / spread, cameras.forwards / 4], axis=1)
    apart = np.full(len(places), np.inf)
    order = [0]
    while len(order) < wanted:
        apart = np.minimum(apart, np.square(places - places[order[-1]]).sum(axis=1))
        order.append(int(np.argmax(apart)))
    return cameras.take(sorted(order))


def _count_uses(use: str, train: int, test: int, apart: int) -> str:
    """Count views by use.

    >>> _count_uses("distil", 112, 16, 48), _count_uses("merging", 112, 16, 48)
    ('112 train, 40 score, 24 validate', '112 measure visibility, 16 score')
    """
    if use == "merging":
        return f"{train} measure visibility, {test} score"
    half = apart // 2
    parts = {
        "train": train,
        "score": test + (half if use == "distil" else 0),
        "validate": apart - half,
    }
    return ", ".join(f"{count} {name}" for name, count in parts.items() if count)


_Mixed = tuple[ViewSet, Cameras | None, float | None]
"""Training views, further views of other kinds, and the unseen share of the scene if it was measured."""


def _add_other_kinds(
    train: ViewSet,
    planned: Pool,
    *,
    dense: Dense,
    given: GivenViews,
    count: int,
    select: SelectConfig,
    size: int | None,
    share: float = 1.0,
    learns: bool = True,
    weigh: Callable[[], Float | None] | None = None,
) -> _Mixed:
    """Add views of other kinds to training views: those that `complete` chooses, or of one kind with a focus.

    Some further views of each kind are set apart. If `given` is rough, as many views as usual are added
    instead of chosen ones.

    Args:
        share: share of the pool that is used.
        learns: whether a scene is recovered in the views; otherwise no views are added.
        weigh: of given views, returns the weights with which they are drawn, or None if equally often. The
            others are drawn as often as these on average. None for planned views, which are not crowded;
            some of these become zooms.
    """
    rough = given.rough
    usual = len(train.cameras)
    times = find_pool_growth(dense.total)
    spare = max(_LEAST_APART, round(_VIEWS_APART * times * share))
    focus = select.focus
    least = round(_TRAINING_VIEWS * times * share)
    grown = max(1.0, min(usual / (_TRAINING_VIEWS * share), _POOL_GROWTH * times))
    usual_most = round(_OFFERED_VIEWS * grown * share)
    wanted = dict.fromkeys(_OTHER_KINDS, usual_most)
    if focus == "far":
        wanted = {"near": 0}
    elif focus is not None:
        wanted = {"near": 0, focus: round(usual * select.focus_share / (1 - select.focus_share))}
    offered: list[Camera] = []
    apart: list[Camera] = []
    for kind, most in wanted.items():
        cameras = planned.more(kind, usual_most + spare)
        taken = min(usual_most, max(len(cameras) - spare, len(cameras) // 2))
        learned = cameras[:taken][:most]
        scored = cameras[taken:]  # scored alike with and without a focus
        if len(learned) < most:
            learned += _drop_same_places(planned.more(kind, most + spare), cameras)[
                : most - len(learned)
            ]
        if kind == focus and len(learned) < 0.9 * most:
            room = f"room for {len(learned)} such views, {most} are wanted"
            given.say(f"warning: --focus {kind}: the scene has {room}")
        offered += learned
        apart += scored
    others = Cameras.of(apart).fitted(size) if apart else None
    more = Cameras.of(offered) if offered and learns else None
    unseen = None
    if focus is None and more is not None:
        if rough:
            more = take_evenly(more, round(_USUAL_OTHERS * usual))
        else:
            compact, per_row = _merge_roughly(dense, count, given.progress)
            order, _, unseen = complete(
                compact,
                train.cameras,
                more,
                max(usual, least),
                least_views=least,
                represents=per_row,
                progress=given.progress,
            )
            more = more.take(order) if len(order) else None
    if more is None:
        return train, others, unseen
    own = None if rough or weigh is None else weigh()
    weights = np.ones(usual) if own is None else own / own.mean()
    mixed = ViewSet(
        Cameras.of([*train.cameras, *more]).fitted(size),
        train.notes,
        train.splits and train.splits + ("train",) * len(more),
        np.append(weights, np.ones(len(more))),
    )
    if focus is None and weigh is None and not rough:
        mixed = replace(
            mixed, cameras=zoomed(compact, mixed.cameras, represents=per_row, share=share)
        )
    return mixed, others, unseen


def _drop_same_places(views: Sequence[Camera], others: Sequence[Camera]) -> list[Camera]:
    """Return the views that stand where none of the others does, with names that these do not have."""
    places = np.array([view.position for view in others]).reshape(-1, 3)
    found = [view for view in views if not np.isclose(places, view.position).all(axis=1).any()]
    return [replace(view, name=f"{view.name} (more)") for view in found]


def _merge_roughly(dense: Dense, count: int, progress: Progress) -> tuple[Splats, float]:
    """Return a scene like a dense one merged to `count`, and the Gaussians that a row stands for."""
    prior = dense.sample
    rows = min(count, _COMPACT_ROWS, len(prior))
    if dense.total > len(prior):  # a sample's Gaussians cover for the others
        prior = replace(prior, scales=prior.scales * np.float32(np.sqrt(dense.total / len(prior))))
    small = (
        prior
        if rows == len(prior)
        else simplify(prior, rows, method="fast", progress=progress).splats
    )
    return small, count / rows


def find_or_plan_views(
    scene: Splats,
    given: GivenViews,
    *,
    count: int | None = None,
    student: Splats | None = None,
) -> Views:
    """Return given views, views found beside the scene, or a generated pool with every 8th view held out.

    Args:
        count: size of a generated pool; None chooses like `distill`.
        student: a compact scene that will be recovered in a generated pool. Views of other kinds complete it
            as in `distill`, and further ones are in the splits `test` and, for validation, `val`.
    """
    found, _ = take_or_find_views(given, scene)
    if found is not None:
        return found
    grow = _POOL_GROWTH if count is None else 1.0
    count = _POOL_VIEWS if count is None else count
    planned = _plan_views(InMemory(scene), given, count, grow=grow)
    if student is not None:
        mix = partial(
            _add_other_kinds,
            dense=InMemory(student),
            given=given,
            count=len(student),
            select=SelectConfig(),
            size=None,
        )
        made = _split_pool(planned, None, None, mix, "distil", given.say)
        assert made.pool is not None
        validation = made.validation or ()
        apart = made.apart or ()
        splits = (*made.pool.splits, *["val"] * len(validation), *["test"] * len(apart))
        return ViewSet(Cameras.of([*made.pool.cameras, *validation, *apart]), splits=splits)
    given.say(
        f"views: {len(planned.cameras)} generated; {_describe_kinds(planned, planned.cameras)}"
    )
    return ViewSet(planned.cameras, splits=splits_of(None, planned.cameras.names))


def choose_plan_size(size: Sequence[int] | None) -> tuple[int, int]:
    """Return the size to plan views at for a requested one, a longer side or width and height.

    It has the requested shape, but not its pixels, so that the same views are planned at any size.

    >>> [choose_plan_size(size) for size in (None, [1920], [1920, 1080], [600, 1200])]
    [(800, 600), (800, 600), (800, 450), (400, 800)]
    """
    if size is None or len(size) == 1:
        return _SHAPE
    width, height = (max(1, round(_SHAPE[0] * side / max(size))) for side in size)
    return width, height


def resize_views(cameras: Cameras, size: Sequence[int] | None, *, made: bool) -> Cameras:
    """Return views at a requested size, see `choose_plan_size`; only `made` ones change their shape."""
    if size is None or len(size) == 1:
        return cameras.fitted(None if size is None else size[0])
    if not made:
        raise InputError(
            "given and found views keep their shape; give one number", parameter="size"
        )
    return cameras.sized(size[0], size[1])


def is_planned(views: Views) -> bool:
    """Return whether the views of `find_or_plan_views`, given as a path or none, were generated."""
    return isinstance(views, Cameras | ViewSet)


def choose_looks(scene: Splats, count: int, given: GivenViews) -> Cameras:
    """Return the views that show a scene best, and those of a pool if `count` asks for more.

    They are chosen from the cameras of photos found beside the scene, if there are any.
    """
    photos = _find_photo_views(scene, given)
    best = best_views(scene, count, photos, size=given.shape, axis=given.up)
    if photos is None:
        given.say(f"views: {count} generated")
    if len(best) == count:
        return best
    pool = _plan_views(InMemory(scene), given, count - len(best))
    return Cameras.of([*best, *pool.cameras])


def _describe_kinds(pool: Pool, cameras: Cameras) -> str:
    """Describe the kinds of a pool, and of further views in it, briefly."""
    if pool.kind == _ROUGH:
        return _ROUGH
    kinds = [pool.kind, *(kind for kind in rows_by_kind(cameras.kinds) if kind != USUAL)]
    guess = "; the up direction is a guess" if "guess" in pool.why else ""
    return f"{' + '.join(kinds)}{guess}"


def choose_weighing_views(dense: Dense, given: GivenViews) -> Cameras | None:
    """Choose views for simplification's visibility: given, found beside the scene, or generated.

    Of given views the training split is used. None means no views.
    """
    say = given.say
    found, are_found = take_or_find_views(given, dense.sample, ["train"])
    if found is not None:
        cameras = load_views(found, "train", None, say)
        if are_found:
            return size_like_pool(cameras)
        warn_of_sight(dense.sample, cameras, say)
        return cameras
    try:
        pool = _plan_views(dense, given, _WEIGHT_VIEWS, rows=_WEIGHT_ROWS)
        others = [
            camera for kind, count in _WEIGHT_OTHERS.items() for camera in pool.more(kind, count)
        ]
        return Cameras.of([*pool.cameras, *others])
    except InputError as e:
        say(f"continuing without views: {e}")
        return None


def _plan_views(
    dense: Dense, given: GivenViews, count: int, *, rows: int = _POOL_SAMPLE, grow: float = 1.0
) -> Pool:
    """Plan a pool as `plan_pool` does, but larger in proportion to a large scene's size."""
    prior = dense.sample
    times = find_pool_growth(dense.total)
    count = round(count * times)
    if given.rough:
        return _place_stand_ins(prior, count, given.shape)
    return plan_pool(
        prior,
        count,
        size=given.shape,
        up=given.up,
        seed=given.seed,
        rows=round(rows * times),
        grow=grow,
        represents=dense.total / len(prior),
        progress=given.progress,
    )


def _place_stand_ins(scene: Splats, count: int, size: tuple[int, int]) -> Pool:
    """Return stand-ins of a pool's views on a circle around the scene."""
    points = scene.means[evenly_spaced(len(scene), _ROUGH_ROWS)] + scene.offset
    middle = np.median(points, axis=0)
    away = max(3 * float(np.quantile(np.abs(points - middle), 0.9)), np.finfo(np.float32).tiny)

    def stand_around(kind: str, count: int) -> list[Camera]:
        turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
        eyes = middle + away * np.stack([np.cos(turns), np.sin(turns), np.zeros(count)], axis=1)
        views = (Camera.facing(eye, middle, width=size[0], height=size[1]) for eye in eyes)
        return [replace(view, name=f"{kind}_{row:04}", kind=kind) for row, view in enumerate(views)]

    usual = Cameras.of(stand_around(USUAL, count))
    return Pool(usual, _ROUGH, "", np.array([0.0, 0.0, 1.0]), more=stand_around)


def find_pool_growth(count: float) -> float:
    """Return the growth factor of the pool for a scene of `count` Gaussians."""
    return max(1.0, count / _POOL_GAUSSIANS)


@checks_arguments
def orbit(
    scene: Splats,
    count: AtLeastOne = 48,
    *,
    size: tuple[int, int] = (800, 600),
    up: Sequence[float] | None = None,
    beside: str | Path | None = None,
    say: Say = unsaid,
) -> Cameras:
    """Return views at equal angles that begin with the best one, like `g2ard render --orbit`.

    An object or a map is circled, with all of it in each frame. In a room the camera turns in place. A scene
    of photos is circled around what the best photo has in the middle, to and fro if one side has no photos.

    Args:
        scene: the scene.
        count: number of views; the one after the last would be the first again.
        size: width and height, pixels.
        up: (3,) direction away from the ground; None estimates it.
        beside: path beside which to look for photos; None looks for none.
        say: called with the estimated up direction.

    Returns:
        The views, in order.

    Raises:
        InputError: the scene is not visible, or no free place sees it.

    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> len(orbit(scene, 4, size=(64, 48)))
    4
    """
    photos = _find_photo_views(scene, GivenViews(None, beside, up, shape=size, say=say))
    level = find_shared_up(photos) if up is None and photos is not None else None
    views, axis = turntable(scene, count, photos, size=size, axis=up if level is None else level)
    if up is None:
        say(f"up: {direction(axis)}, estimated; --up X,Y,Z sets it")
    return views


def _find_photo_views(scene: Splats, given: GivenViews) -> Cameras | None:
    """Return cameras at the poses of the photos of a run, or of those beside a scene, if there are any."""
    beside = given.beside
    found: Views | None = None if beside is None else run_views(beside)
    if found is None or found == Path(str(beside)):
        found, _ = take_or_find_views(replace(given, views=None), scene)
    cameras = None if found is None else load_views(found, "all", None)
    if cameras is None or not any(cameras.image_paths):
        return None
    given.say(f"views: from {plural(len(cameras), 'photo')} of {found}")
    bare = replace(cameras, image_paths=(), mask_paths=(), lenses=(), distortions=np.zeros((0, 5)))
    return bare.scaled(max(given.shape))
