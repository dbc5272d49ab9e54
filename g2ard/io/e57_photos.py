"""Reader for the photos of laser scans: panoramas and pinhole images of an .e57, with their poses."""

from __future__ import annotations

import hashlib
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.e57 import image_count, opened
from g2ard.io.photos import Frame, Lens, inverse, posed, view_set
from g2ard.io.transforms import FLIP
from g2ard.io.types import ViewSet
from g2ard.progress import plural
from g2ard.scene.lenses import PhotoLens

_PANORAMA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""OpenCV's camera axes in those of a panorama, whose middle is along x, with z up."""

_FULL_CIRCLE = 0.01
"""Largest relative difference of a panorama's aspect from 2:1."""

_SUFFIXES = {"jpegImage": ".jpg", "pngImage": ".png"}
_NO_NAME = re.compile(r"[^\w.-]+")


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read photos with poses as views; their files are copied to a cache once.

    Panoramas of the full sphere look along x with z up; pinhole images look along −z with y up, as the format
    defines. Others (for reference, cylindrical, without a pose) are left out with a note.
    """
    if images is not None:
        raise InputError("has its photos inside", path=path, hint="leave {images} out")
    with opened(path) as file:
        root = file.image_file.root()
        nodes = [root["images2D"][i] for i in range(image_count(file))]
        if not nodes:
            raise InputError("holds no photos", path=path, hint="give views with photos of their own")
        folder = _cache_of(path)
        found = [_frame(path, number, node, folder) for number, node in enumerate(nodes)]
    frames = [frame for frame in found if isinstance(frame, Frame)]
    left_out = [reason for reason in found if isinstance(reason, str)]
    if not frames:
        raise InputError(f"none of its {plural(len(nodes), 'photo')} can be used: {left_out[0]}", path=path)
    views = view_set(path, frames)
    text = f"{plural(len(left_out), 'photo')} of {len(nodes)} left out: {left_out[0] if left_out else ''}"
    return views.noted("left_out_photos", len(left_out), text) if left_out else views


def _frame(path: Path, number: int, node: Any, folder: Path) -> Frame | str:
    """Return the view of a photo, or the reason why it cannot be used."""
    named = str(node["name"].value()) if node.isDefined("name") else ""
    stem = "_".join(filter(None, [f"{number:04d}", _NO_NAME.sub("_", named).strip("_.")[:80]]))
    kind = next((k for k in ("spherical", "pinhole") if node.isDefined(f"{k}Representation")), None)
    if kind is None:
        return f"{stem} has no spherical or pinhole representation"
    if not node.isDefined("pose"):
        return f"{stem} has no pose"
    shown = node[f"{kind}Representation"]
    size = int(shown["imageWidth"].value()), int(shown["imageHeight"].value())
    if min(size) < 1:
        return f"{stem} has {size[0]}×{size[1]} pixels"
    if kind == "spherical":
        if abs(size[0] - 2 * size[1]) > _FULL_CIRCLE * size[0]:
            return f"{stem} is a panorama of {size[0]}×{size[1]} pixels, not of the full sphere"
        lens = Lens.of(PhotoLens("EQUIRECTANGULAR", size, ()))
    else:
        focal, across, down, cx, cy = (
            float(shown[name].value())
            for name in ("focalLength", "pixelWidth", "pixelHeight", "principalPointX", "principalPointY")
        )
        if not (focal > 0 and across > 0 and down > 0):
            return f"{stem} has no focal length"
        lens = Lens(size, np.array([[focal / across, 0, cx], [0, focal / down, cy], [0, 0, 1]]))
    blob = next((name for name in _SUFFIXES if shown.isDefined(name)), None)
    if blob is None:
        return f"{stem} has no JPEG or PNG"
    photo = _copied(shown[blob], folder / f"{stem}{_SUFFIXES[blob]}")
    mask = (
        _copied(shown["imageMask"], folder / "masks" / f"{stem}.png")
        if shown.isDefined("imageMask")
        else None
    )
    world_from_camera = _pose(node["pose"]) @ (_PANORAMA_AXES if kind == "spherical" else FLIP)
    return Frame(photo.name, inverse(world_from_camera), lens, photo, mask=mask, listed=photo.name)


def _pose(node: Any) -> NDArray[np.float64]:
    """Return world_from_photo; parts that are missing are those of the identity."""
    quat, shift = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    if node.isDefined("rotation"):
        quat = [float(node["rotation"][axis].value()) for axis in "wxyz"]
    if node.isDefined("translation"):
        shift = [float(node["translation"][axis].value()) for axis in "xyz"]
    return posed(quat, shift)


def _copied(blob: Any, target: Path) -> Path:
    """Copy a photo into the cache, unless it is there."""
    if target.is_file() and target.stat().st_size == blob.byteCount():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(target, overwrite=True) as temporary:
        temporary.write_bytes(np.asarray(blob.read_buffer()).tobytes())
    return target


def _cache_of(path: Path) -> Path:
    """Return the folder of a file's photos below the user's cache folder; another file has another one."""
    state = path.stat()
    key = f"{path.resolve()}\n{state.st_size}\n{state.st_mtime_ns}"
    usual = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    base = Path(usual) if usual else Path.home() / ".cache"
    return base / "g2ard" / "e57" / f"{path.stem}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
