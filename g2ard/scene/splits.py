"""Which views are for training and which are held out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import read_json
from g2ard.io.paths import real_path

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras

HOLD_OUT = 8
"""Without a split file every 8th name is test, as in Mip-NeRF 360's and INRIA's evaluations."""


def split_mask(
    views: str | Path | None, names: Sequence[str], which: str, *, stated: Sequence[str | None] = ()
) -> NDArray[np.bool_]:
    """Which of the views belong to a split.

    The views' own statement wins, then a split.json beside them ({"train": [names], "test": [names]}, any
    further keys), then the rule: sorted by name, every 8th from the first on is test, the others train.

    Args:
        views: the file or folder the views come from; None where there is none, and the rule holds.
        names: C view names. A split file may leave out their suffix or folder.
        which: "train", "test", "all", or another key of the split file.
        stated: per view the split it states itself, None where it states none; () if none does.

    Returns:
        (C,) bool.

    Raises:
        InputError: the split is unknown or has none of the views.

    >>> split_mask("nowhere", ["b", "a", "c"], "test").tolist()
    [False, True, False]
    """
    if which == "all":
        return np.ones(len(names), bool)
    masks = _masks(views, names, stated)
    if which not in masks:
        raise InputError(f"no split {which!r} (there are {', '.join(sorted(masks))})", path=views)
    if not masks[which].any():
        of = "its only view is not" if len(names) == 1 else f"none of its {len(names)} views is"
        raise InputError(f"{of} in split {which!r}; a split.json beside them can say which are", path=views)
    return masks[which]


def states_splits(views: str | Path | None, stated: Sequence[str | None] = ()) -> bool:
    """Whether views say their splits, themselves or by a split.json beside them; see `split_mask`.

    Raises:
        InputError: a split file that is broken.
    """
    return any(stated) or (views is not None and _split_file(Path(views)) is not None)


def splits_of(
    views: str | Path | None, names: Sequence[str], stated: Sequence[str | None] = ()
) -> tuple[str | None, ...]:
    """The split each view belongs to, by the rules of `split_mask`: what to write so that it travels along.

    Args:
        views: as for `split_mask`.
        names: C view names.
        stated: as for `split_mask`.

    Returns:
        C words, None for a view that is in no split. Of a view in several, "test" counts before "train", and
        both before others by name.

    Raises:
        InputError: as `split_mask`, for a split file that is broken.

    >>> splits_of("nowhere", ["b", "a", "c"])
    ('train', 'test', 'train')
    """
    masks = _masks(views, names, stated)
    order = sorted(masks, key=lambda word: (word != "test", word != "train", word))
    return tuple(next((word for word in order if masks[word][i]), None) for i in range(len(names)))


def for_training(
    views: str | Path | None, names: Sequence[str], stated: Sequence[str | None] = ()
) -> NDArray[np.bool_]:
    """Which views may be trained on where scores are taken on other views: the train split of views that
    state splits (themselves, or by a split.json), else all.

    Args:
        views: as for `split_mask`.
        names: C view names.
        stated: as for `split_mask`.

    Returns:
        (C,) bool.

    Raises:
        InputError: splits are stated, and none is "train".
    """
    return split_mask(views, names, "train" if states_splits(views, stated) else "all", stated=stated)


def for_scores(
    views: str | Path | None, names: Sequence[str], stated: Sequence[str | None] = ()
) -> NDArray[np.bool_]:
    """Which views a file given for scoring alone scores on: all but those that it states as "train".

    Args:
        views: as for `split_mask`.
        names: C view names.
        stated: as for `split_mask`.

    Returns:
        (C,) bool.

    Raises:
        InputError: it states all of them as "train".
    """
    if not states_splits(views, stated):
        return np.ones(len(names), bool)
    mask = np.array([split != "train" for split in splits_of(views, names, stated)], bool)
    if not mask.any():
        raise InputError(
            f"all of its {len(names)} views are for training, none is left to score on; name views "
            "with a test split",
            path=views,
        )
    return mask


def _masks(
    views: str | Path | None, names: Sequence[str], stated: Sequence[str | None]
) -> dict[str, NDArray[np.bool_]]:
    """Split → (C,) bool: as stated, else as a split.json lists them, else by the rule."""
    if any(stated):
        return {word: np.array([s == word for s in stated], bool) for word in {s for s in stated if s}}
    listed = None if views is None else _split_file(Path(views))
    if listed is None:
        test = np.zeros(len(names), bool)
        test[sorted(range(len(names)), key=lambda i: names[i])[::HOLD_OUT]] = True
        return {"train": ~test, "test": test}
    masks = {word: _listed(names, wanted) for word, wanted in listed.items()}
    both = masks["train"] & masks["test"] if {"train", "test"} <= set(masks) else np.zeros(len(names), bool)
    if both.any():
        raise InputError(
            f"split.json lists {names[int(np.argmax(both))]!r} as both train and test", path=views
        )
    return masks


def _split_file(views: Path) -> dict[str, list[str]] | None:
    """split.json in the views' folder; for a COLMAP model also above sparse/0."""
    folder = views if views.is_dir() else views.parent
    places = [folder, *(folder.parents[:2] if folder.name == "0" or folder.name == "sparse" else ())]
    path = next((p for place in places if (p := place / "split.json").is_file()), None)
    if path is None:
        return None
    content: dict[str, Any] = read_json(path)
    lists = {key: value for key, value in content.items() if isinstance(value, list)}
    if not lists or not all(isinstance(name, str) for value in lists.values() for name in value):
        raise InputError(
            'expected lists of names, as in {{"train": ["a.jpg"], "test": ["b.jpg"]}}', path=path
        )
    return lists


def _listed(names: Sequence[str], wanted: Sequence[str]) -> NDArray[np.bool_]:
    """By stem, so that suffix and folder may differ, unless stems do not tell the views apart."""
    stems = [PurePosixPath(name).stem for name in names]
    if len(set(stems)) < len(stems):
        exact = set(wanted)
        return np.array([name in exact for name in names], bool)
    chosen = {PurePosixPath(name).stem for name in wanted}
    return np.array([stem in chosen for stem in stems], bool)


def not_held_out(cameras: Cameras, held_out: Cameras) -> NDArray[np.bool_]:
    """Which views are none of the held-out ones, by photo or, exactly, by pose.

    Args:
        cameras: C views to train on.
        held_out: views to score on, of another file.

    Returns:
        (C,) bool.
    """
    photos = {real_path(path) for path in held_out.image_paths if path is not None}
    poses = {view.tobytes() for view in np.round(held_out.viewmats, 9) + 0.0}
    mine = np.round(cameras.viewmats, 9) + 0.0
    return np.array(
        [
            (path is None or real_path(path) not in photos) and view.tobytes() not in poses
            for path, view in zip(cameras.image_paths, mine, strict=True)
        ],
        bool,
    )
