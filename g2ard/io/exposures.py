"""exposure.json, as 3DGS writes it: an affine colour transform for each photo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import read_json
from g2ard.scene.cameras import Cameras

__all__ = ["find_exposures", "read"]

_NAME = "exposure.json"


def read(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read {photo: 3×4 matrix C}, photo = C·(render, 1).

    Raises:
        InputError: anything else.
    """
    found = {}
    for name, rows in read_json(path).items():
        try:
            matrix = np.array(rows, np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.zeros(0)
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise InputError(f"{name!r} is not a finite 3×4 matrix", path=path)
        found[name] = matrix
    return found


def find_exposures(cameras: Cameras) -> dict[str, NDArray[np.float64]]:
    """By view name, from an exposure.json beside the photos' folder; none if there is no such file.

    Its keys are photo names, with or without the suffix.

    Raises:
        InputError: as `read`.
    """
    found: dict[str, NDArray[np.float64]] = {}
    tables: dict[Path, dict[str, NDArray[np.float64]]] = {}
    for name, photo in zip(cameras.names, cameras.image_paths, strict=True):
        if photo is None:
            continue
        path = photo.parent.parent / _NAME
        if path not in tables:
            tables[path] = read(path) if path.is_file() else {}
        table = tables[path]
        for key in (name, photo.name, photo.stem):
            if key in table:
                found[name] = table[key]
                break
    return found
