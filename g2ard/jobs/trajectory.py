"""Readers for poses as text: ACE's, and trajectories of SLAM programs (TUM and KITTI)."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from g2ard.arrays import Float
from g2ard.errors import InputError
from g2ard.io.frames import invert_pose, make_pose, make_rigid
from g2ard.io.jsonfile import Place
from g2ard.io.paths import read_text
from g2ard.io.signs import sign_of

_UNITS = 10.0 ** np.arange(-9, 10, 3)  # of times, in units of the names of photos


def is_trajectory(path: Path) -> bool:
    sign = sign_of(path) if path.is_file() else None
    return sign is not None and any(word.startswith(b"numbers:") for word in sign.words)


def read_trajectory(path: Path, names: Sequence[str]) -> dict[str, Float]:
    """Return name → camera_from_world of photos, by the times in their names, otherwise in order.

    A line is `time tx ty tz qx qy qz qw`, or the rows of a 3×4 matrix; both are world_from_camera.
    """
    poses = list[Float]()
    times = list[float]()
    for place, words in _lines(path):
        values = _numbers(words)
        if len(values) == 12:
            poses.append(invert_pose(make_rigid(values.reshape(3, 4), place)))
        elif len(values) == 8:
            poses.append(invert_pose(_pose(values[[7, 4, 5, 6]], values[1:4], place)))
            times.append(float(values[0]))
        else:
            raise place.error("is not a time and a pose, nor a 3×4 matrix")
    if found := _by_time(np.array(times), names):
        return {name: poses[row] for name, row in found.items()}
    if len(poses) != len(names):
        text = f"is a trajectory of {len(poses)} poses, and no time in it is that of a photo ({names[0]})"
        hint = "name photos by their times, or give as many poses as photos"
        raise InputError(text, path=path, hint=hint)
    return dict(zip(sorted(names, key=_numbered), poses, strict=True))


def read_ace(path: Path) -> dict[str, Float]:
    """Read ACE's lines `NAME qw qx qy qz tx ty tz …` as photo → (4, 4) camera_from_world."""
    poses: dict[str, Float] = {}
    for place, (name, *words) in _lines(path):
        values = _numbers(words[:7])
        if len(values) != 7:
            raise place.error("is not a name and seven numbers")
        if name in poses:
            raise place.error(f"repeats the name {name!r}")
        poses[name] = _pose(values[:4], values[4:], place)
    if not poses:
        raise InputError("no poses found", path=path)
    return poses


def _lines(path: Path) -> Iterator[tuple[Place, list[str]]]:
    """Yield the words of each line that is neither empty nor a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words and words[0][0] not in "#%":
            yield Place(path, number, "line"), words


def _numbers(words: list[str]) -> Float:
    """Return the words as numbers, or none if one of them is not a finite number."""
    try:
        values = np.array(words, np.float64)
    except ValueError:
        return np.zeros(0)
    return values if np.isfinite(values).all() else np.zeros(0)


def _pose(quat: Float, translation: Float, place: Place) -> Float:
    if not quat.any():
        raise place.error("has a quaternion of length zero")
    return make_pose(quat, translation)


def _numbered(name: str) -> list[str | int]:
    """Return a key that sorts names by their numbers, such as 2.png before 10.png."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _by_time(times: Float, names: Sequence[str]) -> dict[str, int]:
    """Return name → row of the pose nearest in time, in the unit in which most names have one.

    Poses more than half a usual step away do not count.
    """
    numbers = {name: re.findall(r"\d+(?:\.\d+)?", PurePosixPath(name).stem) for name in names}
    stamps = {name: float(max(found, key=len)) for name, found in numbers.items() if found}
    best: dict[str, int] = {}
    if len(times) < 2:
        return best
    slack = float(np.median(np.abs(np.diff(times)))) / 2
    for unit in _UNITS:
        near = {
            name: int(np.argmin(np.abs(times - stamp * unit))) for name, stamp in stamps.items()
        }
        found = {
            name: row
            for name, row in near.items()
            if abs(times[row] - stamps[name] * unit) <= slack
        }
        if len(found) > len(best):
            best = found
    return best
