"""Readers for poses as text, a photo per line: Cambridge Landmarks (focal lengths in an .nvm) and ACE."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from g2ard.errors import InputError, damaged
from g2ard.io.colmap import parsing
from g2ard.io.finding import Finder
from g2ard.io.frames import Frame, Lens, Listed, posed
from g2ard.io.jsonfile import Place
from g2ard.io.paths import read_text
from g2ard.io.photo_headers import photo_size
from g2ard.io.types import Float, ViewFiles

_PHOTO_SIZE = (1920, 1080)  # size of the original photos, for which focal lengths are given
_SPLIT_FILES = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
_NVM_FILE = "reconstruction.nvm"


def holds(folder: Path) -> bool:
    """Return whether a folder holds a scene of the data set."""
    return (folder / _NVM_FILE).is_file() and any((folder / name).is_file() for name in _SPLIT_FILES.values())


def read(views: ViewFiles) -> Listed:
    """Read the train and test lists of a scene's folder.

    A line is the photo's name, the camera's centre and the quaternion (wxyz) of camera_from_world.
    VisualSFM's radial parameter r undistorts, m_u = (1 + r·|m|²)·m. OpenCV's k1 distorts; it is −r to first
    order.
    """
    path, images = views.path, views.images
    lenses = _lenses(path / _NVM_FILE)
    median = float(np.median([focal for focal, _ in lenses.values()]))
    frames, guessed, finder = [], 0, Finder(images or path)
    for split, name in _SPLIT_FILES.items():
        if not (path / name).is_file():
            continue
        for place, photo_name, pose in _lines(path / name, heading=3):
            if not pose[3:].any():
                raise place.error("has a quaternion of length zero")
            lens = lenses.get(_stem(photo_name))
            guessed += lens is None
            photo = finder.photo(photo_name)
            frames.append(_frame(path / name, photo_name, pose, lens or (median, 0.0), photo, split))
    text = f"{guessed} views are not in {_NVM_FILE}; they get the median focal length, {median:.1f}"
    return Listed(path, frames).noted("guessed_focal", guessed, text)


def _frame(where: Path, name: str, pose: Float, lens: tuple[float, float], photo: Path, split: str) -> Frame:
    width, height = photo_size(photo, where) if photo.is_file() else _PHOTO_SIZE
    view = posed(pose[3:], (0, 0, 0))
    view[:3, 3] = -view[:3, :3] @ pose[:3]
    focal, radial = lens[0] * width / _PHOTO_SIZE[0], lens[1]
    own = Lens.pinhole((width, height), (focal, focal), distortion=(-radial, 0.0, 0.0, 0.0, 0.0))
    return Frame(name, view, own, photo, split, listed=name)


def _stem(name: str) -> str:
    """Return a name without its suffix, since the model lists .jpg for .png photos."""
    return name.rsplit(".", 1)[0]


def _lenses(path: Path) -> dict[str, tuple[float, float]]:
    """Read focal lengths and radial parameters of an NVM file's first model by the stems of photos.

    A line holds name, focal length, quaternion, centre, radial parameter and 0.
    """
    with parsing(path):
        text = read_text(path).splitlines()
        if not text or not text[0].startswith("NVM_V3"):
            raise InputError("not VisualSFM's NVM_V3")
        at = next((i for i, line in enumerate(text[1:], 1) if line.strip()), None)
        if at is None:
            raise damaged("truncated: nothing follows its first line")
        rows = [line.replace("\t", " ").split() for line in text[at + 1 : at + 1 + int(text[at])]]
        lenses = {_stem(row[0]): (float(row[1]), float(row[9])) for row in rows}
    if not lenses:
        raise InputError("has no cameras", path=path)
    return lenses


def read_ace(path: Path) -> dict[str, Float]:
    """Read ACE's lines `NAME qw qx qy qz tx ty tz …` as photo → (4, 4) camera_from_world."""
    out: dict[str, Float] = {}
    for place, name, numbers in _lines(path):
        if not numbers[:4].any():
            raise place.error("has a quaternion of length zero")
        if name in out:
            raise place.error(f"repeats the name {name!r}")
        out[name] = posed(numbers[:4], numbers[4:])
    if not out:
        raise InputError("no poses found", path=path)
    return out


def _lines(path: Path, heading: int = 0) -> Iterator[tuple[Place, str, Float]]:
    """Yield the name and the seven numbers of each line after a heading of lines.

    Empty lines and lines that begin with # are skipped.
    """
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words, place = line.split(), Place(path, number, "line")
        if number <= heading or not words or words[0].startswith("#"):
            continue
        try:
            numbers = np.array(words[1:8], float)
        except ValueError:
            numbers = np.zeros(0)
        if len(numbers) != 7 or not np.isfinite(numbers).all():
            raise place.error("is not a name and seven numbers")
        yield place, words[0], numbers
