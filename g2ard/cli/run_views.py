"""Views of a `g2ard distill`: given, found beside the scene, or made; and those of another kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.cli.found import as_pool, found_views
from g2ard.cli.frame import Run
from g2ard.cli.options import Triple, is_made
from g2ard.cli.scenes import drop_held_out, load_for_training, load_held_out, load_view_sets

if TYPE_CHECKING:
    from g2ard.cameras import Cameras
    from g2ard.io import ViewSet
    from g2ard.poses import Pool
    from g2ard.splats import Splats

__all__ = ["RunViews", "views_of"]

_POOL, _GROW, _NEAR = 160, 2.0, 0.25
"""Poses of a pool made for a scene without views, how many times as many there may be where a view holds
little of it, and the most that step nearer; every 8th is held out for scoring."""
_APART = 24
"""Views of another kind: half of them validate recovery, half are scored."""
_ROWS = 200_000
"""Gaussians that poses are planned on."""


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


def views_of(
    run: Run,
    scene: Path,
    prior: Splats,
    views: Path | None,
    held_out: Path | None,
    size: int | None,
    up: Triple | None,
    *,
    teach: bool,
) -> RunViews:
    """Views for recovery and for scoring; `teach`: the scene can be rendered into others than those given."""
    from g2ard.io import ViewSet
    from g2ard.splits import split_mask, splits_of

    found = None
    if views is None:
        found = views = found_views(run, scene, prior, ["train"] if held_out else ["train", "test"])
    if views is not None and not is_made(views):
        if held_out is None:
            train, test = load_view_sets(run, views, ["train", "test"], size)
        else:
            train, test = load_for_training(run, views, size), load_held_out(run, held_out, size)
            train = drop_held_out(run, train, test.cameras)
        if found and not size:
            train, test = (replace(part, cameras=as_pool(part.cameras)) for part in (train, test))
        return RunViews(train, test.cameras, _near(run, prior, size, up) if teach else None)
    held = None if held_out is None else load_held_out(run, held_out, size)
    planned = _planned(run, prior, _POOL, up, _GROW)
    apart = planned.apart and planned.apart.resized(size)
    names = planned.cameras.names
    run.say(f"poses: {planned.kind} ({planned.why})")
    if held is not None:
        pool = ViewSet(planned.cameras, splits=("train",) * len(names))
        train = drop_held_out(run, pool.resized(size), held.cameras)
        return RunViews(train, held.cameras, apart, pool, planned.unseen)
    pool = ViewSet(planned.cameras, splits=splits_of(None, names))
    mask = split_mask(None, names, "test")
    train = pool.take(~mask).resized(size)
    return RunViews(train, pool.take(mask).resized(size).cameras, apart, pool, planned.unseen)


def _planned(run: Run, prior: Splats, count: int, up: Triple | None, grow: float = 1.0) -> Pool:
    """A pool of `count` views or up to `grow` times as many, and views of another kind."""
    from g2ard.poses import plan_pool

    return plan_pool(
        prior,
        count,
        up=up,
        seed=run.seed,
        rows=_ROWS,
        apart=_APART,
        grow=grow,
        near=_NEAR,
        progress=run.progress,
    )


def _near(run: Run, prior: Splats, size: int | None, up: Triple | None) -> Cameras | None:
    """Views of another kind beside those that were given; None where the scene has no place for any."""
    from g2ard.errors import InputError

    try:
        apart = _planned(run, prior, _APART, up).apart
    except InputError:
        return None
    return apart and apart.resized(size)
