"""Splits of views into training and held-out ones."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from g2ard.arrays import Mask
from g2ard.errors import InputError
from g2ard.io.colmap import model_folder
from g2ard.io.finding import usable
from g2ard.io.jsonfile import read_json
from g2ard.io.paths import content_hash, read_text, real_path
from g2ard.io.types import Splits
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import photo_of

Views = str | Path | None
"""File or folder of views, beside which files of splits may be; None without one."""

HOLD_OUT = 8
"""Without a split file every 8th name is in the test split, as in Mip-NeRF 360's and INRIA's evaluations."""


def split_mask(
    views: Views,
    names: Sequence[str],
    which: str,
    *,
    stated: Splits = (),
) -> Mask:
    """Return the mask of views in a split.

    Splits come from the views themselves, otherwise from a split.json beside them ({"train": [names], "test":
    [names]}, and further keys), otherwise from a test.txt or train.txt there, a name per line, otherwise from
    the rule: sorted by name, every 8th starting with the first is "test", the others "train".

    Args:
        views: the file or folder of the views; None applies the rule.
        names: C view names. A split file may omit their suffix or folder.
        which: "train", "test", "all", or another key of the split file.
        stated: split stated by each view or None; () if none is stated.

    Returns:
        (C,) bool.

    Raises:
        InputError: the split is unknown or empty.

    >>> split_mask("nowhere", ["b", "a", "c"], "test").tolist()
    [False, True, False]
    """
    if which == "all":
        return np.ones(len(names), bool)
    masks = _masks(views, names, stated)
    if which not in masks:
        raise InputError(f"no split {which!r} (there are {', '.join(sorted(masks))})", path=views)
    if not masks[which].any():
        of = f"none of its {len(names)} views is"
        if len(names) == 1:
            of = "its only view is not"
        text = f"{of} in split {which!r}; add a split.json that says which are"
        raise InputError(text, path=views)
    return masks[which]


def states_splits(views: Views, stated: Splits = ()) -> bool:
    """Return whether splits are stated by views or by a split.json beside them, see `split_mask`."""
    if any(stated) or views is None:
        return any(stated)
    path = Path(views)
    return _read_split(path) is not None or _read_apart(path) is not None


def splits_of(
    views: Views,
    names: Sequence[str],
    stated: Splits = (),
) -> tuple[str | None, ...]:
    """Return the split of each view by the rules of `split_mask`, or None, for writing it with the views.

    For a view in several splits, "test" comes before "train", and both before others by name.

    >>> splits_of("nowhere", ["b", "a", "c"])
    ('train', 'test', 'train')
    """
    masks = _masks(views, names, stated)
    splits: list[str | None] = [None] * len(names)
    last = {"train", "test"}
    words = sorted(masks.keys() - last, reverse=True)
    for word in [*words, "train", "test"]:
        for i in np.flatnonzero(masks.get(word, ())):
            splits[i] = word
    return tuple(splits)


def for_training(views: Views, names: Sequence[str], stated: Splits = ()) -> Mask:
    """Return the (C,) mask of views to train on when other views are scored: "train" if splits are stated,
    otherwise all. Arguments are those of `split_mask`.
    """
    which = "all"
    if states_splits(views, stated):
        which = "train"
    return split_mask(views, names, which, stated=stated)


def for_scores(views: Views, names: Sequence[str], stated: Splits = ()) -> Mask:
    """Return the (C,) mask of views to score on in a file for scoring: all except those stated as "train".

    Arguments are those of `split_mask`.
    """
    if not states_splits(views, stated):
        return np.ones(len(names), bool)
    splits = splits_of(views, names, stated)
    mask = np.array([split != "train" for split in splits], bool)
    if not mask.any():
        text = f"all of its {len(names)} views are for training; pass views with a test split"
        raise InputError(text, path=views)
    return mask


def _masks(views: Views, names: Sequence[str], stated: Splits) -> dict[str, Mask]:
    """Return split → (C,) mask: as stated, as listed in split.json, or by the rule."""
    if any(stated):
        words = {word for word in stated if word}
        return {word: np.array([own == word for own in stated], bool) for word in words}
    listed = None
    apart = None
    if views is not None:
        listed = _read_split(Path(views))
        if listed is None:
            apart = _read_apart(Path(views))
    if apart is not None:
        split, wanted = apart
        mask = _listed(names, wanted)
        if mask.any():
            return {split: mask, _OTHER_SPLIT[split]: ~mask}
    if listed is None:
        photos = [photo_of(name) for name in names]
        held = set(sorted(set(photos))[::HOLD_OUT])
        test = np.array([photo in held for photo in photos], bool)
        return {"train": ~test, "test": test}
    masks = {word: _listed(names, wanted) for word, wanted in listed.items()}
    none = np.zeros(len(names), bool)
    both = masks.get("train", none) & masks.get("test", none)
    if both.any():
        name = names[int(np.argmax(both))]
        text = f"split.json lists {name!r} as both train and test"
        raise InputError(text, path=views)
    return masks


_OTHER_SPLIT = {"train": "test", "test": "train"}


def split_files(views: Path) -> list[Path]:
    """Return the files with splits that are beside views, see `split_mask`."""
    places = _places(views)
    model = model_folder(views)
    if model:
        places.append(model)
    files = [place / name for place in places for name in _SPLIT_FILES]
    return list(filter(usable, files))


_SPLIT_FILES = ("split.json", "test.txt", "train.txt")


def _read_split(views: Path) -> dict[str, list[str]] | None:
    """Read split.json from the views' folder; for a COLMAP model in sparse/ or sparse/N also from the folders
    above it, up to that of sparse/."""
    files = (place / "split.json" for place in _places(views))
    path = next(filter(Path.is_file, files), None)
    if path is None:
        return None
    content: dict[str, Any] = read_json(path)
    lists = {key: value for key, value in content.items() if isinstance(value, list)}
    names = [name for value in lists.values() for name in value]
    if not lists or not all(isinstance(name, str) for name in names):
        text = 'expected lists of names, as in {"train": ["a.jpg"], "test": ["b.jpg"]}'
        raise InputError(text, path=path)
    return lists


def _read_apart(views: Path) -> tuple[str, list[str]] | None:
    """Return the split and the names of a test.txt or train.txt beside the tables of a COLMAP model, where
    INRIA's trainer has it, or beside the views."""
    places = _places(views)
    model = model_folder(views)
    if model:
        places.insert(0, model)
    for place in places:
        for split in ("test", "train"):
            file = place / f"{split}.txt"
            if usable(file):
                lines = map(str.strip, read_text(file).splitlines())
                return split, list(filter(None, lines))
    return None


