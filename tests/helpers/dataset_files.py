"""Data sets in their published layout, with few views."""

import json
from pathlib import Path

import numpy as np

from g2ard.scene.cameras import look_at
from helpers.view_files import photo, quaternion

POSES = [look_at([3 * np.cos(a), 3 * np.sin(a), 1.5], [0, 0, 0]) for a in np.linspace(0, 5, 9)]


def opengl(view: np.ndarray) -> np.ndarray:
    return np.linalg.inv(view) @ np.diag([1.0, -1, -1, 1])


def llff(root: Path, scale: int = 4) -> None:
    """poses_bounds.npy for photos of 400×300 pixels, of which a smaller copy exists."""
    rows = []
    for i, view in enumerate(POSES):
        pose = np.linalg.inv(view)  # right, down, forward
        down_right_back = np.stack([pose[:3, 1], pose[:3, 0], -pose[:3, 2]], axis=1)
        head = np.array([[300.0], [400.0], [380.0]])
        rows.append([*np.hstack([down_right_back, pose[:3, 3:], head]).ravel(), 1.0, 9.0])
        photo(root / f"images_{scale}" / f"IMG_{i:04d}.JPG", (400 // scale, 300 // scale))
    np.save(root / "poses_bounds.npy", np.array(rows))


def polycam(root: Path, folder: str = "corrected_") -> None:
    """Keyframes of a Polycam capture, named by their time in microseconds."""
    for i, view in enumerate(POSES):
        name, pose = str(9_999_000 + 500 * i), opengl(view)
        frame = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        frame |= {
            "fx": 95.0,
            "fy": 96.0,
            "cx": 51.0,
            "cy": 37.0,
            "width": 100,
            "height": 75,
            "blur_score": 30.0,
        }
        cameras = root / "keyframes" / f"{folder}cameras"
        cameras.mkdir(parents=True, exist_ok=True)
        (cameras / f"{name}.json").write_text(json.dumps(frame))
        photo(root / "keyframes" / f"{folder}images" / f"{name}.jpg", (100, 75))


def mip_nerf_360(root: Path) -> None:
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("# x\n1 PINHOLE 400 300 380 381 201 149\n")
    rows = []
    for i, view in enumerate(POSES):
        q, t = quaternion(view[:3, :3]), view[:3, 3]
        rows.append(" ".join(map(str, (i + 1, *q, *t, 1, f"DSC{i:04d}.JPG"))) + "\n\n")
        for folder, size in (("images", (400, 300)), ("images_2", (200, 150)), ("images_4", (100, 75))):
            photo(root / folder / f"DSC{i:04d}.JPG", size)
    (model / "images.txt").write_text("".join(rows))


def cambridge(root: Path, size: tuple[int, int] = (192, 108)) -> None:
    lines = {"train": [], "test": []}
    cameras = []
    for i, view in enumerate(POSES):
        split = "test" if i >= 6 else "train"
        name = f"seq{2 if split == 'test' else 1}/frame{i:05d}"
        q, c = quaternion(view[:3, :3]), -view[:3, :3].T @ view[:3, 3]
        lines[split].append(" ".join(f"{v:.9f}" for v in (*c, *q)).join((f"{name}.png ", "")))
        if i != 4:
            numbers = " ".join(f"{v:.9f}" for v in (1670.0 + i, *q, *c))
            cameras.append(f"{name}.jpg\t{numbers} -0.05 0 ")
        photo(root / f"{name}.png", size)
    for split, rows in lines.items():
        head = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
        (root / f"dataset_{split}.txt").write_text(head + "\n".join(rows) + "\n")
    points = "\n\n1\n0.1 0.2 0.3 9 8 7 0\n"
    (root / "reconstruction.nvm").write_text(
        f"NVM_V3 \n\n{len(cameras)}\n" + "\n".join(cameras) + points, encoding="utf-8"
    )
