"""Reader for ACE's pose files: text, one photo per line."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.paths import read_text
from g2ard.io.photos import posed


def read(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read lines `NAME qw qx qy qz tx ty tz …` as photo → (4, 4) camera_from_world.

    Empty lines and lines that begin with # are skipped.
    """
    out: dict[str, NDArray[np.float64]] = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            pose = np.array(words[1:8], np.float64)
        except ValueError:
            pose = np.zeros(0)
        if len(pose) != 7 or not np.isfinite(pose).all() or not np.linalg.norm(pose[:4]) > 0:
            raise InputError(
                "is not a name, a quaternion wxyz and a translation", path=path, index=number, item="line"
            )
        if words[0] in out:
            raise InputError(f"repeats the name {words[0]!r}", path=path, index=number, item="line")
        out[words[0]] = posed(pose[:4], pose[4:])
    if not out:
        raise InputError("no poses found", path=path)
    return out
