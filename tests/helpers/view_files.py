"""Views as other programs and g2ard itself write them, for the tests of their readers."""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from g2ard.scene.cameras import Cameras, look_at


def photo(path: Path, size: tuple[int, int] = (8, 6), red: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (red, 0, 0)).save(path)
    return path


def orbit(count: int) -> list[np.ndarray]:
    angles = np.linspace(0, 5, count)
    return [look_at([3 * math.cos(a), 3 * math.sin(a), 1 + 0.1 * a], [0, 0, 0]) for a in angles]


def quaternion(R: np.ndarray) -> np.ndarray:
    """wxyz of a rotation, by the eigenvector of its symmetric 4×4 form: independent of the reader."""
    K = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0, 0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [0, 0, 0, R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    K = K + np.triu(K, 1).T
    return np.linalg.eigh(K)[1][:, -1]


MODELS: list[tuple[int, str, list[float], list[float], list[float]]] = [
    (0, "SIMPLE_PINHOLE", [500, 4, 3], [500, 500, 4, 3], [0, 0, 0, 0]),
    (1, "PINHOLE", [500, 510, 4, 3], [500, 510, 4, 3], [0, 0, 0, 0]),
    (2, "SIMPLE_RADIAL", [500, 4, 3, 0.1], [500, 500, 4, 3], [0.1, 0, 0, 0]),
    (3, "RADIAL", [500, 4, 3, 0.1, 0.2], [500, 500, 4, 3], [0.1, 0.2, 0, 0]),
    (4, "OPENCV", [500, 510, 4, 3, 0.1, 0.2, 0.3, 0.4], [500, 510, 4, 3], [0.1, 0.2, 0.3, 0.4]),
]


def colmap(folder: Path, viewmats: list[np.ndarray], text: bool, model: int = 1) -> Path:
    """A model whose images come in reverse order of their names, with 2D points to step over."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    number, name, parameters, _, _ = MODELS[model]
    images = list(enumerate(viewmats))[::-1]
    points = [((1.5, 2, 3), (255, 128, 0), 2), ((-4, 5, 6), (0, 1, 2), 0)]
    if text:
        values = " ".join(map(str, parameters))
        (sparse / "cameras.txt").write_text(f"# a comment\n7 {name} 8 6 {values}\n")
        lines = ["# two lines an image"]
        for i, view in images:
            pose = " ".join(repr(float(v)) for v in (*quaternion(view[:3, :3]), *view[:3, 3]))
            lines += [f"{i + 1} {pose} 7 photo {i}.png", "1 2 -1 3 4 5" if i % 2 else ""]
        (sparse / "images.txt").write_text("\n".join(lines) + "\n")
        rows = [
            f"{i} {' '.join(map(str, p))} {' '.join(map(str, c))} 0.5" + " 1 2" * track
            for i, (p, c, track) in enumerate(points)
        ]
        (sparse / "points3D.txt").write_text("# points\n" + "\n".join(rows) + "\n")
        return folder
    head = struct.pack("<QiiQQ", 1, 7, number, 8, 6)
    (sparse / "cameras.bin").write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))
    data = struct.pack("<Q", len(images))
    for i, view in images:
        data += struct.pack("<I7dI", i + 1, *quaternion(view[:3, :3]), *view[:3, 3], 7)
        data += f"photo {i}.png".encode() + b"\0" + struct.pack("<Q", i) + bytes(24 * i)
    (sparse / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for i, (p, c, track) in enumerate(points):
        data += struct.pack("<Q3d3BdQ", i, *p, *c, 0.5, track) + bytes(8 * track)
    (sparse / "points3D.bin").write_bytes(data)
    for extra in ("rigs.bin", "frames.bin"):
        (sparse / extra).write_bytes(bytes(8))
    return folder


def transforms(path: Path, viewmats: list[np.ndarray], **extra: Any) -> Path:
    """Write views as instant-ngp does: camera to world, y up, looking along −z."""
    frames = []
    for i, view in enumerate(viewmats):
        world = np.linalg.inv(view)
        world[:3, 1:3] *= -1
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": world.tolist()})
    content = {
        "fl_x": 10.0,
        "fl_y": 11.0,
        "cx": 4.5,
        "cy": 2.5,
        "w": 8.0,
        "h": 6.0,
        "frames": frames,
    } | extra
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    return path


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def views(count: int, seed: int = 0, photos: Path | None = None) -> Cameras:
    rng = np.random.default_rng(seed)
    Ks = [
        [[rng.uniform(1, 999), 0, rng.uniform(0, 9)], [0, rng.uniform(1, 999), 3.3], [0, 0, 1]]
    ] * count
    return Cameras.from_lists(
        orbit(count),
        Ks,
        [(8, 6)] * count,
        [f"v{i}" for i in range(count)],
        [photo(photos / f"{i}.png") for i in range(count)] if photos else (),
        rng.normal(size=(count, 5)) if seed % 2 else (),
    )
