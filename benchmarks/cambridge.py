"""Views of Cambridge Landmarks: poses from its lists, lenses from its model by VisualSFM."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from g2ard.arrays import Float
from g2ard.io.colmap import parsing
from g2ard.io.frames import Frame, Lens, Listed, make_pose, make_view_set
from g2ard.io.photo_headers import read_size
from g2ard.io.types import ViewSet

__all__ = ["read"]

_PHOTO_SIZE = (1920, 1080)
"""Pixels of the original photos, for which focal lengths are given."""
_HEADING = 3
"""Lines before the first photo of a list."""


def read(folder: Path) -> ViewSet:
    """Read the train and test lists of a scene's folder; photos without a lens get the median one.

    VisualSFM's radial parameter r undistorts, m_u = (1 + r·|m|²)·m. OpenCV's k1 distorts; it is −r to first
    order.
    """
    model = folder / "reconstruction.nvm"
    with parsing(model):
        lenses = _lenses(model)
    median = float(np.median([focal for focal, _ in lenses.values()]))
    frames, guessed = [], 0
    for split in ("train", "test"):
        path = folder / f"dataset_{split}.txt"
        with parsing(path):
            for name, viewmat in _poses(path):
                lens = lenses.get(_stem(name))
                guessed += lens is None
                focal, radial = lens or (median, 0.0)
                width, height = _size(folder / name)
                focal *= width / _PHOTO_SIZE[0]
                distortion = (-radial, 0.0, 0.0, 0.0, 0.0)
                own = Lens.pinhole((width, height), (focal, focal), distortion=distortion)
                frames.append(Frame(name, viewmat, own, folder / name, split, listed=name))
    text = (
        f"{guessed} views are not in {model.name}; they get the median focal length, {median:.1f}"
    )
    return make_view_set(Listed(folder, frames).noted("guessed_focal", guessed, text))


def _size(photo: Path) -> tuple[int, int]:
    return read_size(photo) if photo.is_file() else _PHOTO_SIZE


def _stem(name: str) -> str:
    """Return a name without its suffix, since the model lists .jpg for .png photos."""
    return name.rsplit(".", 1)[0]


def _poses(path: Path) -> Iterator[tuple[str, Float]]:
    """Yield the name and the (4, 4) camera_from_world of each line: name, camera's centre, quaternion."""
    for line in path.read_text(encoding="utf-8").splitlines()[_HEADING:]:
        words = line.split()
        if not words:
            continue
        numbers = np.array(words[1:8], np.float64)
        viewmat = make_pose(numbers[3:], (0, 0, 0))
        viewmat[:3, 3] = -viewmat[:3, :3] @ numbers[:3]
        yield words[0], viewmat


def _lenses(path: Path) -> dict[str, tuple[float, float]]:
    """Return focal lengths and radial parameters of an NVM file's first model by the stems of photos.

    A line holds name, focal length, quaternion, centre, radial parameter and 0, after the number of lines.
    """
    lines = [
        line.split() for line in path.read_text(encoding="utf-8").splitlines()[1:] if line.strip()
    ]
    count = int(lines[0][0])
    return {_stem(row[0]): (float(row[1]), float(row[9])) for row in lines[1 : count + 1]}
