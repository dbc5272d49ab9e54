"""Views of a run: given, found beside the scene, or made; and those of another kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.policy.inputs import drop_held_out, load_for_training, load_held_out, load_view_sets, load_views
from g2ard.policy.view_checks import as_pool, check_sight, found_views, warn_of_sight
from g2ard.progress import Progress, Say, silent, unsaid

if TYPE_CHECKING:
    from g2ard.io import ViewSet
    from g2ard.policy.inputs import Views
    from g2ard.poses import Pool
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

    Up = Sequence[float] | None

_POOL, _GROW, _NEAR = 160, 2.0, 0.25
"""Poses of a pool made for a scene without views, how many times as many there may be where a view holds
little of it, and the most that step nearer; every 8th is held out for scoring."""
_APART = 24
"""Views of another kind: half of them validate recovery, half are scored."""
_POOL_GAUSSIANS = 4_000_000
"""Gaussians in tiles for which such a pool is made; for more of these, more of those."""
_ROWS = 200_000
"""Gaussians that poses are planned on."""

_LOOKS, _LOOK_ROWS = 96, 100_000
"""Poses of a pool that simplification looks from, as many of them are used as the scene needs, and Gaussians
that those are planned on."""


@dataclass(frozen=True, eq=False)
class RunViews:
    """What a run looks at.

    Args:
        train: to recover from.
        test: of their kind, for scoring.
        apart: of another kind, nearer; None where none can be made.
        pool: all of a pool made for the scene, to be written beside the result.
        unseen: share of a sample of the scene's matter that no view of that pool sees.
    """

    train: ViewSet
    test: Cameras
    apart: Cameras | None = None
    pool: ViewSet | None = None
    unseen: float | None = None

    def resized(self, longest: int) -> RunViews:
        """Return the same views for training and scoring, shrunk."""
        apart = self.apart and self.apart.resized(longest)
        return replace(self, train=self.train.resized(longest), test=self.test.resized(longest), apart=apart)


def is_made(views: object) -> bool:
    """Whether views are asked to be made, rather than given."""
    return isinstance(views, str) and views == "made"


def views_of(
    prior: Splats,
    views: Views | None,
    held_out: Views | None = None,
    *,
    beside: str | Path | None = None,
    size: int | None = None,
    up: Up = None,
    seed: int = 0,
    teach: bool = True,
    represents: float = 1.0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> RunViews:
    """Views for recovery and for scoring.

    Args:
        prior: the dense scene.
        views: cameras, or where they lie; None takes those that lie beside the scene, else a pool of its own;
            "made" is that pool.
        held_out: views to score on; None holds out the test split of `views`, of a pool every 8th.
        beside: where the scene lies, if cameras are to be looked for there.
        size: pixels that the longer side of a view is shrunk to; None leaves it.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        seed: of poses that are made.
        teach: the scene can be rendered: into views without a photo beside others, which are left out else,
            and into other views than those given.
        represents: of a fair sample of a scene: how many Gaussians each of its rows stands for. The pool of a
            scene too large for memory grows with it.
        progress: told of planning.
        say: told what is looked at, and why.

    Raises:
        InputError: a file without views, an empty split, views that see nothing of the scene, a scene with
            no room for poses, or a pool where the targets are photos.
    """
    from g2ard.errors import InputError
    from g2ard.io import ViewSet
    from g2ard.scene.splits import split_mask, splits_of

    found = None
    if views is None and beside is not None:
        wanted = ["train"] if held_out is not None else ["train", "test"]
        found = views = found_views(beside, prior, wanted, say)
    if views is not None and not is_made(views):
        if held_out is None:
            train, test = load_view_sets(views, ["train", "test"], size, say, unpictured=teach)
        else:
            train = load_for_training(views, size, say, unpictured=teach)
            test = load_held_out(held_out, size, say, unpictured=teach)
            train = drop_held_out(train, test.cameras, say)
        if not found:
            check_sight(prior, train.cameras, say)
        if found and not size:
            train, test = (replace(part, cameras=as_pool(part.cameras)) for part in (train, test))
        apart = _near(prior, size, up, seed, progress, represents) if teach else None
        return RunViews(train, test.cameras, apart)
    if not teach:
        raise InputError(
            "generated views have no photos", parameter="photos", hint="give {views} that have them"
        )
    held = None if held_out is None else load_held_out(held_out, size, say, unpictured=teach)
    planned = _planned(prior, _POOL, up, seed, progress, _GROW, represents)
    apart = planned.apart and planned.apart.resized(size)
    names = planned.cameras.names
    say(f"poses: {_of(planned)}")
    if held is not None:
        pool = ViewSet(planned.cameras, splits=("train",) * len(names))
        train = drop_held_out(pool.resized(size), held.cameras, say)
        return RunViews(train, held.cameras, apart, pool, planned.unseen)
    pool = ViewSet(planned.cameras, splits=splits_of(None, names))
    mask = split_mask(None, names, "test")
    train = pool.take(~mask).resized(size)
    return RunViews(train, pool.take(mask).resized(size).cameras, apart, pool, planned.unseen)


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
    """Views to render, score or learn from: those given, else those beside the scene, else a pool as
    `distill` makes it, every 8th of it held out.

    Args:
        scene: the dense scene.
        count: poses of a generated pool; None for as many as `distill` makes.

    The others are as for `views_of`.

    Raises:
        InputError: a scene with no room for poses.
    """
    from g2ard.io import ViewSet
    from g2ard.poses import plan_pool
    from g2ard.scene.splits import splits_of

    if views is not None and not is_made(views):
        return views
    if views is None and beside is not None and (found := found_views(beside, scene, [], say)):
        return found
    if count is None:
        planned = _planned(scene, _POOL, up, seed, progress, _GROW)
    else:
        planned = plan_pool(scene, count, up=up, seed=seed, rows=_ROWS, progress=progress)
    say(f"poses: {_of(planned)}")
    return ViewSet(planned.cameras, splits=splits_of(None, planned.cameras.names))


def _of(pool: Pool) -> str:
    """A pool in a few words; `g2ard poses` tells why it is of that kind."""
    guess = "; which way is up is a guess" if "guess" in pool.why else ""
    return f"{len(pool.cameras)}, {pool.kind}{guess}"


def cameras_for_looks(
    scene: Splats,
    views: Views | None,
    method: str,
    *,
    beside: str | Path | None = None,
    up: Up = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Cameras | None:
    """The views that simplification looks from: those given, else those beside the scene, else a few of its
    own where it leaves room for them.

    Args:
        scene: the dense scene.
        views: as for `views_of`; of a split, those for training.
        method: `fast` uses only views that are given or requested, `paper` none.

    The others are as for `views_of`.

    Raises:
        InputError: a file without views, or an empty split.
    """
    from g2ard.errors import InputError
    from g2ard.poses import plan_pool

    made = is_made(views)
    if method == "paper" and views is not None:
        say("paper uses no views")
    if method == "paper" and made:
        return None
    if views is None and beside is not None and method == "default":
        found = found_views(beside, scene, ["train"], say)
        if found:
            return as_pool(load_views(found, "train", None, say))
    if views is not None and not made:
        given = load_views(views, "train", None, say)
        warn_of_sight(scene, given, say)
        return given
    if method != "default" and not made:
        return None
    try:
        pool = plan_pool(
            scene, _LOOKS, up=up, seed=seed, rows=_LOOK_ROWS, near=_NEAR, looks=True, progress=progress
        )
    except InputError as e:
        say(f"goes on without views: {e}")
        return None
    return pool.cameras


def _planned(
    prior: Splats,
    count: int,
    up: Up,
    seed: int,
    progress: Progress,
    grow: float = 1.0,
    represents: float = 1.0,
) -> Pool:
    """A pool of `count` views or up to `grow` times as many, and views of another kind."""
    from g2ard.poses import plan_pool

    times = pool_times(len(prior) * represents) if represents > 1 else 1.0
    return plan_pool(
        prior,
        round(count * times),
        up=up,
        seed=seed,
        rows=round(_ROWS * times),
        apart=round(_APART * times),
        grow=grow,
        near=_NEAR,
        represents=represents,
        progress=progress,
    )


def pool_times(count: float) -> float:
    """How many times the usual views are made for a scene of `count` Gaussians in tiles."""
    return max(1.0, count / _POOL_GAUSSIANS)


def _near(
    prior: Splats, size: int | None, up: Up, seed: int, progress: Progress, represents: float
) -> Cameras | None:
    """Views of another kind beside those that were given; None where the scene has no place for any."""
    from g2ard.errors import InputError

    try:
        apart = _planned(prior, _APART, up, seed, progress, represents=represents).apart
    except InputError:
        return None
    return apart and apart.resized(size)
