"""Masks and exposures: found beside photos, and respected by training and scores."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from g2ard import io
from g2ard.config.choices import BLACK
from g2ard.errors import InputError
from g2ard.io import photos
from g2ard.io.exposures import find_exposures
from g2ard.io.images import write_png
from g2ard.io.photos import load_mask
from g2ard.io.types import ViewFiles
from g2ard.rendering.metrics import psnr, ssim
from g2ard.rendering.renderer import render
from g2ard.rendering.targets import Photos
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import PhotoLens
from g2ard.scene.splats import Splats
from g2ard.stages.photo_points.rays import points_along_rays
from g2ard.stages.recover.anchors import Regularizers
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import recover
from g2ard.stages.register.attempts import loaded
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.simplify import simplify
from helpers.scenes import around, assert_same_bits, checkered_ball

BALL = checkered_ball()
VIEWS = around(10)
BARE = Regularizers(0, 0, effective_rank=False)


def photographed(folder: Path, *, spoil: float | None = None, masks: bool = True) -> Cameras:
    """Photos of the ball with a block of rubbish, and masks that leave it out; read back as a user would."""
    paths = []
    for view, name in enumerate(VIEWS.names):
        image = np.clip(render(BALL, VIEWS[view]).image, 0, 1)
        mask = np.ones(image.shape[:2])
        if spoil is not None:
            image[10:30, 20:50] = spoil
            mask[10:30, 20:50] = 0
        (folder / "images").mkdir(parents=True, exist_ok=True)
        paths.append(folder / "images" / f"{name}.png")
        write_png(paths[-1], image)
        if masks:
            (folder / "masks").mkdir(exist_ok=True)
            write_png(folder / "masks" / f"{name}.png", mask)
    io.write_views(folder / "views.json", replace(VIEWS, image_paths=tuple(paths)))
    return io.read_view_set(folder / "views.json").cameras


@pytest.fixture(scope="module")
def student() -> Splats:
    return simplify(BALL, 500, method="paper").splats


def test_masks_beside_the_photos_are_found(tmp_path: Path) -> None:
    cameras = photographed(tmp_path, spoil=1.0)
    mask = load_mask(cameras, 3)
    assert mask.shape == (48, 64)
    assert not mask[10:30, 20:50].any()
    assert mask.sum() == 48 * 64 - 600
    targets = Photos(cameras)
    assert not targets[3][~mask].any()
    assert not Photos(cameras.take([2, 1])).mask(1).all()  # type: ignore[union-attr]
    small = Photos(cameras.resized(32))
    assert small.mask(0).shape == small[0].shape[:2]  # type: ignore[union-attr]
    notes = io.read_view_set(tmp_path / "views.json").notes
    assert [note.count for note in notes if note.code == "masks"] == [10]
    assert Photos(photographed(tmp_path / "bare", masks=False)).mask(0) is None


def test_masks_survive_g2ard_s_own_file(tmp_path: Path) -> None:
    cameras = photographed(tmp_path, spoil=1.0)
    elsewhere = tmp_path / "else" / "where"
    elsewhere.mkdir(parents=True)
    moved = tuple(elsewhere / f"{name}.png" for name in cameras.names)
    for path, mask in zip(moved, cameras.mask_paths, strict=True):
        path.write_bytes(mask.read_bytes())
    io.write_views(tmp_path / "v.json", replace(cameras, mask_paths=moved))
    again = io.read_view_set(tmp_path / "v.json").cameras
    assert [p.resolve() for p in again.mask_paths if p] == [p.resolve() for p in moved]


def test_transforms_json_names_masks(tmp_path: Path) -> None:
    photographed(tmp_path, spoil=1.0, masks=False)
    write_png(tmp_path / "m.png", np.eye(48, 64))
    frame = {
        "file_path": "images/view_000.png",
        "transform_matrix": np.eye(4).tolist(),
        "mask_path": "m.png",
    }
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50, "frames": [frame]}))
    cameras = io.read_view_set(tmp_path / "transforms.json").cameras
    mask = load_mask(cameras, 0)
    assert mask.sum() == 48
    (tmp_path / "m.png").unlink()
    with pytest.raises(InputError, match="does not exist") as caught:
        io.read_view_set(tmp_path / "transforms.json")
    assert (caught.value.property, caught.value.index) == ("mask_path", 0)


@pytest.mark.parametrize("engine", ["fused", "torch"])
def test_masked_content_does_not_matter(student: Splats, tmp_path: Path, engine: Any) -> None:
    config = RecoverConfig(steps=30, engine=engine, regularizers=BARE)
    found = [
        recover(student, Photos(photographed(tmp_path / str(spoil), spoil=spoil)), config)
        for spoil in (1.0, 0.3)
    ]
    assert_same_bits(found[0].splats, found[1].splats)
    assert found[0].report.loss == found[1].report.loss
    assert found[0].report.psnr == found[1].report.psnr


def of_points(cameras: Cameras) -> list[NDArray[Any]]:
    points = points_along_rays(cameras, 200)
    return [points.positions, points.colors]


def of_targets(cameras: Cameras) -> list[NDArray[Any]]:
    return [Photos(cameras)[view] for view in range(len(cameras))]


def of_registration(cameras: Cameras) -> list[NDArray[Any]]:
    photos = [loaded(cameras, view, RegisterConfig(), BLACK) for view in range(len(cameras))]
    levels = [level.grey for photo in photos for _, level in photo.pyramid]
    return [
        array for photo in photos for array in (photo.image, photo.small[1], photo.whole)
    ] + levels


@pytest.mark.parametrize("reader", [of_points, of_targets, of_registration])
@pytest.mark.parametrize("hidden", ["mask", "every second", "alpha", "lens", "distortion"])
def test_hidden_pixels_do_not_matter(
    reader: Callable[[Cameras], list[NDArray[Any]]], hidden: str, tmp_path: Path, monkeypatch: Any
) -> None:
    """Whatever hides pixels, and whatever they show: readers of photos give the same."""
    cameras = photographed(tmp_path, spoil=0.5, masks=hidden in ("mask", "every second"))
    if hidden == "every second":  # the others show the grey block
        masked = tuple(path if i % 2 else None for i, path in enumerate(cameras.mask_paths))
        cameras = replace(cameras, mask_paths=masked)
    if hidden == "alpha":
        for path in filter(None, cameras.image_paths):
            rgba = np.full((48, 64, 4), 255, np.uint8)
            rgba[..., :3] = np.asarray(Image.open(path))
            rgba[10:30, 20:50, 3] = 0
            Image.fromarray(rgba).save(path)
        cameras = io.read_view_set(ViewFiles(tmp_path / "views.json", alpha="mask")).cameras
    if hidden == "lens":
        fisheye = PhotoLens("SIMPLE_RADIAL_FISHEYE", (64, 48), (60.0, 32.0, 24.0, -1.6))
        cameras = replace(cameras, lenses=(fisheye,) * len(cameras))
    if hidden == "distortion":
        cameras = replace(cameras, distortions=np.tile([0.3, 0, 0, 0, 0], (len(cameras), 1)))
    masks = [load_mask(cameras, view) for view in range(len(cameras))]
    assert all(0.1 < mask.mean() < 0.9 for mask in masks[1::2] if mask is not None)
    assert len([mask for mask in masks if mask is not None]) == (
        5 if hidden == "every second" else 10
    )
    read, found = photos._load_image, []
    for colour in (0.2, 0.5):

        def spoiled(own: Cameras, view: int, colour: float = colour) -> NDArray[np.float32]:
            image = read(own, view)
            mask = masks[view]
            if mask is not None and (own.image_paths != own.mask_paths or hidden == "alpha"):
                image[~mask, :3] = colour
            return image

        monkeypatch.setattr(photos, "_load_image", spoiled)
        found.append(reader(cameras))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_start_points_are_not_of_masked_pixels(tmp_path: Path) -> None:
    cameras = photographed(tmp_path)
    for path in filter(None, cameras.image_paths):
        shown = np.asarray(Image.open(path)).copy()
        shown[15:35, 25:45] = 255, 0, 0
        Image.fromarray(shown).save(path)
        mask = np.ones((48, 64))
        mask[15:35, 25:45] = 0
        write_png(tmp_path / "masks" / path.name, mask, overwrite=True)
    assert not (points_along_rays(cameras, 300).colors == (1, 0, 0)).all(1).any()


def test_metrics_use_unmasked_pixels_only() -> None:
    rng = np.random.default_rng(0)
    a = rng.random((40, 50, 3)).astype(np.float32)
    mask = np.zeros((40, 50), bool)
    mask[5:35, 10:40] = True
    b = np.where(mask[..., None], np.clip(a + 0.1, 0, 2), a).astype(np.float32)
    assert psnr(b, a, mask) == pytest.approx(20, abs=0.01)
    assert psnr(b, a) > 20.5
    assert ssim(b, a, mask) < ssim(b, a) - 0.005


def test_exposures_are_undone(tmp_path: Path) -> None:
    cameras = photographed(tmp_path, masks=False)
    plain = Photos(cameras)[1]
    matrix: NDArray[np.float64] = np.array(
        [[0.8, 0, 0.1, 0.02], [0, 0.7, 0, 0.05], [0, 0.1, 0.9, 0]]
    )
    write_png(
        tmp_path / "images" / "view_001.png", plain @ matrix[:, :3].T + matrix[:, 3], overwrite=True
    )
    (tmp_path / "exposure.json").write_text(json.dumps({"view_001.png": matrix.tolist()}))
    found = find_exposures(cameras)
    assert list(found) == ["view_001"]
    np.testing.assert_allclose(Photos(cameras, exposures=found)[1], plain, atol=6e-3)
    np.testing.assert_array_equal(Photos(cameras, exposures=found)[2], Photos(cameras)[2])
    dark: NDArray[np.float64] = np.hstack([np.eye(3) / 2, np.full((3, 1), 0.1)])
    brightened = Photos(cameras, exposures={"view_002": dark})[2]
    assert (brightened.min(), brightened.max()) == (0, 1)  # the contract of targets
    with pytest.raises(InputError, match="exposure of view_001: expected an invertible"):
        Photos(cameras, exposures={"view_001": np.zeros((3, 4))})
    (tmp_path / "exposure.json").write_text('{"view_001": [1, 2]}')
    with pytest.raises(InputError, match=r"exposure.json: property 'view_001\[2\]'"):
        find_exposures(cameras)
