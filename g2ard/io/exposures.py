"""Exposures of photos that 3DGS's exposure.json states."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from g2ard.arrays import Float
from g2ard.io.jsonfile import Place, Row, checked, read_json
from g2ard.scene.cameras import Cameras


def find_exposures(cameras: Cameras) -> dict[str, Float]:
    """Return exposures by view name from 3DGS's exposure.json beside the photos' folder, if there is one.

    It holds a 3×4 matrix C per photo, named with or without the suffix: photo = C·(render, 1).
    """
    exposures = {}
    tables = {}
    for name, photo in zip(cameras.names, cameras.image_paths, strict=True):
        if photo is None:
            continue
        path = exposure_file(photo)
        if path not in tables:
            tables[path] = _read_table(path)
        table = tables[path]
        for key in (name, photo.name, photo.stem):
            if key in table:
                exposures[name] = table[key]
                break
    return exposures


def _read_table(path: Path) -> dict[str, Float]:
    if not path.is_file():
        return {}
    content = read_json(path)
    for key, rows in content.items():
        matrix = checked(rows, tuple[Row, Row, Row], Place(path).to(key))
        content[key] = np.array(matrix)
    return content


def exposure_file(photo: Path) -> Path:
    """Return the path of the table with a photo's exposure, which may not exist."""
    return photo.parent.parent / "exposure.json"
