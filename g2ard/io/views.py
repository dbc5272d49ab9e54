"""g2ard's own views .json: what `poses`, `select` and `distill` write. docs/formats.md describes it."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.jsonfile import fields_of, numbers, read_json
from g2ard.io.paths import real_path
from g2ard.io.photos import Frame, pixels, rigid, view_set
from g2ard.io.types import ViewSet
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras

__all__ = ["read", "write"]

_FORMAT = "g2ard-views"
_VERSION = 1


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read views; photo paths are relative to the file.

    Args:
        path: the JSON.
        images: a folder to look for photos in, by their file names, instead.

    Raises:
        InputError: another format or version, no views, or a view that makes no sense.
    """
    content = read_json(path)
    if content.get("format") != _FORMAT:
        raise InputError(f"not g2ard's views ('format' is {content.get('format')!r})", path=path)
    if content.get("version") != _VERSION:
        raise InputError(f"version {content.get('version')!r} is not known ({_VERSION} is)", path=path)
    views = content.get("views")
    if not isinstance(views, list) or not views:
        raise InputError("no views found ('views' is empty)", path=path)
    return view_set(path, [_frame(path, i, view, images) for i, view in enumerate(views)])


def _frame(path: Path, index: int, entry: Any, images: Path | None) -> Frame:
    where = f"{path}: view {index}"
    with fields_of(where, entry) as view:
        photo = view.get("image")
        if photo is not None:
            photo = images / Path(photo).name if images else path.parent / photo
        mask = view.get("mask")
        weight = view.get("weight")
        if weight is not None and not (np.isfinite(weight) and weight >= 0):
            raise InputError(f"weight {weight!r} is not a number ≥ 0", path=where)
        split, name = view.get("split"), view["name"]
        if not isinstance(name, str):
            raise InputError(f"name {name!r} is not a string", path=where)
        if split is not None and not isinstance(split, str):
            raise InputError(f"split {split!r} is not a string", path=where)
        return Frame(
            name=name,
            viewmat=_exact(where, np.array(view["camera_from_world"], np.float64)),
            K=np.array(numbers(view, "K", 3, 3)),
            size=(pixels(where, view, "width"), pixels(where, view, "height")),
            photo=photo,
            mask=None if mask is None else path.parent / mask,
            distortion=tuple(map(float, (*view.get("distortion", ()), 0, 0, 0, 0, 0)[:5])),
            split=split,
            weight=weight,
        )


def _exact(where: str, matrix: Any) -> Any:
    """The matrix as it stands where it is rigid to rounding, so that writing and reading change no bit."""
    nearest = rigid(where, matrix)
    return matrix if matrix.shape == (4, 4) and np.allclose(nearest, matrix, rtol=0, atol=1e-9) else nearest


def write(
    path: Path,
    cameras: Cameras,
    *,
    splits: Sequence[str | None] = (),
    weights: ArrayLike | None = None,
    overwrite: bool = False,
) -> None:
    """Write views, one line each, every float to its last bit.

    Args:
        path: the .json to write.
        cameras: C views.
        splits: per view "train", "test" or None; () for none.
        weights: (C,) how often each view should be drawn, NaN where a view states none; None for none.
        overwrite: whether an existing file may be replaced.

    Raises:
        OutputError: see `atomic_output`.
        InputError: no views, or splits or weights of another length.
    """
    count = len(cameras)
    given = np.full(count, np.nan) if weights is None else np.asarray(weights, np.float64)
    drawn = [None if np.isnan(weight) else weight for weight in given.tolist()]
    parts = list(splits) or [None] * count
    if not count or len(parts) != count or len(drawn) != count:
        raise InputError(
            f"{plural(count, 'view')}, {len(parts)} splits and {len(drawn)} weights do not fit", path=path
        )
    lines = []
    for i in range(count):
        view: dict[str, Any] = {
            "name": cameras.names[i],
            "width": int(cameras.widths[i]),
            "height": int(cameras.heights[i]),
            "K": cameras.Ks[i].tolist(),
            "camera_from_world": cameras.viewmats[i].tolist(),
            "distortion": cameras.distortions[i].tolist() if cameras.distortions[i].any() else None,
            "image": _relative(cameras.image_paths[i], path),
            "mask": _relative(cameras.mask_paths[i], path),
            "split": parts[i],
            "weight": drawn[i],
        }
        lines.append(json.dumps({key: value for key, value in view.items() if value is not None}))
    head = f'{{"format": "{_FORMAT}", "version": {_VERSION}, "views": [\n'
    with atomic_output(path, overwrite) as temporary:
        temporary.write_text(head + ",\n".join(lines) + "\n]}\n", encoding="utf-8")


def _relative(photo: Path | None, path: Path) -> str | None:
    if photo is None:
        return None
    try:
        return Path(os.path.relpath(real_path(photo), real_path(path.parent))).as_posix()
    except ValueError:  # another drive on Windows
        return real_path(photo).as_posix()
