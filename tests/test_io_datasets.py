"""Views of public data sets, on small files of their true form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard import io
from g2ard.errors import InputError
from g2ard.scene.cameras import look_at
from g2ard.scene.images import load_image


def photo(path: Path, size: tuple[int, int], shade: int = 90) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (shade, 40, 10)).save(path)


POSES = [look_at([3 * np.cos(a), 3 * np.sin(a), 1.5], [0, 0, 0]) for a in np.linspace(0, 5, 9)]


def wxyz(R: np.ndarray) -> np.ndarray:
    """From the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    K = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            K[i, j] = R[i, j] + R[j, i]
    K[:3, :3] -= np.eye(3) * np.trace(R)
    K[3, :3] = K[:3, 3] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    K[3, 3] = np.trace(R)
    x, y, z, w = np.linalg.eigh(K)[1][:, 3]
    return np.array([w, x, y, z])


def opengl(view: np.ndarray) -> np.ndarray:
    return np.linalg.inv(view) @ np.diag([1.0, -1, -1, 1])


def test_matrix_citys_pose_folder_states_its_splits(tmp_path: Path) -> None:
    pose = tmp_path / "aerial" / "pose" / "block_A"
    pose.mkdir(parents=True)
    head = {"camera_angle_x": 0.7853981633974483, "camera_angle_y": 0.4735, "w": 192, "h": 108}
    head |= {"fl_x": 231.8, "fl_y": 231.8, "cx": 96.0, "cy": 54.0, "k1": 0, "k2": 0, "p1": 0, "p2": 0}
    for split, rows in (("train", range(6)), ("test", range(6, 9))):
        block = "block_1" if split == "train" else "block_1_test"
        frames = []
        for i in rows:
            photo(tmp_path / "aerial" / split / block / f"{i:04d}.png", (192, 108), 10 * i)
            where = f"../../{split}/{block}/{i:04d}.png"
            frames.append({"file_path": where, "transform_matrix": opengl(POSES[i]).tolist()})
        (pose / f"transforms_{split}.json").write_text(json.dumps({**head, "frames": frames}))
    found = io.read_view_set(pose)
    assert found.splits == ("train",) * 6 + ("test",) * 3
    assert found.notes == ()
    test = io.read_views(pose, split="test")
    np.testing.assert_allclose(test.viewmats, POSES[6:], atol=1e-9)
    assert test.Ks[0, 0, 0] == 231.8
    assert load_image(test, 2)[0, 0, 0] == pytest.approx(80 / 255)
    assert len(io.read_views(pose / "transforms_train.json")) == 6


def test_matrix_citys_blocks_have_numbers_and_small_rotations(tmp_path: Path) -> None:
    block = tmp_path / "block_1"
    frames = []
    for i, view in enumerate(POSES[:4]):
        matrix = opengl(view)
        matrix[:3, :3] /= 100
        frames.append({"frame_index": i + 7, "rot_mat": matrix.tolist()})
        photo(block / "rgb" / f"{i + 7:04d}.png", (64, 36))
    content = {"camera_angle_x": 0.7853981633974483, "frames": frames}
    (block / "transforms.json").write_text(json.dumps(content))
    found = io.read_views(block)
    np.testing.assert_allclose(found.viewmats, POSES[:4], atol=1e-9)
    assert found.names[0] == "rgb/0007.png"
    np.testing.assert_allclose(found.Ks[0, 0, 0], 32 / np.tan(np.pi / 8))


def mip_nerf_360(root: Path) -> None:
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("# x\n1 PINHOLE 400 300 380 381 201 149\n")
    rows = []
    for i, view in enumerate(POSES):
        q, t = wxyz(view[:3, :3]), view[:3, 3]
        rows.append(" ".join(map(str, (i + 1, *q, *t, 1, f"DSC{i:04d}.JPG"))) + "\n\n")
        for folder, size in (("images", (400, 300)), ("images_2", (200, 150)), ("images_4", (100, 75))):
            photo(root / folder / f"DSC{i:04d}.JPG", size)
    (model / "images.txt").write_text("".join(rows))


def test_mip_nerf_360_at_a_quarter(tmp_path: Path) -> None:
    mip_nerf_360(tmp_path)
    whole, quarter = io.read_views(tmp_path), io.read_views(tmp_path / "images_4")
    assert (whole.widths[0], quarter.widths[0], quarter.heights[0]) == (400, 100, 75)
    np.testing.assert_allclose(quarter.Ks[0], [[95, 0, 50.25], [0, 95.25, 37.25], [0, 0, 1]])
    np.testing.assert_allclose(quarter.viewmats, POSES, atol=1e-9)
    assert load_image(quarter, 0).shape == (75, 100, 3)
    half = io.read_views(tmp_path, images=tmp_path / "images_2", split="test")
    assert half.names == ("DSC0000.JPG", "DSC0008.JPG")  # every 8th: llffhold
    assert half.widths[0] == 200


def cambridge(root: Path, size: tuple[int, int] = (192, 108)) -> None:
    lines = {"train": [], "test": []}
    cameras = []
    for i, view in enumerate(POSES):
        split = "test" if i >= 6 else "train"
        name = f"seq{2 if split == 'test' else 1}/frame{i:05d}"
        q, c = wxyz(view[:3, :3]), -view[:3, :3].T @ view[:3, 3]
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


def test_cambridge_landmarks(tmp_path: Path) -> None:
    cambridge(tmp_path)
    found = io.read_view_set(tmp_path)
    assert found.splits == ("train",) * 6 + ("test",) * 3
    np.testing.assert_allclose(found.cameras.viewmats, POSES, atol=1e-7)
    np.testing.assert_allclose(found.cameras.Ks[0], [[167, 0, 96], [0, 167, 54], [0, 0, 1]])
    np.testing.assert_allclose(found.cameras.distortions[0], [0.05, 0, 0, 0, 0])
    assert found.cameras.Ks[4, 0, 0] == pytest.approx(167.4)  # the median, for it is not listed
    assert [note.code for note in found.notes] == ["guessed_focal"]
    assert len(io.read_views(tmp_path, split="test")) == 3
    assert io.kind(tmp_path) == "views"


def test_cambridges_errors_name_the_line(tmp_path: Path) -> None:
    cambridge(tmp_path)
    path = tmp_path / "dataset_test.txt"
    text = path.read_text()
    for broken, message in (
        (text.replace("seq2/frame00007.png", "seq2/frame00007.png x"), "line 5"),
        (text.replace("seq2/frame00007.png ", ""), "line 5"),
    ):
        path.write_text(broken)
        with pytest.raises(InputError, match=message):
            io.read_views(tmp_path)
    path.write_text(text)
    (tmp_path / "reconstruction.nvm").write_text("nothing")
    with pytest.raises(InputError, match="NVM_V3"):
        io.read_views(tmp_path)
