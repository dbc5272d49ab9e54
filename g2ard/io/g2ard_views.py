"""Reader and writer for g2ard's views .json, described in docs/formats.md."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float
from g2ard.errors import InputError
from g2ard.io.finding import Finder
from g2ard.io.frames import Frame, Lens, Listed, make_rigid
from g2ard.io.jsonfile import Json, Matrix, Number, Place, Pose, Weight, Whole, checked, read_own
from g2ard.io.paths import beside
from g2ard.io.types import Splits, ViewFiles
from g2ard.progress import plural
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.lenses import PARAMETERS, PhotoLens

_FORMAT = "g2ard-views"
_VERSION = 1


class _PhotoLens(msgspec.Struct):
    model: str
    size: tuple[Whole, Whole]
    params: list[Number]
    turn: Matrix


class _View(msgspec.Struct):
    name: str
    width: Whole
    height: Whole
    K: Matrix
    camera_from_world: Pose
    distortion: list[Number] = []
    image: str | None = None
    mask: str | None = None
    split: str | None = None
    weight: Weight | None = None
    kind: str | None = None
    lens: _PhotoLens | None = None


def read(given: ViewFiles) -> Listed:
    """Read views; photo paths are relative to the file unless `images`, a folder of photos, is given."""
    path = given.path
    content = read_own(path, _FORMAT, _VERSION).get("views", [])
    views = checked(content, list[_View], Place(path).to("views"), entries="view")
    if not views:
        raise InputError("no views found ('views' is empty)", path=path)
    finder = Finder(given.images or path.parent)
    masks = Finder(path.parent)
    frames = [_frame(Place(path, i, "view"), view, finder, masks) for i, view in enumerate(views)]
    return Listed(path, frames)


def _frame(
    place: Place,
    view: _View,
    finder: Finder,
    masks: Finder,
) -> Frame:
    distortion = *view.distortion, *[0.0] * 5
    return Frame(
        name=view.name,
        viewmat=_exact(np.array(view.camera_from_world), place.to("camera_from_world")),
        lens=Lens(
            (view.width, view.height),
            np.array(view.K),
            distortion[:5],
            _photo_lens(view.lens, place),
            made=True,
        ),
        photo=None if view.image is None else finder.photo(view.image),
        mask=None if view.mask is None else masks.photo(view.mask),
        split=view.split,
        weight=view.weight,
        kind=view.kind or USUAL,
        listed=view.image or "",
    )


def _photo_lens(lens: _PhotoLens | None, place: Place) -> PhotoLens | None:
    if lens is None:
        return None
    if PARAMETERS.get(lens.model) != len(lens.params) or min(lens.size) < 1:
        raise place.to("lens").error(f"is not a lens of the model {lens.model!r}")
    turn = tuple(np.array(lens.turn).ravel().tolist())
    return PhotoLens(lens.model, lens.size, tuple(lens.params), turn)


def _exact(stored: Float, place: Place) -> Float:
    """Return the pose as stored if it is rigid to rounding, so that writing and reading change no bit."""
    nearest = make_rigid(stored, place)
    if len(stored) == 4 and np.allclose(nearest, stored, rtol=0, atol=1e-9):
        return stored
    return nearest


def _written(lens: PhotoLens | None) -> Json | None:
    if lens is None:
        return None
    turn = np.array(lens.turn).reshape(3, 3).tolist()
    return {
        "model": lens.model,
        "size": lens.size,
        "params": lens.params,
        "turn": turn,
    }


def text_of(
    path: Path,
    cameras: Cameras,
    splits: Splits,
    weights: ArrayLike | None,
) -> str:
    """Return views, one per line, with exact floats; see `g2ard.io.write_views`."""
    count = len(cameras)
    drawn = [None] * count
    if weights is not None:
        given = np.asarray(weights, float).tolist()
        drawn = [None if np.isnan(weight) else weight for weight in given]
    parts = list(splits) or [None] * count
    if len(parts) != count or len(drawn) != count:
        counts = f"{plural(count, 'view')}, {len(parts)} splits and {len(drawn)} weights"
        raise InputError(f"{counts} do not match", path=path)
    lines = []
    for i in range(count):
        kind = None
        if cameras.kinds[i] != USUAL:
            kind = cameras.kinds[i]
        distortion = None
        if cameras.distortions[i].any():
            distortion = cameras.distortions[i].tolist()
        view: Json = {
            "name": cameras.names[i],
            "width": int(cameras.widths[i]),
            "height": int(cameras.heights[i]),
            "K": cameras.Ks[i].tolist(),
            "camera_from_world": cameras.viewmats[i].tolist(),
            "distortion": distortion,
            "lens": _written(cameras.lenses[i]),
            "image": beside(cameras.image_paths[i], path),
            "mask": beside(cameras.mask_paths[i], path),
            "split": parts[i],
            "weight": drawn[i],
            "kind": kind,
        }
        stated = {key: value for key, value in view.items() if value is not None}
        lines.append(json.dumps(stated))
    head = f'{{"format": "{_FORMAT}", "version": {_VERSION}, "views": [\n'
    return head + ",\n".join(lines) + "\n]}\n"
