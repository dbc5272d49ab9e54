"""Photos of a small scene in a folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import g2ard
from g2ard.io import Points, write_points
from g2ard.scene.images import write_png
from g2ard.scene.splats import SH_C0
from helpers.scenes import around, checkered_ball
from helpers.view_files import transforms

BALL = checkered_ball(1200)


def photos_of(folder: Path, points: bool = False) -> None:
    """Photos of the ball with a transforms.json, and COLMAP-like points beside them if asked for."""
    views = around(24)
    (folder / "images").mkdir(parents=True)
    K = views.Ks[0]
    size = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": 64, "h": 48}
    transforms(folder / "transforms.json", list(views.viewmats), **size)
    for i in range(24):
        write_png(folder / "images" / f"{i:03d}.png", g2ard.render(BALL, views[i]).image)
    if points:
        colors = np.clip(0.5 + SH_C0 * BALL.sh0[:, 0], 0, 1).astype(np.float32)
        write_points(folder / "sparse.ply", Points(BALL.means.astype(np.float64), colors))
        listed = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").write_text(json.dumps({**listed, "ply_file_path": "sparse.ply"}))
