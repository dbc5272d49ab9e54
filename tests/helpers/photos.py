"""Photos of a small scene in a folder."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

import g2ard
from g2ard.io import write_points
from g2ard.io.images import write_png
from g2ard.io.types import Points
from g2ard.scene.splats import SH_C0
from helpers.cloud_files import las
from helpers.scenes import around, checkered_ball
from helpers.view_files import edit, transforms

BALL = checkered_ball(1200)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def photographed(
    folder: Path, scene: g2ard.Splats, views: g2ard.Cameras, gain: float = 1.0, bias: float = 0.0
) -> g2ard.Cameras:
    """Write a photo of every view, and return the views with their photos."""
    paths = tuple(folder / f"{name}.png" for name in views.names)
    renderer = g2ard.Renderer(scene)
    for view, path in zip(views, paths, strict=True):
        write_png(path, np.clip(gain * renderer.image(view) + bias, 0, 1))
    return replace(views, image_paths=paths)


def cloud_of(
    path: Path, scene: g2ard.Splats, origin: ArrayLike = 0, **fields: NDArray[Any]
) -> None:
    """Write the means of a scene, moved to `origin`, as a coloured .ply, .las or .laz cloud.

    Args:
        fields: further columns of a .las or .laz, each (N,).
    """
    colors = np.clip(0.5 + SH_C0 * scene.sh0[:, 0], 0, 1).astype(np.float32)
    points = scene.means.astype(np.float64) + np.asarray(origin)
    if path.suffix == ".ply":
        write_points(path, Points(points, colors))
    else:
        las(path, points, np.rint(colors * 65535).astype(np.uint16), **fields)


def cloud_with_photos(folder: Path, scene: g2ard.Splats) -> None:
    """Write cloud.ply of a scene, and twelve photos of it that views.json lists."""
    cloud_of(folder / "cloud.ply", scene)
    g2ard.save_views(folder / "views.json", photographed(folder, scene, around(12)))


def photos_of(
    folder: Path,
    points: bool = False,
    scene: g2ard.Splats = BALL,
    count: int = 24,
    views: g2ard.Cameras | None = None,
) -> None:
    """Write photos of a scene with a transforms.json, and sparse points beside them if requested."""
    views = around(count) if views is None else views
    (folder / "images").mkdir(parents=True)
    K = views.Ks[0]
    size = {"w": int(views.widths[0]), "h": int(views.heights[0])}
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    transforms(folder / "transforms.json", list(views.viewmats), **lens, **size)
    for i, view in enumerate(views):
        write_png(folder / "images" / f"{i:03d}.png", g2ard.render(scene, view).image)
    if points:
        cloud_of(folder / "sparse.ply", scene)
        edit(folder / "transforms.json", lambda content: content.update(ply_file_path="sparse.ply"))


def rgba_photos_of(folder: Path, count: int = 24, distance: float = 3.0) -> g2ard.Cameras:
    """Write RGBA photos of the ball as NeRF's synthetic scenes have them, a third of them for testing."""
    views = around(count, distance=distance)
    names = []
    for i in range(count):
        found = g2ard.render(BALL, views[i])
        alpha = found.alpha[..., None]
        straight = np.clip(found.image / np.maximum(alpha, 1e-3), 0, 1)
        names.append(f"{'test' if i % 3 == 0 else 'train'}/r_{i}")
        path = folder / f"{names[-1]}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(np.concatenate([straight, alpha], 2) * 255).astype(np.uint8)).save(
            path
        )
    angle = 2 * float(np.arctan(views.widths[0] / 2 / views.Ks[0, 0, 0]))
    for split in ("train", "test"):
        listed = [
            {"file_path": f"./{name}", "transform_matrix": (np.linalg.inv(view) @ OPENGL).tolist()}
            for name, view in zip(names, views.viewmats, strict=True)
            if name.startswith(split)
        ]
        content = {"camera_angle_x": angle, "frames": listed}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return views
