"""Photos inside .e57 files as views: panoramas and pinhole images with their poses."""

import io
from pathlib import Path

import numpy as np
import pye57
import pytest
from PIL import Image
from pye57 import libe57

import g2ard
from g2ard.errors import InputError
from g2ard.io import read_cloud, read_views
from g2ard.io.photos import load_mask, load_photo
from g2ard.io.views import read_view_set
from helpers.commands import CommandLine, succeeds
from reference.rotations import rotations

POINTS = {f"cartesian{axis}": np.arange(9.0) + k for k, axis in enumerate("XYZ")}
POINTS |= {f"color{name}": np.arange(9) * 20 for name in ("Red", "Green", "Blue")}
SIZE = {"spherical": (160, 80), "pinhole": (60, 40)}
FOCAL, PIXEL, MIDDLE = 0.03, (0.0005, 0.0006), (31.0, 18.0)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "cache"))
    return tmp_path / "cache"


def pattern(d: np.ndarray) -> np.ndarray:
    """A smooth picture on the sphere of directions."""
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(2 * d + np.roll(d, 1, axis=-1))


def ways(kind: str) -> np.ndarray:
    """Directions of the pixels in the frame of a photo, as the format defines them."""
    width, height = SIZE[kind]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    if kind == "pinhole":
        return np.stack(
            [
                (u - MIDDLE[0]) * PIXEL[0] / FOCAL,
                -(v - MIDDLE[1]) * PIXEL[1] / FOCAL,
                -np.ones_like(u),
            ],
            -1,
        )
    around, up = 2 * np.pi * (0.5 - u / width), np.pi * (0.5 - v / height)
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1)


def blob(image: libe57.ImageFile, picture: np.ndarray, format: str = "PNG") -> libe57.BlobNode:
    data = io.BytesIO()
    Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(data, format, quality=97)
    node = libe57.BlobNode(image, len(data.getvalue()))
    return node, np.frombuffer(data.getvalue(), np.uint8)


def written(path: Path, *photos: dict) -> Path:
    """Write a scan with photos: `kind`, `quat`, `shift`, and what to leave out or add."""
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(POINTS)
        image = file.image_file
        for photo in photos:
            kind, bytes_of = photo["kind"], []
            node, shown = libe57.StructureNode(image), libe57.StructureNode(image)
            node.set("name", libe57.StringNode(image, photo.get("name", "Image")))
            if photo.get("posed", True):
                pose, turn, shift = (libe57.StructureNode(image) for _ in range(3))
                for axis, value in zip("wxyz", photo["quat"], strict=True):
                    turn.set(axis, libe57.FloatNode(image, float(value)))
                for axis, value in zip("xyz", photo["shift"], strict=True):
                    shift.set(axis, libe57.FloatNode(image, float(value)))
                for part, values in (("rotation", turn), ("translation", shift)):
                    if part != photo.get("without"):
                        pose.set(part, values)
                node.set("pose", pose)
            width, height = photo.get("size", SIZE.get(kind, (8, 8)))
            picture = np.zeros((height, width, 3))
            if kind in SIZE and "size" not in photo:
                picture = pattern(ways(kind) @ rotations(np.array([photo["quat"]]))[0].T)
            format = photo.get("format", "PNG")
            bytes_of.append(blob(image, picture, format))
            shown.set("pngImage" if format == "PNG" else "jpegImage", bytes_of[-1][0])
            if photo.get("mask"):
                bytes_of.append(
                    blob(
                        image,
                        np.repeat(np.arange(width) < width / 2, height).reshape(width, height).T,
                    )
                )
                shown.set("imageMask", bytes_of[-1][0])
            shown.set("imageWidth", libe57.IntegerNode(image, width))
            shown.set("imageHeight", libe57.IntegerNode(image, height))
            if kind == "pinhole":
                values = {
                    "focalLength": photo.get("focal", FOCAL),
                    "pixelWidth": PIXEL[0],
                    "pixelHeight": PIXEL[1],
                }
                values |= {"principalPointX": MIDDLE[0], "principalPointY": MIDDLE[1]}
                for name, value in values.items():
                    shown.set(name, libe57.FloatNode(image, value))
            node.set(f"{kind}Representation", shown)
            file.root["images2D"].append(node)
            for target, data in bytes_of:
                target.write(data, 0, len(data))
    return path


def posed(kind: str, seed: int, **more: object) -> dict:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    return {
        "kind": kind,
        "quat": quat / np.linalg.norm(quat),
        "shift": rng.normal(size=3) * 10,
        **more,
    }


