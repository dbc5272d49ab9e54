"""Cameras as trainers leave them: INRIA's cameras.json, nerfstudio's runs and exports, gsplat's runs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import find_views, kind, read_view_set
from g2ard.io.detect import file_format
from g2ard.io.trainer_yaml import read_settings
from helpers.faults import Fault, faulty
from helpers.trainer_files import (
    APPLIED,
    POSES,
    SCALE,
    A,
    T,
    data_of,
    export,
    inria,
    result_of,
    run_of,
    trained,
)
from helpers.view_files import colmap, edit, photo, transforms


def test_cameras_json(tmp_path: Path) -> None:
    path = inria(tmp_path / "cameras.json")
    for given in (path, tmp_path):
        assert (kind(given), file_format(given)) == ("views", "inria")
        found = read_view_set(given)
        assert found.cameras.names == ("000", "008", *(f"{i:03d}" for i in range(10) if i % 8))
        for name, view in zip(found.cameras.names, found.cameras.viewmats, strict=True):
            np.testing.assert_allclose(view, POSES[int(name)], atol=1e-12)
        assert found.cameras.Ks[3].tolist() == [[70, 0, 40], [0, 71, 30.5], [0, 0, 1]]
        assert (found.cameras.widths[0], found.cameras.heights[0]) == (80, 61)
        assert found.cameras.image_paths == (None,) * 10
        assert found.splits == ()
    # those INRIA's --eval held out
    assert read_view_set(path, split="test").cameras.names == ("000", "008")


def test_cameras_json_with_photos(tmp_path: Path) -> None:
    """Trainers write the size of the full photos, and may keep smaller ones."""
    path = inria(tmp_path / "model" / "cameras.json", width=160, height=120)
    for i in (1, 2, 3):
        photo(tmp_path / "photos" / f"{i:03d}.jpg", (80, 60))
    found = read_view_set(path, images=tmp_path / "photos")
    assert found.cameras.names == ("001", "002", "003")
    assert [p.name for p in found.cameras.image_paths if p] == ["001.jpg", "002.jpg", "003.jpg"]
    assert [note.code for note in found.notes] == ["other_size", "missing_photos"]
    assert (found.cameras.widths[0], found.cameras.heights[0]) == (80, 60)
    assert found.cameras.Ks[0].tolist() == [[35, 0, 40], [0, 35.5, 30], [0, 0, 1]]


def test_cameras_json_names_that_repeat_get_their_id(tmp_path: Path) -> None:
    path = inria(tmp_path / "cameras.json", POSES[:3])
    content = json.loads(path.read_text())
    content[0]["img_name"] = content[2]["img_name"] = "r_0"
    path.write_text(json.dumps(content))
    found = read_view_set(path)
    assert found.cameras.names == ("r_0_0", "001", "r_0_2")
    assert [(note.code, note.count) for note in found.notes] == [("repeated_names", 2)]


T[:3] = [[0.36, 0.48, -0.8, 0.5], [-0.8, 0.6, 0.0, -1.0], [0.48, 0.64, 0.6, 2.0]]


def test_a_run_moves_its_data_s_cameras(tmp_path: Path) -> None:
    data_of(tmp_path)
    run = run_of(tmp_path)
    for given in (run, run / "dataparser_transforms.json", run / "config.yml"):
        assert file_format(given) == "nerfstudio"
        found = read_view_set(given)
        assert found.cameras.names == tuple(f"{i:03d}.png" for i in range(10))
        for view, pose in zip(found.cameras.viewmats, POSES, strict=True):
            np.testing.assert_allclose(view, trained(pose), atol=1e-9)
        assert found.cameras.Ks[0].tolist() == [[10, 0, 4.5], [0, 11, 2.5], [0, 0, 1]]
    # of the saved world: falls on the same pixel after the move
    point = np.array([0.3, -0.2, 0.1, 1.0])
    moved = T @ point
    moved[:3] *= SCALE
    before, after = POSES[3] @ point, found.cameras.viewmats[3] @ moved
    np.testing.assert_allclose(after[:2] / after[2], before[:2] / before[2], atol=1e-9)


@pytest.mark.parametrize(
    ("mode", "test"),
    [("fraction", {8}), ("interval", {0, 4, 8}), ("all", set()), ("filename", set(range(10)))],
)
def test_a_run_s_own_split(tmp_path: Path, mode: str, test: set[int]) -> None:
    """fraction: 9 of 10 are ⌊linspace(0, 9, 9)⌋ = 0 … 7, 9."""
    data_of(tmp_path)
    found = read_view_set(run_of(tmp_path, mode=mode))
    assert found.splits == (
        tuple("test" if i in test else "train" for i in range(10)) if test else ()
    )


def test_a_run_s_data_state_their_split(tmp_path: Path) -> None:
    names = [f"images/{i:03d}.png" for i in range(10)]
    path = data_of(
        tmp_path,
        train_filenames=names[3:],
        val_filenames=["./images/000.png"],
        test_filenames=names[1:3],
    )
    stated = ("val", "test", "test", *["train"] * 7)
    assert read_view_set(run_of(tmp_path)).splits == stated
    assert read_view_set(path).splits == stated
    edit(path, lambda c: c.update(test_filenames=names[1:4]))
    with faulty(path, "'images/003.png' is in both train_filenames and test"):
        read_view_set(path)


def test_a_run_with_an_odd_split(tmp_path: Path) -> None:
    data_of(tmp_path)
    run = run_of(tmp_path, mode="interval")
    (run / "config.yml").write_text(
        (run / "config.yml").read_text().replace("interval: 4", "interval: 0")
    )
    with pytest.raises(InputError, match=r"invalid split in the run's config.yml"):
        read_view_set(run)


def test_a_run_on_colmap(tmp_path: Path) -> None:
    colmap(tmp_path / "data" / "poster" / "colmap", POSES, text=False)
    for i in range(10):
        photo(tmp_path / "data" / "poster" / "images" / f"photo {i}.png")
    found = read_view_set(run_of(tmp_path, parser="Colmap", mode="interval"))
    assert found.cameras.image_paths[2] is not None
    for view, pose in zip(found.cameras.viewmats, POSES, strict=True):
        np.testing.assert_allclose(view, trained(pose), atol=1e-9)
    assert found.splits == ()  # the order COLMAP's images were counted in differs between versions


def test_a_run_with_its_data_elsewhere_and_optimised_poses(tmp_path: Path) -> None:
    data_of(tmp_path / "far")
    parts = "\n".join(f"- {part}" for part in (tmp_path / "far" / "data" / "poster").parts)
    away = f"!!python/object/apply:pathlib.PosixPath\n{parts}"
    for i, (data, manager) in enumerate([(away, "null"), ("null", away.replace("\n", "\n    "))]):
        run = run_of(tmp_path / str(i), data=data, manager=manager, optimizer="SO3xR3")
        found = read_view_set(run)
        np.testing.assert_allclose(found.cameras.viewmats[0], trained(POSES[0]), atol=1e-9)
        assert [note.code for note in found.notes if note.code != "no_photos"] == [
            "optimised_poses"
        ]


@pytest.mark.parametrize(
    ("kind_", "parts"),
    [
        ("Windows", ["'C:\\\\'", "Users", "me", "data", "poster"]),
        ("Posix", ["/", "home", "me", "data", "poster"]),
    ],
)
def test_a_run_that_was_copied_with_its_data(tmp_path: Path, kind_: str, parts: list[str]) -> None:
    data_of(tmp_path)
    lines = "\n".join(f"- {part}" for part in parts)
    run = run_of(tmp_path, data=f"!!python/object/apply:pathlib.{kind_}Path\n{lines}")
    np.testing.assert_allclose(read_view_set(run).cameras.viewmats[0], trained(POSES[0]), atol=1e-9)
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"does not exist; give its transforms\.json"):
        read_view_set(run)


@pytest.mark.parametrize(
    "root", ["C:\\nerf\\data\\garden", "/home/me/data/garden", "D:/data/garden"]
)
def test_a_result_folder_that_was_copied_with_its_data(tmp_path: Path, root: str) -> None:
    colmap(tmp_path / "data" / "garden", POSES, text=True)
    path = result_of(tmp_path, data_dir=root)
    np.testing.assert_allclose(read_view_set(path).cameras.viewmats, POSES, atol=1e-9)


def test_a_run_without_config_takes_the_transforms_beside(tmp_path: Path) -> None:
    path = data_of(tmp_path)
    beside = path.parent / "dataparser_transforms.json"
    beside.write_text(json.dumps({"transform": (T @ A)[:3].tolist(), "scale": SCALE * APPLIED}))
    np.testing.assert_allclose(
        read_view_set(beside).cameras.viewmats[1], trained(POSES[1]), atol=1e-9
    )
    path.unlink()
    with pytest.raises(InputError, match=r"neither config\.yml nor transforms\.json"):
        read_view_set(beside)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"parser": "Phototourism"}, "unsupported data parser 'PhototourismDataParser'"),
        ({"data": "null", "manager": "null"}, ("data", None)),
        ({"data": "gone"}, "data gone does not exist"),
    ],
)
def test_bad_runs(tmp_path: Path, change: dict[str, Any], fault: Fault) -> None:
    data_of(tmp_path)
    run = run_of(tmp_path, **change)
    with faulty(run / "config.yml", fault):
        read_view_set(run)


def test_a_run_that_does_not_tell_its_world_is_refused(tmp_path: Path) -> None:
    path = data_of(tmp_path, applied_transform=None)
    run = run_of(tmp_path)
    read_view_set(run)
    (path.parent / "colmap" / "sparse" / "0").mkdir(parents=True)
    with faulty(path, ("applied_transform", None)):
        read_view_set(run)


def test_exported_cameras_take_intrinsics_from_their_data(tmp_path: Path) -> None:
    data = data_of(tmp_path).parent
    for i in range(10):
        photo(data / "images_2" / f"{i:03d}.png", (4, 3))
    out = tmp_path / "exports" / "cameras"
    export(out, Path("data/poster/images_2"), "transforms_train.json", range(3, 10))
    assert read_view_set(out).splits == ("train",) * 7
    export(out, Path("data/poster/images_2"), "transforms_eval.json", range(3))
    assert file_format(out) == file_format(out / "transforms_eval.json") == "nerfstudio_export"
    found = read_view_set(out)
    assert found.splits == ("train",) * 7 + ("test",) * 3
    for view, name in zip(found.cameras.viewmats, found.cameras.names, strict=True):
        np.testing.assert_allclose(view, trained(POSES[int(name[:3])]), atol=1e-9)
    # of 8×6 photos, halved
    assert found.cameras.Ks[0].tolist() == [[5, 0, 2.25], [0, 5.5, 1.25], [0, 0, 1]]
    assert (found.cameras.widths[0], found.cameras.heights[0]) == (4, 3)
    assert read_view_set(out / "transforms_eval.json").cameras.names == (
        "000.png",
        "001.png",
        "002.png",
    )


def test_exported_cameras_without_data_are_refused(tmp_path: Path) -> None:
    out = export(tmp_path, Path("/nowhere/images"), "transforms_train.json", range(2))
    with faulty(out, (None, 0)):
        read_view_set(out)
    content = json.loads(out.read_text())
    content[1].pop("transform")
    out.write_text(json.dumps(content))
    data_of(tmp_path)
    with faulty(out, ("transform", 1)):
        read_view_set(tmp_path)


def test_a_result_folder_follows_its_data(tmp_path: Path) -> None:
    colmap(tmp_path / "data" / "garden", POSES, text=True)
    for i in range(10):
        photo(tmp_path / "data" / "garden" / "images_2" / f"photo {i}.png", (4, 3))
    path = result_of(tmp_path)
    for given in (path, path.parent):
        assert file_format(given) == "gsplat_run"
        found = read_view_set(given)
        np.testing.assert_allclose(found.cameras.viewmats, POSES, atol=1e-9)
        assert found.splits == tuple("train" if i % 4 else "test" for i in range(10))
        assert found.cameras.Ks[0].tolist() == [[250, 0, 2], [0, 255, 1.5], [0, 0, 1]]
    result_of(tmp_path, pose_opt="true")
    assert "optimised_poses" in [note.code for note in read_view_set(path).notes]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"normalize": "true"}, r"cfg\.yml: was trained in a normalised world"),
        ({"data_dir": "data/gone"}, r"cfg\.yml: data_dir data/gone does not exist"),
        ({"data_dir": "data"}, r"data: has no COLMAP model"),
    ],
)
def test_bad_results(tmp_path: Path, settings: dict[str, str], message: str) -> None:
    (tmp_path / "data").mkdir()
    with pytest.raises(InputError, match=message):
        read_view_set(result_of(tmp_path, **settings))


def test_settings(tmp_path: Path) -> None:
    lines = [
        "a: 'x y'",
        "b: a long",
        "  value",
        "c: null",
        "d:",
        "  e: 1",
        "f: !!python/tuple",
        "- 1",
        "g: true",
    ]
    (tmp_path / "a.yml").write_text("\n".join(lines))
    found = read_settings(tmp_path / "a.yml")
    assert [found.word(key) for key in "abcfgz"] == [
        "x y",
        "a long value",
        None,
        None,
        "true",
        None,
    ]
    assert found.path("a") == Path("x y")
    block = found.block("d")
    assert (block[1].word("e"), block[1].word("g")) == ("1", None)
    with pytest.raises(InputError, match="No such file"):
        read_settings(tmp_path / "absent.yml")


# found beside the scene


def test_cameras_are_found_beside_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tmp_path / "model"
    scene = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    scene.parent.mkdir(parents=True)
    assert find_views(scene) is None
    cameras = inria(model / "cameras.json")
    assert find_views(scene) == cameras
    assert find_views(model / "other" / "iteration_30000" / "point_cloud.ply") is None
    assert find_views(model / "small.ply") == cameras
    own = inria(scene.parent / "cameras.json")
    assert find_views(scene) == own
    own.write_text("[]")
    assert find_views(scene) == cameras
    monkeypatch.chdir(scene.parent)
    assert find_views("point_cloud.ply") == Path("../../cameras.json")


def test_other_trainers_cameras_are_found(tmp_path: Path) -> None:
    run = run_of(tmp_path)
    assert find_views(run / "splat.ply") == run / "dataparser_transforms.json"
    out = export(tmp_path / "exports", Path("images"), "transforms_eval.json", range(2)).parent
    assert find_views(out / "splat.ply") == out
    path = result_of(tmp_path)
    assert find_views(path.parent / "ply" / "point_cloud_29999.ply") == path
    transforms(tmp_path / "transforms.json", POSES)
    colmap(tmp_path, POSES, text=True)
    assert find_views(tmp_path / "scene.ply") is None
