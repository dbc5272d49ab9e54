"""Point clouds as .ply and .las files."""

from pathlib import Path

import laspy
import numpy as np
from plyfile import PlyData, PlyElement

FAR = np.array([636_337.8, 5_427_319.25, 411.01])


def ply(path: Path, types: dict[str, str], rows: np.ndarray, faces: int = 0) -> Path:
    table = np.empty(len(rows), list(types.items()))
    for i, name in enumerate(types):
        table[name] = rows[:, i]
    elements = [PlyElement.describe(table, "vertex")]
    if faces:
        face = np.empty(2, [("vertex_indices", "O")])
        face["vertex_indices"] = [np.arange(faces, dtype="i4"), np.arange(3, dtype="i4")]
        elements.append(PlyElement.describe(face, "face"))
    PlyData(elements).write(str(path))
    return path


def columns(
    position: str, color: str, names: tuple[str, ...] = ("red", "green", "blue")
) -> dict[str, str]:
    return dict.fromkeys("xyz", position) | dict.fromkeys(names, color)


def las(
    path: Path,
    positions: np.ndarray,
    rgb: np.ndarray | None,
    point_format: int = 2,
    scales: tuple[float, ...] = (0.001,) * 3,
    **fields: np.ndarray,
) -> Path:
    point_format = 1 if rgb is None else point_format
    header = laspy.LasHeader(
        point_format=point_format, version="1.4" if point_format > 5 else "1.2"
    )
    header.offsets, header.scales = positions.min(0), np.array(scales)
    data = laspy.LasData(header)
    data.x, data.y, data.z = positions.T
    if rgb is not None:
        data.red, data.green, data.blue = rgb.T
    for name, values in fields.items():
        data[name] = values
    data.write(str(path))
    return path