def _places(views: Path) -> list[Path]:
    folder = views if views.is_dir() else views.parent
    if folder.name.isdecimal() and folder.parent.name == "sparse":
        above = 2
    else:
        above = int(folder.name == "sparse")
    return [folder, *folder.parents[:above]]


def _listed(names: Sequence[str], wanted: Sequence[str]) -> Mask:
    """Match names by stem, so that suffix and folder may differ, unless stems are ambiguous."""
    photos = [photo_of(name) for name in names]
    stems = [PurePosixPath(name).stem for name in photos]
    if len(set(stems)) < len(set(photos)):
        exact = set(wanted)
        pairs = zip(names, photos, strict=True)
        return np.array([not exact.isdisjoint(pair) for pair in pairs], bool)
    chosen = {PurePosixPath(name).stem for name in wanted}
    return np.array([stem in chosen for stem in stems], bool)


def not_held_out(cameras: Cameras, held_out: Cameras) -> Mask:
    """Return the (C,) mask of views that are not held out: no view held out has their photo, a copy of it, or
    their pose."""
    alike = same_photos(cameras.image_paths, held_out.image_paths, copies=True)
    places = np.concatenate([cameras.positions, held_out.positions])
    rounding = np.finfo(float).eps * np.abs(places).max()
    slack = _SAME_POSE * np.ptp(places, axis=0).max() + rounding
    turns = cameras.viewmats[:, :3, :3]
    poses = zip(held_out.positions, held_out.viewmats[:, :3, :3], strict=True)
    for place, turn in poses:
        near = np.abs(cameras.positions - place) <= slack
        parallel = np.abs(turns - turn) <= _SAME_POSE
        alike |= near.all(1) & parallel.all((1, 2))
    return ~alike


_SAME_POSE = 1e-6
"""Difference of rotations, and of positions as a share of their extent, that single precision may make."""


def same_photos(
    files: Sequence[Path | None],
    others: Sequence[Path | None],
    *,
    copies: bool = False,
) -> Mask:
    """Return whether each photo is one of `others`, by whatever name; with `copies`, also by content."""
    known = {real_path(path) for path in others if path is not None}
    alike = np.array([path is not None and real_path(path) in known for path in files], bool)
    if not copies:
        return alike
    present = [path for path in known if _size(path) is not None]
    sizes = set(map(_size, present))
    hashes = set[str]()
    for row, path in enumerate(files):
        if path is None or alike[row] or _size(path) not in sizes:
            continue
        hashes = hashes or set(map(content_hash, present))
        alike[row] = content_hash(path) in hashes
    return alike


def _size(path: Path) -> int | None:
    if not path.is_file():
        return None
    return path.stat().st_size
