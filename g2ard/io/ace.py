"""Reader for ACE's pose files: text, one photo per line."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import Place
from g2ard.io.paths import read_text
from g2ard.io.photos import posed


def read(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read lines `NAME qw qx qy qz tx ty tz …` as photo → (4, 4) camera_from_world."""
    out: dict[str, NDArray[np.float64]] = {}
    for place, name, numbers in lines(path):
        if not numbers[:4].any():
            raise place.error("has a quaternion of length zero")
        if name in out:
            raise place.error(f"repeats the name {name!r}")
        out[name] = posed(numbers[:4], numbers[4:])
    if not out:
        raise InputError("no poses found", path=path)
    return out


def lines(path: Path, heading: int = 0) -> Iterator[tuple[Place, str, NDArray[np.float64]]]:
    """Yield the name and the seven numbers of each line after a heading of lines.

    Empty lines and lines that begin with # are skipped.
    """
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words, place = line.split(), Place(path, number, "line")
        if number <= heading or not words or words[0].startswith("#"):
            continue
        try:
            numbers = np.array(words[1:8], np.float64)
        except ValueError:
            numbers = np.zeros(0)
        if len(numbers) != 7 or not np.isfinite(numbers).all():
            raise place.error("is not a name and seven numbers")
        yield place, words[0], numbers
