"""Panoramas rendered from a scene: directions, distances, and that they are read in as they were written."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.errors import InputError
from g2ard.io.images import write_png
from g2ard.io.photos import load_photo
from g2ard.scene.cameras import Camera, look_at
from g2ard.scene.lenses import FACES, PhotoLens, panorama_rays
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball
from helpers.view_files import edit, transforms

BALL = checkered_ball(3000)
POSES = [
    look_at([0.1, 0.2, -0.1], [1, 0.5, 0.3]),
    look_at([-0.2, 0, 0.3], [0, -0.1, -1], up=[0.2, 1, 0]),
]


@pytest.mark.parametrize(
    ("width", "rows"), [(8, slice(0, 4)), (64, slice(5, 9)), (100, slice(49, 50))]
)
def test_rays_are_those_of_the_lens(width: int, rows: slice) -> None:
    rays = panorama_rays(width, width // 2, rows)
    v, u = np.mgrid[rows, 0:width] + 0.5
    seen, inside = PhotoLens("EQUIRECTANGULAR", (width, width // 2), ()).project(rays)
    np.testing.assert_allclose(seen, np.stack([u.ravel(), v.ravel()], 1), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    assert inside.all()


CORNERS = [
    (1, 1, 1),
    (1, 1, 0),
    (0, 1, 1),
    (1, 0, -1),
    (0, 0, -1),
    (0, 1, 0),
    (0, -1, 0),
    (-1, -1, 1),
]


@pytest.mark.parametrize("pose", POSES)
def test_a_dot_is_seen_in_its_direction_and_distance(pose: np.ndarray) -> None:
    """Also where faces meet."""
    rng = np.random.default_rng(0)
    rays = panorama_rays(256, 128, slice(0, 128))
    for way in np.concatenate([CORNERS, rng.normal(size=(8, 3))]):
        way, far = way / np.linalg.norm(way), rng.uniform(1, 9)
        place = np.linalg.inv(pose)[:3] @ [*(way * far), 1]
        dot = g2ard.Splats.create([place], scales=[[0.02 * far] * 3], logit_opacities=[9])
        seen = g2ard.Renderer(dot).panorama(Camera(pose, np.eye(3), 8, 8), width=256)
        assert seen.image.shape == (128, 256, 3)
        solid_angles = np.hypot(rays[:, 0], rays[:, 2])
        middle = (rays * (seen.alpha.ravel() * solid_angles)[:, None]).sum(0)
        off = np.linalg.norm(np.cross(middle / np.linalg.norm(middle), way)) * 256 / (2 * np.pi)
        assert off < 0.1  # pixels
        peak = seen.alpha.argmax()
        assert seen.depth.flat[peak] / seen.alpha.flat[peak] == pytest.approx(far, rel=0.02)


@pytest.mark.parametrize(("width", "least"), [(256, 34), (150, 30)])
def test_faces_of_a_written_panorama_are_renders_of_the_scene(
    tmp_path: Path, width: int, least: float
) -> None:
    path = transforms(
        tmp_path / "transforms.json", POSES, camera_model="EQUIRECTANGULAR", w=width, h=width // 2
    )
    edit(
        path, lambda c: [frame.update(file_path=f"{i}.png") for i, frame in enumerate(c["frames"])]
    )
    renderer = g2ard.Renderer(BALL)
    for i, pose in enumerate(POSES):
        seen = renderer.panorama(Camera(pose, np.eye(3), 8, 8), width=width)
        write_png(tmp_path / f"{i}.png", np.clip(seen.image, 0, 1))
    views = g2ard.load_views(path)
    assert len(views) == 2 * len(FACES)
    for i, view in enumerate(views):
        off = load_photo(views, i)[0] - renderer.clipped(view)
        assert -10 * np.log10(np.mean(np.square(off))) > least, view.name


@pytest.mark.parametrize("size", [128, 65])
def test_command_line(tmp_path: Path, command_line: CommandLine, size: int) -> None:
    g2ard.save(tmp_path / "scene.ply", checkered_ball(200))
    g2ard.save_views(tmp_path / "views.json", around(2))
    ask = (
        "render",
        "scene.ply",
        "--panorama",
        "--size",
        size,
        "--views",
        "views.json",
        "-o",
        "out",
    )
    succeeds(command_line, tmp_path, *ask, "--depth", "--sheet", "sheet.png")
    names = g2ard.load_views(tmp_path / "views.json").names
    width = size // 2 * 2
    assert {Image.open(tmp_path / "out" / f"{name}.png").size for name in names} == {
        (width, width // 2)
    }
    assert np.load(tmp_path / "out" / f"{names[0]}.depth.npy").shape == (width // 2, width)
    assert (tmp_path / "sheet.png").is_file()
    if size == 128:  # read in again, all faces of a photo give one panorama in its axes
        shown = {"camera_model": "EQUIRECTANGULAR", "w": 128, "h": 64}
        poses = list(g2ard.load_views(tmp_path / "views.json").viewmats)
        path = transforms(tmp_path / "transforms.json", poses, **shown)
        edit(
            path,
            lambda c: [
                f.update(file_path=f"out/{n}.png") for f, n in zip(c["frames"], names, strict=True)
            ],
        )
        again = ("--panorama", "--size", 128, "--views", "transforms.json", "-o", "two")
        succeeds(command_line, tmp_path, "render", "scene.ply", *again)
        found = sorted((tmp_path / "two").rglob("*.png"))
        assert len(found) == 2
        for one, other in zip(sorted((tmp_path / "out").glob("*.png")), found, strict=True):
            np.testing.assert_allclose(
                np.asarray(Image.open(one), int), np.asarray(Image.open(other), int), atol=1
            )


def test_odd_widths_are_refused() -> None:
    with pytest.raises(InputError, match="width"):
        g2ard.Renderer(BALL).panorama(around(1)[0], width=63)
