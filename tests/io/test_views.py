"""g2ard's own file of views."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2ard.errors import InputError, OutputError
from g2ard.io import read_view_set, read_views, write_views
from helpers.view_files import edit, views


@settings(max_examples=20, deadline=None)
@given(count=st.integers(1, 12), seed=st.integers(0, 1000))
def test_own_views_round_trip(
    tmp_path_factory: pytest.TempPathFactory, count: int, seed: int
) -> None:
    path = tmp_path_factory.mktemp("views") / "a.json"
    truth = views(count, seed)
    write_views(path, truth)
    found = read_views(path)
    for name in ("viewmats", "Ks", "widths", "heights", "distortions"):
        np.testing.assert_array_equal(getattr(found, name), getattr(truth, name))
    assert found.names == truth.names
    assert found.image_paths == (None,) * count


def test_poses_become_rigid(tmp_path: Path) -> None:
    """Poses of other programs may have rounding errors or a uniform scale, and three or four rows."""
    truth = views(3, 0)
    write_views(tmp_path / "a.json", truth)
    content = json.loads((tmp_path / "a.json").read_text())
    for view, change in zip(content["views"], (1 + 1e-7, 1, 1), strict=True):
        pose = np.array(view["camera_from_world"])
        pose[:3, :3] *= change
        view["camera_from_world"] = pose.tolist()
    content["views"][2]["camera_from_world"].pop()
    (tmp_path / "a.json").write_text(json.dumps(content))
    found = read_views(tmp_path / "a.json").viewmats
    np.testing.assert_allclose(found, truth.viewmats, atol=1e-6)
    rotations = found[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12
    )
    assert found[:, 3].tolist() == 3 * [[0, 0, 0, 1]]


def test_own_views_name_photos_splits_and_weights(tmp_path: Path) -> None:
    truth = views(4, photos=tmp_path / "photos")
    (tmp_path / "deep").mkdir()
    path = tmp_path / "deep" / "a.json"
    write_views(path, truth, splits=["train", "test", "train", None], weights=[1, 0.5, 2, 0])
    assert json.loads(path.read_text())["views"][1]["image"] == "../photos/1.png"
    found = read_view_set(path)
    assert [p.resolve() for p in found.cameras.image_paths if p] == list(truth.image_paths)
    assert found.splits == ("train", "test", "train", None)
    assert found.weights.tolist() == [1, 0.5, 2, 0]
    train = read_view_set(path, split="train")
    assert train.cameras.names == ("v0", "v2")
    assert train.weights.tolist() == [1, 2]
    (tmp_path / "photos" / "2.png").unlink()
    assert [(n.code, n.count) for n in read_view_set(path).notes] == [("missing_photos", 1)]


def test_a_whole_width_may_be_a_float(tmp_path: Path) -> None:
    write_views(tmp_path / "a.json", views(2))
    edit(tmp_path / "a.json", lambda c: c["views"][1].update(width=80.0))
    assert read_views(tmp_path / "a.json").widths.tolist() == [8, 80]


def test_own_views_reject_mismatched_values(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="do not match"):
        write_views(tmp_path / "a.json", views(2), weights=[1])
    with pytest.raises(OutputError, match=r"written as \.json"):
        write_views(tmp_path / "a.txt", views(2))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.json", "cameras.json", "transforms.json", "model"])
def test_no_two_views_have_one_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="names: 'v1' is given twice"):
        write_views(tmp_path / name, replace(views(3), names=("v0", "v1", "v1")))
    assert list(tmp_path.iterdir()) == []


def test_no_views_in_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a supported folder"):
        read_views(tmp_path)
