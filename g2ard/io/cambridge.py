"""Reader for Cambridge Landmarks: poses from dataset_*.txt, focal lengths from reconstruction.nvm."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from g2ard.errors import InputError, damaged
from g2ard.io.colmap import parsing
from g2ard.io.finding import Finder
from g2ard.io.paths import read_text
from g2ard.io.photos import Frame, Lens, photo_size, posed, view_set
from g2ard.io.types import ViewSet

_PHOTO_SIZE = (1920, 1080)
"""Size of the original photos, for which focal lengths are given."""

_SPLIT_FILES = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
_NVM_FILE = "reconstruction.nvm"


class _Focal(NamedTuple):
    focal: float
    radial: float


def holds(folder: Path) -> bool:
    """Return whether a folder holds a scene of the data set."""
    return (folder / _NVM_FILE).is_file() and any((folder / name).is_file() for name in _SPLIT_FILES.values())


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read the train and test lists of a scene's folder.

    A line is the photo's name, the camera's centre and the quaternion (wxyz) of camera_from_world.
    VisualSFM's radial parameter r undistorts, m_u = (1 + r·|m|²)·m. OpenCV's k1 distorts; it is −r to first
    order.
    """
    lenses = _lenses(path / _NVM_FILE)
    median = _Focal(float(np.median([lens.focal for lens in lenses.values()])), 0.0)
    frames, guessed, finder = [], 0, Finder(images or path)
    for split, name in _SPLIT_FILES.items():
        if not (path / name).is_file():
            continue
        for photo_name, pose in _poses(path / name):
            lens = lenses.get(_stem(photo_name))
            guessed += lens is None
            photo = finder.photo(photo_name)
            frames.append(_frame(path / name, photo_name, pose, lens or median, photo, split))
    views = view_set(path, frames)
    if not guessed:
        return views
    text = f"{guessed} views are not in {_NVM_FILE}; they get the median focal length, {median.focal:.1f}"
    return views.noted("guessed_focal", guessed, text)


def _frame(where: Path, name: str, pose: list[float], lens: _Focal, photo: Path, split: str) -> Frame:
    width, height = photo_size(photo, where) if photo.is_file() else _PHOTO_SIZE
    view = posed(pose[3:], (0, 0, 0))
    view[:3, 3] = -view[:3, :3] @ np.array(pose[:3])
    focal = lens.focal * width / _PHOTO_SIZE[0]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Frame(
        name, view, Lens((width, height), K, (-lens.radial, 0.0, 0.0, 0.0, 0.0)), photo, split, listed=name
    )


def _stem(name: str) -> str:
    """Return a name without its suffix, since the model lists .jpg for .png photos."""
    return name.rsplit(".", 1)[0]


def _lenses(path: Path) -> dict[str, _Focal]:
    """Read the lenses of an NVM file's first model: name, focal, quaternion, centre, radial, 0 per line."""
    with parsing(path):
        lines = read_text(path).splitlines()
        if not lines or not lines[0].startswith("NVM_V3"):
            raise InputError("not VisualSFM's NVM_V3", path=path)
        at = next((i for i, line in enumerate(lines[1:], 1) if line.strip()), None)
        if at is None:
            raise damaged("truncated: nothing follows its first line", path=path)
        rows = [line.replace("\t", " ").split() for line in lines[at + 1 : at + 1 + int(lines[at])]]
        lenses = {_stem(row[0]): _Focal(float(row[1]), float(row[9])) for row in rows}
    if not lenses:
        raise InputError("has no cameras", path=path)
    return lenses


def _poses(path: Path) -> list[tuple[str, list[float]]]:
    """Read poses, one per line after three lines of heading."""
    out = []
    with parsing(path):
        for number, line in enumerate(read_text(path).splitlines()[3:], 4):
            words = line.split()
            if not words:
                continue
            if len(words) != 8:
                raise InputError(
                    f"has {len(words)} words, expected a name and 7 numbers",
                    path=path,
                    index=number,
                    item="line",
                )
            pose = [float(word) for word in words[1:]]
            if not np.isfinite(pose).all() or not np.linalg.norm(pose[3:]) > 0:
                raise InputError("is not a valid pose", path=path, index=number, item="line")
            out.append((words[0], pose))
    return out
