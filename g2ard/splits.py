"""Which views are for training and which are held out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import read_json

__all__ = ["HOLD_OUT", "split_mask", "split_names"]

HOLD_OUT = 8
"""Without a split file every 8th name is test, as in Mip-NeRF 360's and INRIA's evaluations."""


def split_mask(
    views: str | Path, names: Sequence[str], which: str, *, stated: Sequence[str | None] = ()
) -> NDArray[np.bool_]:
    """Which of the views belong to a split.

    The views' own statement wins, then a split.json beside them ({"train": [names], "test": [names]}, any
    further keys), then the rule: sorted by name, every 8th from the first on is test, the others train.

    Args:
        views: the file or folder the views come from.
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
    listed = None if any(stated) else _split_file(Path(views))
    if any(stated):
        known, mask = sorted({s for s in stated if s}), np.array([s == which for s in stated], bool)
    elif listed is not None:
        known, mask = sorted(listed), _listed(names, listed.get(which, []))
    else:
        order = sorted(range(len(names)), key=lambda i: names[i])
        known, test = ["test", "train"], np.zeros(len(names), bool)
        test[order[::HOLD_OUT]] = True
        mask = test if which == "test" else ~test
    if which not in known:
        raise InputError(f"{views}: no split {which!r} (there are {', '.join(known)})")
    if not mask.any():
        raise InputError(f"{views}: none of the {len(names)} views is in split {which!r}")
    return mask


def split_names(views: str | Path, names: Sequence[str], which: str) -> list[str]:
    """The names of a split, in the order of `names`; see `split_mask`.

    >>> split_names("nowhere", ["b", "a", "c"], "train")
    ['b', 'c']
    """
    mask = split_mask(views, names, which)
    return [name for name, chosen in zip(names, mask, strict=True) if chosen]


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
        raise InputError(f'{path}: expected lists of names, as in {{"train": ["a.jpg"], "test": ["b.jpg"]}}')
    return lists


def _listed(names: Sequence[str], wanted: Sequence[str]) -> NDArray[np.bool_]:
    """By stem, so that suffix and folder may differ, unless stems do not tell the views apart."""
    stems = [PurePosixPath(name).stem for name in names]
    if len(set(stems)) < len(stems):
        exact = set(wanted)
        return np.array([name in exact for name in names], bool)
    chosen = {PurePosixPath(name).stem for name in wanted}
    return np.array([stem in chosen for stem in stems], bool)
