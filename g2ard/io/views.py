"""Reader and writer for g2ard's views .json, described in docs/formats.md."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.errors import InputError
from g2ard.io import jsonfile
from g2ard.io.atomic import atomic_output
from g2ard.io.camera_files import beside
from g2ard.io.photos import Frame, Lens, rigid, view_set
from g2ard.io.types import ViewSet
from g2ard.progress import plural
from g2ard.scene.cameras import USUAL, Cameras

_FORMAT = "g2ard-views"
_VERSION = 1


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read views; photo paths are relative to the file unless `images`, a folder of photos, is given."""
    content = jsonfile.read_json(path)
    if content.get("format") != _FORMAT:
        raise InputError(f"is {content.get('format')!r}, expected {_FORMAT!r}", path=path, property="format")
    if content.get("version") != _VERSION:
        raise InputError(f"unsupported version {content.get('version')!r}; expected {_VERSION}", path=path)
    views = content.get("views")
    if not isinstance(views, list) or not views:
        raise InputError("no views found ('views' is empty)", path=path)
    return view_set(path, [_frame(path, i, view, images) for i, view in enumerate(views)])


def _frame(path: Path, index: int, entry: Any, images: Path | None) -> Frame:
    view = jsonfile.fields_of(path, entry, index, "view")
    photo, mask = jsonfile.optional_text(view, "image"), jsonfile.optional_text(view, "mask")
    weight = None if view.get("weight") is None else jsonfile.number(view, "weight")
    if weight is not None and weight < 0:
        raise view.place.to("weight").unexpected(weight, "a number ≥ 0")
    size = jsonfile.whole(view, "width"), jsonfile.whole(view, "height")
    count = len(jsonfile.listed(view, "distortion"))
    distortion = *(jsonfile.numbers(view, "distortion", count) if count else ()), *[0.0] * 5
    return Frame(
        name=jsonfile.text(view, "name"),
        viewmat=_exact(view),
        lens=Lens(size, np.array(jsonfile.numbers(view, "K", 3, 3)), distortion[:5]),
        photo=None if photo is None else images / Path(photo).name if images else path.parent / photo,
        mask=None if mask is None else path.parent / mask,
        split=jsonfile.optional_text(view, "split"),
        weight=weight,
        kind=jsonfile.optional_text(view, "kind") or USUAL,
    )


def _exact(view: jsonfile.Fields) -> NDArray[np.float64]:
    """Return the pose as stored if it is rigid to rounding, so that writing and reading change no bit."""
    stored = jsonfile.matrix(view, "camera_from_world")
    nearest = rigid(stored, view.place.to("camera_from_world"))
    return stored if len(stored) == 4 and np.allclose(nearest, stored, rtol=0, atol=1e-9) else nearest


def write(
    path: Path,
    cameras: Cameras,
    *,
    splits: Sequence[str | None] = (),
    weights: ArrayLike | None = None,
    overwrite: bool = False,
) -> None:
    """Write views, one per line, with exact floats; see `g2ard.io.write_views`."""
    count = len(cameras)
    given = np.full(count, np.nan) if weights is None else np.asarray(weights, np.float64)
    drawn = [None if np.isnan(weight) else weight for weight in given.tolist()]
    parts = list(splits) or [None] * count
    if not count or len(parts) != count or len(drawn) != count:
        raise InputError(
            f"{plural(count, 'view')}, {len(parts)} splits and {len(drawn)} weights do not match", path=path
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
            "image": beside(cameras.image_paths[i], path),
            "mask": beside(cameras.mask_paths[i], path),
            "split": parts[i],
            "weight": drawn[i],
            "kind": None if cameras.kinds[i] == USUAL else cameras.kinds[i],
        }
        lines.append(json.dumps({key: value for key, value in view.items() if value is not None}))
    head = f'{{"format": "{_FORMAT}", "version": {_VERSION}, "views": [\n'
    with atomic_output(path, overwrite) as temporary:
        temporary.write_text(head + ",\n".join(lines) + "\n]}\n", encoding="utf-8")
