"""Data sets in their published layout, with few views."""

from pathlib import Path

import numpy as np

from g2ard.scene.cameras import look_at
from helpers.view_files import photo, quaternion

POSES = [look_at([3 * np.cos(a), 3 * np.sin(a), 1.5], [0, 0, 0]) for a in np.linspace(0, 5, 9)]


def opengl(view: np.ndarray) -> np.ndarray:
    return np.linalg.inv(view) @ np.diag([1.0, -1, -1, 1])


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
