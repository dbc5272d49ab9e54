"""Write small inputs under the names that README's *Use* section reads, with nothing but the package.

python inputs.py FOLDER
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import g2ard
from g2ard.io import write_points

SH_C0 = 0.28209479177387814


def coloured(count: int, seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points on a unit sphere and their colours: patches of which no two look alike."""
    patches = np.random.default_rng(5)
    middles = patches.normal(size=(200, 3))
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points, patches.random((200, 3))[np.argmax(points @ middles.T, axis=1)]


def ball(count: int, seed: int = 0) -> g2ard.Splats:
    """Return discs on a unit sphere."""
    normals, colors = coloured(count, seed)
    size = 1.6 * np.sqrt(np.pi / count)
    return g2ard.Splats.create(
        normals.astype(np.float32),
        quats=np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], 1),
        scales=np.tile([size, size, size / 10], (count, 1)),
        logit_opacities=np.full(count, 2.5),
        sh0=((colors - 0.5) / SH_C0)[:, None],
    )


def views(count: int, width: int, distance: float) -> g2ard.Cameras:
    """Return views on a Fibonacci sphere that face its middle."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z**2)
    eyes = distance * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], 1)
    height = 3 * width // 4
    K = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
    return g2ard.Cameras.from_lists(
        [g2ard.look_at(eye, [0, 0, 0]) for eye in eyes],
        [K] * count,
        [(width, height)] * count,
        [f"{k:03d}.png" for k in range(count)],
    )


def photograph(scene: g2ard.Splats, cameras: g2ard.Cameras, folder: Path) -> None:
    """Write a photo of every view, and their transforms.json."""
    from PIL import Image

    folder.mkdir()
    for k in range(len(cameras)):
        image = g2ard.render(scene, cameras[k]).image
        Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(folder / cameras.names[k])
    (folder / "transforms.json").write_text(json.dumps(transforms(cameras)), encoding="utf-8")


def transforms(cameras: g2ard.Cameras) -> dict[str, object]:
    """Return the views as a transforms.json: camera to world, y up, looking along -z."""
    frames = []
    for name, viewmat in zip(cameras.names, cameras.viewmats, strict=True):
        pose = np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    (fx, _, cx), (_, fy, cy), _ = cameras.Ks[0].tolist()
    size = {"w": int(cameras.widths[0]), "h": int(cameras.heights[0])}
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **size, "frames": frames}


def main(folder: Path) -> None:
    """Write scene.ply, room.ply, tree.spz, cloud.ply, photos/, new/ and rough.json."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = ball(6000)
    g2ard.save(folder / "scene.ply", scene)
    g2ard.save(folder / "room.ply", ball(900, seed=1))
    g2ard.save(folder / "tree.spz", ball(700, seed=2))
    points, colors = coloured(260_000)
    write_points(folder / "cloud.ply", g2ard.Points(points, colors.astype(np.float32)))
    photograph(scene, views(24, 96, 3.0), folder / "photos")
    new = views(4, 400, 2.6)
    photograph(scene, new, folder / "new")
    moved = new.viewmats.copy()
    moved[:, :3, 3] += 0.02
    g2ard.save_views(folder / "rough.json", replace(new, viewmats=moved))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
