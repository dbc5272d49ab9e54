"""Fisheye photos and panoramas become the pinhole views that they show."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.io import read_views, write_views
from g2ard.io.photos import load_mask, load_photo
from g2ard.io.views import read_view_set
from g2ard.scene.lenses import FACES, PhotoLens
from helpers.view_files import colmap, edit, orbit, transforms

LENSES = {
    "OPENCV_FISHEYE": (60, 61, 100, 74, 0.02, -0.01, 0.004, -0.001),
    "FULL_OPENCV": (120, 121, 100, 74, 0.1, -0.05, 0.01, -0.02, 0.01, 0.05, -0.02, 0.003),
    "FOV": (120, 121, 100, 74, 0.9),
    "SIMPLE_RADIAL_FISHEYE": (60, 100, 74, 0.03),
    "RADIAL_FISHEYE": (60, 100, 74, 0.03, -0.005),
    "THIN_PRISM_FISHEYE": (60, 61, 100, 74, 0.02, -0.01, 0.01, -0.02, 0.004, -0.001, 0.01, -0.02),
    "SIMPLE_FISHEYE": (60, 100, 74),
    "FISHEYE": (60, 61, 100, 74),
}
SIZE = (200, 150)


def rays(count: int = 300, most: float = 0.8) -> np.ndarray:
    rng = np.random.default_rng(0)
    angle, turn = rng.uniform(0, most, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], 1)


@pytest.mark.parametrize("model", LENSES)
def test_models_are_those_of_colmap(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=LENSES[model])
    seen, inside = PhotoLens(model, SIZE, LENSES[model]).project(rays())
    assert inside.sum() > 100
    np.testing.assert_allclose(seen, camera.img_from_cam(rays()), atol=1e-9)


FALLING = {
    "OPENCV_FISHEYE": (60, 61, 100, 74, -0.2, 0, 0, 0),
    "FULL_OPENCV": (60, 61, 100, 74, -0.2, 0, 0, 0, 0, 0, 0, 0),
    "SIMPLE_RADIAL_FISHEYE": (60, 100, 74, -0.2),
    "RADIAL_FISHEYE": (60, 100, 74, -0.3, 0.02),
    "THIN_PRISM_FISHEYE": (60, 61, 100, 74, -0.3, 0.02, 0, 0, 0, 0, 0, 0),
}
"""Lenses whose radius stops growing within the photo."""


@pytest.mark.parametrize("model", FALLING)
def test_a_lens_ends_where_its_radius_stops_growing(model: str) -> None:
    angles = np.linspace(0.001, np.pi - 0.001, 5000)
    sideways = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], 1)
    seen, inside = PhotoLens(model, SIZE, FALLING[model]).project(sideways)
    held = int(inside.sum())
    assert inside[:held].all()
    assert (np.diff(seen[:held, 0]) > 0).all()
    assert seen[held - 1, 0] < SIZE[0] - 20  # not at the photo's edge
    assert 0.7 < angles[held] < 1.6


@pytest.mark.parametrize("model", LENSES)
def test_faces_turn_rays(model: str) -> None:
    lens = PhotoLens(model, SIZE, LENSES[model])
    for turn in FACES.values():
        own, inside = lens.turned(turn).project(rays() @ turn)
        np.testing.assert_allclose(own[inside], lens.project(rays())[0][inside], atol=1e-9)
        assert np.linalg.det(turn) == pytest.approx(1)


def pattern(d: np.ndarray) -> np.ndarray:
    """A smooth picture on the sphere of directions."""
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(3 * d + np.roll(d, 1, axis=-1))


def panorama(width: int) -> np.ndarray:
    """nerfstudio's equirectangular photo: the middle looks ahead, right is right, the top is up."""
    v, u = (np.mgrid[0 : width // 2, 0:width] + 0.5) / width
    around, down = 2 * np.pi * (u - 0.5), 2 * np.pi * (v - 0.25)
    return pattern(
        np.stack([np.sin(around) * np.cos(down), np.sin(down), np.cos(around) * np.cos(down)], -1)
    )


def fisheye(width: int, focal: float) -> np.ndarray:
    """An equidistant photo; black beyond 109° from its axis."""
    v, u = np.mgrid[0:width, 0:width] + 0.5 - width / 2
    angle = np.hypot(u, v) / focal
    sine = np.sin(angle) / np.maximum(angle, 1e-9) / focal
    image = pattern(np.stack([u * sine, v * sine, np.cos(angle)], -1))
    return np.where((angle < 1.9)[..., None], image, 0)


def captured(folder: Path, image: np.ndarray, count: int = 9, **top: object) -> Path:
    path = transforms(folder / "transforms.json", orbit(count), **top)
    (folder / "images").mkdir(exist_ok=True)
    for i in range(count):
        Image.fromarray(np.rint(image * 255).astype(np.uint8)).save(
            folder / "images" / f"{i:03d}.png"
        )
    edit(
        path,
        lambda c: [
            frame.update(file_path=f"images/{i:03d}.png") for i, frame in enumerate(c["frames"])
        ],
    )
    return path


def check_faces(views: g2ard.Cameras, poses: list[np.ndarray], least: float) -> None:
    """Compare views of one photo with the picture in the directions of their pixels."""
    shown = 0
    for i, view in enumerate(views):
        v, u = np.mgrid[0 : view.height, 0 : view.width] + 0.5
        local = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.K).T
        world = local @ view.viewmat[:3, :3]
        expected = pattern(world @ poses[0][:3, :3].T)
        np.testing.assert_allclose(view.position, -poses[0][:3, :3].T @ poses[0][:3, 3], atol=1e-9)
        mask = load_mask(views, i)
        mask = np.ones(u.shape, bool) if mask is None else mask
        shown += mask.sum()
        assert np.abs(load_photo(views, i)[0] - expected)[mask].max() < 0.03
    assert shown >= least


@pytest.mark.parametrize("longest", [None, 60])
def test_a_panorama_becomes_six_faces(tmp_path: Path, longest: int | None) -> None:
    path = captured(tmp_path, panorama(512), camera_model="EQUIRECTANGULAR", w=512, h=256)
    found = read_view_set(path)
    assert len(found.cameras) == 6 * 9
    assert any(note.code == "resampled" and "54 pinhole views" in str(note) for note in found.notes)
    assert {name.rpartition("#")[2] for name in found.cameras.names} == set(FACES)
    check_faces(
        found.cameras.take(range(6)).resized(longest), orbit(9), 6 * min(longest or 163, 163) ** 2
    )


def test_a_panorama_has_no_seam(tmp_path: Path) -> None:
    """Each side of a photo is the side before it of the photo turned by a quarter, noise and all."""
    noise = np.random.default_rng(0).random((64, 128, 3))
    lens = {"camera_model": "EQUIRECTANGULAR", "w": 128, "h": 64}
    sides = []
    for name, image in (("as it is", noise), ("turned", np.roll(noise, 32, axis=1))):
        (tmp_path / name).mkdir()
        views = read_views(captured(tmp_path / name, image, 1, **lens))
        sides.append(
            {view.name.partition("#")[2]: load_photo(views, i)[0] for i, view in enumerate(views)}
        )
    for side, following in itertools.pairwise(("front", "right", "back", "left", "front")):
        np.testing.assert_allclose(sides[0][side], sides[1][following], atol=1e-5)


FISHEYE = {"fl_x": 80.0, "fl_y": 80.0, "cx": 150, "cy": 150, "w": 300, "h": 300}


@pytest.mark.parametrize("longest", [None, 60, 33])
@pytest.mark.parametrize("how", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye_becomes_the_faces_that_it_saw(
    tmp_path: Path, how: dict, longest: int | None
) -> None:
    path = captured(tmp_path, fisheye(300, 80.0), **FISHEYE, **how)
    views = read_views(path).resized(longest)
    first = views.take([i for i, name in enumerate(views.names) if name.startswith("000.png")])
    assert [name.rpartition("#")[2] for name in first.names] == [
        "front",
        "right",
        "left",
        "up",
        "down",
    ]
    masks = [load_mask(first, i) for i in range(5)]
    assert masks[0] is None
    assert all(mask is not None and 0.3 < mask.mean() < 0.9 for mask in masks[1:])
    check_faces(first, orbit(9), 2.8 * min(longest or 160, 160) ** 2)


def test_a_narrow_fisheye_becomes_one_view(tmp_path: Path) -> None:
    colmap(tmp_path, orbit(1), text=True)
    cameras = tmp_path / "sparse" / "0" / "cameras.txt"
    cameras.write_text("7 SIMPLE_FISHEYE 120 120 90 60 60\n")
    (tmp_path / "images").mkdir()
    picture = np.rint(fisheye(120, 90.0) * 255).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "images" / "photo 0.png")
    views = read_views(tmp_path)
    assert views.names == ("photo 0.png",)
    check_faces(views, orbit(1), 100 * 100)


def test_a_photo_is_held_out_as_a_whole(tmp_path: Path) -> None:
    path = captured(tmp_path, panorama(64), camera_model="EQUIRECTANGULAR", w=64, h=32)
    test = read_views(path, split="test")
    assert len(test) == 2 * 6
    assert {name.partition("#")[0] for name in test.names} == {"000.png", "008.png"}
    (tmp_path / "split.json").write_text('{"train": ["000"], "test": ["003.png"]}')
    assert {name.partition("#")[0] for name in read_views(path, split="test").names} == {"003.png"}


def test_views_of_lenses_survive_writing(tmp_path: Path) -> None:
    path = captured(tmp_path, panorama(64), 1, camera_model="EQUIRECTANGULAR", w=64, h=32)
    views = read_views(path)
    write_views(tmp_path / "v.json", views)
    again = read_views(tmp_path / "v.json")
    assert (again.names, again.lenses) == (views.names, views.lenses)
    np.testing.assert_array_equal(load_photo(again, 3)[0], load_photo(views, 3)[0])
    with pytest.warns(UserWarning, match="photos of 6 views"):
        write_views(tmp_path / "transforms_2.json", views)


@pytest.mark.parametrize("kind", ["panorama", "fisheye"])
@pytest.mark.parametrize("place", ["masks/{}.png", "own"])
def test_masks_go_through_the_lens(tmp_path: Path, kind: str, place: str) -> None:
    """The left half of each photo is masked, by a file in a folder or one that the frame names."""
    if kind == "panorama":
        size, lens = (256, 128), {"camera_model": "EQUIRECTANGULAR", "w": 256, "h": 128}
        path = captured(tmp_path, panorama(256), 1, **lens)
    else:
        lens = {"camera_model": "OPENCV_FISHEYE", **FISHEYE}
        size, path = (300, 300), captured(tmp_path, fisheye(300, 80.0), 1, **lens)
    mask = Image.fromarray(
        np.repeat(255 * (np.arange(size[0]) >= size[0] / 2), size[1])
        .reshape(size)
        .T.astype(np.uint8)
    )
    file = tmp_path / (place.format("000.png") if "{" in place else "left.png")
    file.parent.mkdir(exist_ok=True)
    mask.save(file)
    if place == "own":
        edit(path, lambda c: c["frames"][0].update(mask_path="left.png"))
    views = read_views(path)
    kept = 0
    for i, view in enumerate(views):
        v, u = np.mgrid[0 : view.height, 0 : view.width] + 0.5
        rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(view.K).T
        seen, held = view.lens.project(rays)
        found = load_mask(views, i)
        assert found is not None or (held & (seen[:, 0] > size[0] / 2)).all()
        found = np.ones(u.size, bool) if found is None else found.ravel()
        clear = (
            held
            & (np.abs(seen[:, 0] - size[0] / 2) > 2)
            & (seen[:, 0] > 2)
            & (seen[:, 0] < size[0] - 2)
        )
        np.testing.assert_array_equal(found[clear], seen[clear, 0] > size[0] / 2)
        kept += found.sum()
    assert kept > 1000