@pytest.mark.parametrize("kinds", [["spherical"], ["pinhole"], ["pinhole", "spherical", "pinhole"]])
@pytest.mark.parametrize("format", ["PNG", "JPEG"])
def test_views_show_what_lies_in_their_directions(
    tmp_path: Path, kinds: list[str], format: str
) -> None:
    photos = [posed(kind, seed, format=format) for seed, kind in enumerate(kinds)]
    path = written(tmp_path / "a b.e57", *photos)
    views = read_views(path)
    assert len(views) == sum(6 if kind == "spherical" else 1 for kind in kinds)
    for i, view in enumerate(views):
        photo = photos[int(view.name[:4])]
        np.testing.assert_allclose(view.position, photo["shift"], atol=1e-9)
        v, u = np.mgrid[0 : view.height, 0 : view.width] + 0.5
        local = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.K).T
        expected = pattern(local @ view.viewmat[:3, :3])
        assert np.abs(load_photo(views, i)[0] - expected).mean() < (
            0.01 if format == "PNG" else 0.02
        )


@pytest.mark.parametrize("without", ["rotation", "translation"])
def test_missing_parts_of_a_pose_are_those_of_the_identity(tmp_path: Path, without: str) -> None:
    photo = posed("pinhole", 0)
    (view,) = read_views(written(tmp_path / "a.e57", photo | {"without": without}))
    whole = photo | ({"quat": [1, 0, 0, 0]} if without == "rotation" else {"shift": [0, 0, 0]})
    (expected,) = read_views(written(tmp_path / "b.e57", whole))
    np.testing.assert_allclose(view.viewmat, expected.viewmat, atol=1e-12)


def test_masks_and_the_cache(tmp_path: Path, cache: Path) -> None:
    path = written(tmp_path / "a.e57", posed("pinhole", 0, mask=True), posed("pinhole", 1))
    views = read_views(path)
    mask = load_mask(views, 0)
    assert mask is not None
    assert mask[:, :30].all()
    assert not mask[:, 30:].any()
    assert load_mask(views, 1) is None
    before = {file: file.stat().st_mtime_ns for file in cache.rglob("*.png")}
    assert len(before) == 3
    read_views(path)
    assert before == {file: file.stat().st_mtime_ns for file in cache.rglob("*.png")}


LEFT_OUT = {
    "visualReference": {"kind": "visualReference"},
    "cylindrical": {"kind": "cylindrical"},
    "pose": {"kind": "pinhole", "posed": False},
    "focal": {"kind": "pinhole", "focal": 0.0},
    "sphere": {"kind": "spherical", "size": (160, 60)},
}


@pytest.mark.parametrize("what", LEFT_OUT)
def test_photos_that_are_no_views_are_named(tmp_path: Path, what: str) -> None:
    bad = posed(**{"kind": "pinhole", "seed": 3} | {"name": "odd photo/1"} | LEFT_OUT[what])
    found = read_view_set(written(tmp_path / "a.e57", posed("pinhole", 0), bad))
    assert len(found.cameras) == 1
    (note,) = [note for note in found.notes if note.code == "left_out_photos"]
    assert "0001_odd_photo_1" in str(note)
    with pytest.raises(InputError, match=r"b\.e57: none of its 1 photo"):
        read_views(written(tmp_path / "b.e57", bad))


def test_a_scan_without_photos_and_notes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.e57: holds no photos"):
        read_views(written(tmp_path / "a.e57"))
    notes = read_cloud(
        written(tmp_path / "b.e57", posed("spherical", 0), posed("pinhole", 1))
    ).notes
    assert [(note.code, note.count) for note in notes] == [("photos", 2)]
    with pytest.raises(InputError, match="photos inside"):
        read_views(tmp_path / "b.e57", images=tmp_path)


def test_a_scan_and_its_panoramas_distil_from_one_command(
    tmp_path: Path, command_line: CommandLine
) -> None:
    written(tmp_path / "a.e57", *[posed("spherical", k) for k in range(3)])
    ask = ("--views", "a.e57", "--photos", "-n", 9, "--steps", 3, "--size", 40, "-o", "run")
    succeeds(command_line, tmp_path, "distill", "a.e57", *ask)
    assert len(g2ard.load(tmp_path / "run" / "scene.ply")) == 9


@pytest.mark.parametrize("home", ["file", "none"])
def test_a_home_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, home: str
) -> None:
    path = written(tmp_path / "a.e57", posed("pinhole", 0))
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "temporary"))
    (tmp_path / "home").write_bytes(b"")
    if home == "file":
        monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    else:
        monkeypatch.setattr(
            Path, "home", classmethod(lambda _: (_ for _ in ()).throw(RuntimeError))
        )
    (photo,) = read_views(path).image_paths
    assert photo is not None
    assert photo.is_relative_to(tmp_path / "temporary" / "g2ard")
