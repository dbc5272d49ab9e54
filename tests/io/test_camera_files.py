"""Views written for other programs: cameras.json, transforms.json and COLMAP text, read back."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError, OutputError
from g2ard.io import read_view_set, write_splats, write_views
from g2ard.io.detect import file_format
from g2ard.scene.cameras import Cameras
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball
from helpers.view_files import photo

NAMES = {"inria": "cameras.json", "nerfstudio": "transforms.json", "colmap": "project"}
SPLITS = ["test", "train", "train", "val", "train", "train"]


def six() -> Cameras:
    return around(6, (64, 48))


def bent(rows: int | slice, distortion: object) -> Cameras:
    """Return views with distortion in some rows, and a principal point beside the middle in row 1."""
    distortions, Ks = np.zeros((6, 5)), six().Ks.copy()
    distortions[rows] = distortion
    Ks[1, :2, 2] += (3, -2)
    return replace(six(), Ks=Ks, distortions=distortions)


def same(mine: Cameras, theirs: Cameras, *, lens: bool = True) -> None:
    assert mine.names == theirs.names
    np.testing.assert_allclose(mine.viewmats, theirs.viewmats, atol=1e-12)
    np.testing.assert_array_equal(mine.widths, theirs.widths)
    np.testing.assert_array_equal(mine.heights, theirs.heights)
    if lens:
        np.testing.assert_allclose(mine.Ks, theirs.Ks, atol=1e-9)
        np.testing.assert_allclose(mine.distortions, theirs.distortions, atol=1e-12)


@pytest.mark.parametrize("format", NAMES)
def test_views_come_back(tmp_path: Path, format: str) -> None:
    path = tmp_path / NAMES[format]
    write_views(path, six())
    assert file_format(path) == {"nerfstudio": "transforms"}.get(format, format)
    same(read_view_set(path).cameras, six())
    with pytest.raises(OutputError, match="exists"):
        write_views(path, six())
    write_views(path, six(), overwrite=True)
    with pytest.raises(InputError, match="there are no views"):
        write_views(tmp_path / f"no_{NAMES[format]}", six().take([]), format=format)  # type: ignore[arg-type]


@pytest.mark.parametrize("format", ["nerfstudio", "colmap"])
def test_lenses_come_back(tmp_path: Path, format: str) -> None:
    views = bent(slice(0, 3), [0.05, -0.02, 1e-3, 2e-3, 0])
    path = tmp_path / NAMES[format]
    write_views(path, views)
    same(read_view_set(path).cameras, views)


def test_what_a_format_cannot_hold_is_said(tmp_path: Path) -> None:
    views, weights = bent(2, 0.01), np.ones(6)
    told = "without 1 principal point beside the image's middle, lens distortion of 1 view, splits, sampling"
    with pytest.warns(UserWarning, match=told) as warned:
        write_views(tmp_path / "cameras.json", views, splits=SPLITS, weights=weights)
    assert warned[0].filename == __file__
    same(read_view_set(tmp_path / "cameras.json").cameras, views, lens=False)
    with pytest.warns(UserWarning, match="without k3 of the lens distortion of 1 view, splits$"):
        write_views(tmp_path / "project", views, splits=SPLITS)


def test_transforms_keep_splits_and_photos(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    names = tuple(f"{i}.png" for i in range(6))
    for name in names:
        photo(folder / name, (64, 48))
    views = replace(six(), names=names, image_paths=tuple(folder / name for name in names))
    write_views(tmp_path / "transforms.json", views, splits=SPLITS)
    found = read_view_set(tmp_path / "transforms.json")
    assert list(found.splits) == SPLITS
    assert [path and path.name for path in found.cameras.image_paths] == list(names)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["frames"][0]["file_path"] == "photos/0.png"
    assert (content["fl_x"], content["w"]) == (six().Ks[0, 0, 0], 64)


def test_names_and_formats_of_outputs(command_line: CommandLine, tmp_path: Path) -> None:
    write_splats(tmp_path / "ball.ply", checkered_ball(500))
    given = "poses", "ball.ply", "-k", "9", "-o"
    for name in ("a.json", "cameras.json", "transforms.json", "project"):
        succeeds(command_line, tmp_path, *given, name)
    succeeds(command_line, tmp_path, *given, "other.json", "--format", "inria")
    mine = read_view_set(tmp_path / "a.json").cameras
    for name in ("cameras.json", "project", "other.json", "transforms.json"):
        same(mine, read_view_set(tmp_path / name).cameras)
    line = refused(command_line, tmp_path, *given, "b.json", "--format", "colmap", status=1)
    assert "written as a folder" in line
    assert "as a folder for COLMAP" in refused(command_line, tmp_path, *given, "b.txt", status=1)
    select = "select", "ball.ply", "--views", "a.json", "-k", "3", "-o", "transforms_3.json"
    assert "sampling weights" in succeeds(command_line, tmp_path, *select).err
