"""Reader for exposure.json of 3DGS: photo → 3×4 matrix C with photo = C·(render, 1)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.io.jsonfile import Place, Row, checked, read_json
from g2ard.scene.cameras import Cameras

_EXPOSURE_FILE = "exposure.json"


def find_exposures(cameras: Cameras) -> dict[str, NDArray[np.float64]]:
    """Return exposures by view name from an exposure.json beside the photos' folder, if there is one.

    Its keys are photo names, with or without the suffix.
    """
    exposures: dict[str, NDArray[np.float64]] = {}
    tables: dict[Path, dict[str, NDArray[np.float64]]] = {}
    for name, photo in zip(cameras.names, cameras.image_paths, strict=True):
        if photo is None:
            continue
        path = photo.parent.parent / _EXPOSURE_FILE
        if path not in tables:
            content = read_json(path) if path.is_file() else {}
            tables[path] = {
                key: np.array(checked(rows, tuple[Row, Row, Row], Place(path).to(key)))
                for key, rows in content.items()
            }
        table = tables[path]
        for key in (name, photo.name, photo.stem):
            if key in table:
                exposures[name] = table[key]
                break
    return exposures
