"""Views of public data sets, on small files of their true form."""

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from g2ard import io
from g2ard.errors import InputError
from g2ard.io.detect import KINDS, MODULES
from g2ard.io.photos import load_photo
from helpers.dataset_files import POSES, llff, mip_nerf_360, opengl, polycam
from helpers.faults import faulty
from helpers.view_files import photo


def test_matrix_citys_pose_folder_states_its_splits(tmp_path: Path) -> None:
    pose = tmp_path / "aerial" / "pose" / "block_A"
    pose.mkdir(parents=True)
    head = {"camera_angle_x": 0.7853981633974483, "camera_angle_y": 0.4735, "w": 192, "h": 108}
    head |= {
        "fl_x": 231.8,
        "fl_y": 231.8,
        "cx": 96.0,
        "cy": 54.0,
        "k1": 0,
        "k2": 0,
        "p1": 0,
        "p2": 0,
    }
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
    assert load_photo(test, 2)[0][0, 0, 0] == pytest.approx(80 / 255)
    assert len(io.read_views(pose / "transforms_train.json", split="train")) == 6


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


def test_mip_nerf_360_at_a_quarter(tmp_path: Path) -> None:
    mip_nerf_360(tmp_path)
    whole, quarter = io.read_views(tmp_path), io.read_views(tmp_path / "images_4")
    assert (whole.widths[0], quarter.widths[0], quarter.heights[0]) == (400, 100, 75)
    np.testing.assert_allclose(quarter.Ks[0], [[95, 0, 50.25], [0, 95.25, 37.25], [0, 0, 1]])
    np.testing.assert_allclose(quarter.viewmats, POSES, atol=1e-9)
    assert load_photo(quarter, 0)[0].shape == (75, 100, 3)
    half = io.read_views(tmp_path, images=tmp_path / "images_2", split="test")
    assert half.names == ("DSC0000.JPG", "DSC0008.JPG")  # every 8th: llffhold
    assert half.widths[0] == 200


def test_llff(tmp_path: Path) -> None:
    llff(tmp_path)
    for path in (tmp_path, tmp_path / "poses_bounds.npy"):
        found = io.read_view_set(path)
        np.testing.assert_allclose(found.cameras.viewmats, POSES, atol=1e-9)
        np.testing.assert_allclose(found.cameras.Ks[0], [[95, 0, 50], [0, 95, 37.5], [0, 0, 1]])
        assert found.cameras.names[3] == "IMG_0003.JPG"
        assert load_photo(found.cameras, 3)[0].shape == (75, 100, 3)
    photo(tmp_path / "images_4" / "IMG_0009.JPG", (100, 75))
    with pytest.raises(InputError, match=r"has 9 poses for 10 photos in .*images_4"):
        io.read_views(tmp_path)


def test_a_damaged_poses_bounds_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "poses_bounds.npy"
    np.save(file, np.zeros((3, 12)))
    with pytest.raises(InputError, match="holds 3×12 values of float64, expected N×17"):
        io.read_views(file)
    np.save(file, np.zeros((3, 17)))
    with faulty(file, (None, 0)):
        io.read_views(file)


@pytest.mark.parametrize(("folder", "notes"), [("corrected_", []), ("", ["tracked_poses"])])
def test_polycam(folder: str, notes: list[str], tmp_path: Path) -> None:
    polycam(tmp_path, folder)
    found = io.read_view_set(tmp_path)
    np.testing.assert_allclose(found.cameras.viewmats, POSES, atol=1e-9)
    np.testing.assert_allclose(found.cameras.Ks[0], [[95, 0, 51], [0, 96, 37], [0, 0, 1]])
    # in order of time
    assert found.cameras.names[:3] == ("9999000.jpg", "9999500.jpg", "10000000.jpg")
    assert [note.code for note in found.notes] == notes
    file = next((tmp_path / "keyframes").glob("*cameras/*.json"))
    file.write_text("{}")
    with faulty(file, ("t_00", None)):
        io.read_views(tmp_path)


@pytest.mark.parametrize("key", ["K", "intrinsics"])
def test_a_frame_may_carry_its_matrix_and_photos_may_lie_beside_the_file(
    key: str, tmp_path: Path
) -> None:
    frames = []
    for i, view in enumerate(POSES):
        K = [[90.0 + i, 0, 50], [0, 91, 40], [0, 0, 1]]
        frame = {"file_path": f"images/{i}.png", key: K, "transform_matrix": opengl(view).tolist()}
        frames.append(frame)
        photo(tmp_path / f"{i}.png", (100, 80))
    file = tmp_path / "cameras_of_a_person.json"
    file.write_text(json.dumps({"frames": frames}))
    found = io.read_views(file)
    np.testing.assert_allclose(found.Ks[2], [[92, 0, 50], [0, 91, 40], [0, 0, 1]])
    assert found.image_paths[2] == tmp_path / "2.png"
    frames[1][key] = [[0, 0, 50], [0, 91, 40], [0, 0, 1]]
    file.write_text(json.dumps({"frames": frames}))
    with faulty(file, (key, 1)):
        io.read_views(file)


@pytest.mark.parametrize("part", ["sparse/0/images.txt", "sparse/0/cameras.txt"])
def test_a_colmap_model_without_a_table_says_which(part: str, tmp_path: Path) -> None:
    mip_nerf_360(tmp_path)
    (tmp_path / part).unlink()
    for path in (tmp_path, tmp_path / "sparse" / "0"):
        with pytest.raises(
            InputError,
            match=f"COLMAP model without {Path(part).name}; found .*copy the whole model",
        ):
            io.read_views(path)


@pytest.mark.parametrize("name", KINDS)
def test_every_line_of_the_table_names_a_reader(name: str, tmp_path: Path) -> None:
    module = import_module(f"g2ard.io.{MODULES.get(name, name)}")
    assert hasattr(module, "read") or (hasattr(module, "Stream") and KINDS[name] != "views")
    assert not hasattr(module, "holds") or not module.holds(tmp_path)
