"""Reader for trajectories of SLAM programs: a time and pose (TUM) or a matrix (KITTI) per line."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.frames import inverse, posed, rigid
from g2ard.io.jsonfile import Place
from g2ard.io.paths import read_text
from g2ard.io.signs import sign_of

_UNITS = 10.0 ** np.arange(-9, 10, 3)  # of times, in units of the names of photos


def is_trajectory(path: Path) -> bool:
    sign = sign_of(path) if path.is_file() else None
    return sign is not None and any(word.startswith(b"numbers:") for word in sign.words)


def read_trajectory(path: Path, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Return name → camera_from_world of photos, by the times in their names, otherwise in order.

    A line is `time tx ty tz qx qy qz qw`, or the rows of a 3×4 matrix; both are world_from_camera.
    """
    lines = enumerate(read_text(path).splitlines(), 1)
    rows = [(number, line.split()) for number, line in lines if line.strip() and line.lstrip()[0] not in "#%"]
    poses, times = list[NDArray[np.float64]](), list[float]()
    for number, words in rows:
        place = Place(path, number, "line")
        try:
            values = np.array(words, np.float64)
        except ValueError:
            values = np.zeros(0)
        if len(values) not in (8, 12) or not np.isfinite(values).all():
            raise place.error("is not a time and a pose, nor a 3×4 matrix")
        if len(values) == 12:
            poses.append(inverse(rigid(values.reshape(3, 4), place)))
            continue
        if not values[4:].any():
            raise place.error("has a quaternion of length zero")
        poses.append(inverse(posed(values[[7, 4, 5, 6]], values[1:4])))
        times.append(float(values[0]))
    if found := _by_time(np.array(times), names):
        return {name: poses[row] for name, row in found.items()}
    if len(poses) != len(names):
        text = f"is a trajectory of {len(poses)} poses, and no time in it is that of a photo ({names[0]})"
        hint = "name photos by their times, or give as many poses as photos"
        raise InputError(text, path=path, hint=hint)
    return dict(zip(sorted(names, key=_numbered), poses, strict=True))


def _numbered(name: str) -> list[str | int]:
    """Return a key that sorts names by their numbers, such as 2.png before 10.png."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _by_time(times: NDArray[np.float64], names: Sequence[str]) -> dict[str, int]:
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
        near = {name: int(np.argmin(np.abs(times - stamp * unit))) for name, stamp in stamps.items()}
        found = {name: row for name, row in near.items() if abs(times[row] - stamps[name] * unit) <= slack}
        if len(found) > len(best):
            best = found
    return best
