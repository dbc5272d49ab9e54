"""Fisheyes and panoramas distil from one command about as well as pinhole photos of the same scene."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.io.images import resize, write_png
from g2ard.scene.cameras import Camera, Cameras, look_at
from g2ard.scene.lenses import FACES, PhotoLens
from helpers.commands import CommandLine, succeeds
from helpers.photos import cloud_of
from helpers.scenes import checkered_ball
from helpers.view_files import edit, transforms

WIDTH = 160
"""Pixels of a panorama; the others have as many per radian in their middle."""
SIDE, FOCAL = round(WIDTH / np.pi), WIDTH / (2 * np.pi)
REACH = np.radians(100)
"""Angle from the axis that a fisheye sees."""


@pytest.fixture(scope="module")
def room() -> g2ard.Splats:
    """A ball in smooth colours, seen from within."""
    ball = checkered_ball(2000)
    colors = 1.2 * np.sin(3 * ball.means + np.roll(ball.means, 1, axis=1))
    return replace(ball, sh0=colors[:, None].astype(np.float32))


def places(count: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(count, 3))
    spots = (
        0.5
        * ways
        * (rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(ways, axis=1, keepdims=True))
    )
    return [look_at(spot, spot + rng.normal(size=3)) for spot in spots]


def turned(pose: np.ndarray, face: str) -> np.ndarray:
    viewmat = np.eye(4)
    viewmat[:3] = FACES[face].T @ pose[:3]
    return viewmat


def pinhole(pose: np.ndarray, face: str, name: str) -> Camera:
    K = np.array([[SIDE / 2, 0, SIDE / 2], [0, SIDE / 2, SIDE / 2], [0, 0, 1]])
    return Camera(turned(pose, face), K, SIDE, SIDE, f"{name} {face}")


def fisheye(wide: np.ndarray, face: str) -> np.ndarray:
    """An equidistant photo, of nine samples of a panorama of three times the width in each pixel."""
    side = 2 * round(FOCAL * REACH)
    v, u = (np.mgrid[0 : 3 * side, 0 : 3 * side] + 0.5) / 3 - side / 2
    angle = np.hypot(u, v) / FOCAL
    sine = np.sin(angle) / np.maximum(angle, 1e-9) / FOCAL
    rays = np.stack([u * sine, v * sine, np.cos(angle)], -1).reshape(-1, 3) @ FACES[face].T
    pixels, _ = PhotoLens("EQUIRECTANGULAR", wide.shape[1::-1], ()).project(rays)
    rows, columns = (
        np.minimum(pixels[:, 1].astype(int), 2 * WIDTH - 1),
        pixels[:, 0].astype(int) % (4 * WIDTH),
    )
    shown = np.where(
        (angle < REACH)[..., None], wide[rows, columns].reshape(3 * side, 3 * side, 3), 0
    )
    return resize(shown.astype(np.float32), (side, side))


def square(side: int, focal: float) -> dict[str, float]:
    return {"w": side, "h": side, "fl_x": focal, "fl_y": focal, "cx": side / 2, "cy": side / 2}


def written(folder: Path, kind: str, scene: g2ard.Splats) -> Path:
    """Write photos of the kind at the same places, and their transforms.json."""
    renderer, poses = g2ard.Renderer(scene), places(8, 1)
    if kind == "panorama":
        shown = [
            (pose, renderer.panorama(Camera(pose, np.eye(3), 8, 8), width=WIDTH).image)
            for pose in poses
        ]
        lens: dict[str, object] = {"camera_model": "EQUIRECTANGULAR", "w": WIDTH, "h": WIDTH // 2}
    elif kind == "fisheye":
        shown = []
        for pose in poses:
            wide = renderer.panorama(Camera(pose, np.eye(3), 8, 8), width=3 * WIDTH).image
            shown += [(turned(pose, face), fisheye(wide, face)) for face in ("front", "back")]
        side = shown[0][1].shape[0]
        lens = {"camera_model": "OPENCV_FISHEYE", **square(side, FOCAL)}
    else:
        views = [pinhole(pose, face, str(i)) for i, pose in enumerate(poses) for face in FACES]
        shown = [(view.viewmat, renderer.image(view)) for view in views]
        lens = square(SIDE, SIDE / 2)
    folder.mkdir()
    for i, (_, image) in enumerate(shown):
        write_png(folder / f"{i:03d}.png", np.clip(image, 0, 1))
    path = transforms(folder / "transforms.json", [pose for pose, _ in shown], **lens)
    edit(
        path,
        lambda c: [frame.update(file_path=f"{i:03d}.png") for i, frame in enumerate(c["frames"])],
    )
    return path


def test_scores_are_those_of_pinhole_photos(
    tmp_path: Path, room: g2ard.Splats, command_line: CommandLine
) -> None:
    cloud_of(tmp_path / "cloud.ply", room)
    held = Cameras.of(
        pinhole(pose, face, f"held {i}")
        for i, pose in enumerate(places(3, 2))
        for face in ("front", "up", "left")
    )
    truth, scores = [g2ard.Renderer(room).clipped(view) for view in held], {}
    for kind in ("pinhole", "panorama", "fisheye"):
        path = written(tmp_path / kind, kind, room)
        ask = ("distill", "cloud.ply", "--views", path, "-n", 700, "--no-page", "-o", f"{kind}.run")
        succeeds(command_line, tmp_path, *ask)
        found = g2ard.Renderer(g2ard.load(tmp_path / f"{kind}.run" / "scene.ply"))
        off = [
            np.mean((found.clipped(view) - image) ** 2)
            for view, image in zip(held, truth, strict=True)
        ]
        scores[kind] = float(np.mean(-10 * np.log10(off)))
        report = json.loads((tmp_path / f"{kind}.run" / "report.json").read_text())
        assert report["scores"]["recovered"]["psnr"] > 25, kind
    assert scores["pinhole"] > 30, scores
    assert scores["panorama"] > scores["pinhole"] - 0.5, scores
    assert scores["fisheye"] > scores["pinhole"] - 0.5, scores
