"""transforms.json, of instant-ngp, nerfstudio and NeRF's synthetic scenes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import kind, read_view_set, read_views
from helpers.faults import faulty
from helpers.realdata import real
from helpers.view_files import edit, orbit, photo, transforms


def test_transforms(tmp_path: Path) -> None:
    truth = orbit(4)
    path = transforms(tmp_path / "transforms.json", truth, k1=0.1, k2=0.2, p1=0.3, p2=0.4)
    for i in (0, 1, 3):
        photo(tmp_path / "images" / f"{i:03d}.png")
    found = read_view_set(tmp_path)
    assert found.cameras.names == ("000.png", "001.png", "003.png")
    np.testing.assert_allclose(found.cameras.viewmats, [truth[i] for i in (0, 1, 3)], atol=1e-12)
    np.testing.assert_array_equal(found.cameras.Ks[0], [[10, 0, 4.5], [0, 11, 2.5], [0, 0, 1]])
    np.testing.assert_array_equal(found.cameras.distortions[0], [0.1, 0.2, 0.3, 0.4, 0])
    (note,) = found.notes
    assert (note.code, note.count) == ("missing_photos", 1)
    assert "002.png" in note.text
    assert kind(path) == "views"


def test_a_frame_has_its_own_intrinsics(tmp_path: Path) -> None:
    path = transforms(tmp_path / "a.json", orbit(2))
    edit(path, lambda c: c["frames"][1].update(fl_x=20, fl_y=21, w=16, h=12, cx=8, cy=6))
    cameras = read_views(path)
    assert cameras.widths.tolist() == [8, 16]
    assert cameras.Ks[:, 0, 0].tolist() == [10, 20]


def test_blender_style(tmp_path: Path) -> None:
    """camera_angle_x alone, names without suffix, size from the photo."""
    angle = 0.7
    none = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    path = transforms(tmp_path / "a.json", orbit(1), camera_angle_x=angle, **none)
    edit(path, lambda c: c["frames"][0].update(file_path="./train/r_0"))
    file = photo(tmp_path / "train" / "r_0.png", (40, 30))
    cameras = read_views(path)
    assert cameras.names == ("train/r_0",)
    assert cameras.image_paths == (file,)
    focal = 20 / math.tan(angle / 2)
    np.testing.assert_allclose(cameras.Ks[0], [[focal, 0, 20], [0, focal, 15], [0, 0, 1]])


def test_poses_without_any_photo_stay(tmp_path: Path) -> None:
    found = read_view_set(transforms(tmp_path / "a.json", orbit(3)))
    assert len(found.cameras) == 3
    assert found.cameras.image_paths == (None, None, None)
    assert [n.code for n in found.notes] == ["no_photos"]


def test_a_fisheye_of_more_terms_is_refused(tmp_path: Path) -> None:
    path = transforms(tmp_path / "a.json", orbit(2))
    edit(path, lambda c: c["frames"][1].update(k6=-0.1, camera_model="OPENCV_FISHEYE"))
    with faulty(path, ("k6", 1)):
        read_views(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not JSON"),
        *(
            (content, "is a JSON list, but not")
            for content in ("[1]", "[]", "[1, 2]", '[{"a": 1}]')
        ),
        *((content, "neither") for content in ("{}", '{"views": 3}')),
        ('{"views": []}', "'format' is None"),
    ],
)
def test_other_json(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match=rf"a\.json: .*{message}"):
        read_views(tmp_path / "a.json")


def test_a_scale_in_the_pose_is_taken_out(tmp_path: Path) -> None:
    path = transforms(tmp_path / "a.json", orbit(1))

    def scale(content: dict[str, Any]) -> None:
        matrix = np.array(content["frames"][0]["transform_matrix"])
        matrix[:3, :3] *= 2.5
        content["frames"][0]["transform_matrix"] = matrix.tolist()

    edit(path, scale)
    np.testing.assert_allclose(read_views(path).viewmats, orbit(1), atol=1e-12)


def test_fox() -> None:
    found = read_view_set(real("fox"))
    assert len(found.cameras) == 50
    assert [(n.code, n.count) for n in found.notes] == [("missing_photos", 17)]
    assert found.cameras.distortions.any()
    # the cameras look at one object: all axes pass near one point
    p, d = found.cameras.positions, found.cameras.forwards
    A = np.eye(3) - d[:, :, None] * d[:, None, :]
    centre = np.linalg.solve(A.sum(0), np.einsum("cij,cj->i", A, p))
    distance = np.linalg.norm(np.einsum("cij,cj->ci", A, centre - p), axis=1)
    assert np.median(distance) < 0.35 * np.median(np.linalg.norm(p - centre, axis=1))
    assert (np.einsum("ci,ci->c", centre - p, d) > 0).all()
