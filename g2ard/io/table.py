"""Writer of a scene's attributes as a table in .csv, for spreadsheets and data frames."""

from pathlib import Path

import numpy as np

from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.sanitize import BLOCK
from g2ard.scene.attributes import columns
from g2ard.scene.splats import Splats


def write(path: Path, splats: Splats, *, overwrite: bool = False) -> None:
    """Write a header and a row per Gaussian: the columns of `g2ard.scene.attributes.columns`.

    Numbers have the digits that distinguish float32 values; positions with an offset those of float64.
    """
    if not len(splats):
        raise InputError("not written: the scene has no Gaussians", path=path)
    with (
        atomic_output(path, overwrite) as temporary,
        temporary.open("w", encoding="ascii", newline="") as file,
    ):
        for at in range(0, len(splats), BLOCK):
            table = columns(splats.take(slice(at, at + BLOCK)))
            if at == 0:
                file.write(",".join(table) + "\r\n")
            far = splats.offset.any()
            digits = ["%.17g" if far and name in ("x", "y", "z") else "%.9g" for name in table]
            rows = np.column_stack([values.astype(np.float64) for values in table.values()])
            np.savetxt(file, rows, fmt=digits, delimiter=",", newline="\r\n")
