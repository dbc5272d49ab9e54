"""Views from COLMAP, transforms.json and our own file; splits."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from realdata import real

from g2ard.cameras import Cameras, look_at
from g2ard.errors import InputError, OutputError
from g2ard.io import kind, read_points, read_view_set, read_views, write_views
from g2ard.splits import split_mask, split_names


def photo(path: Path, size: tuple[int, int] = (8, 6)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path)
    return path


def orbit(count: int) -> list[np.ndarray]:
    angles = np.linspace(0, 5, count)
    return [look_at([3 * math.cos(a), 3 * math.sin(a), 1 + 0.1 * a], [0, 0, 0]) for a in angles]


def quaternion(R: np.ndarray) -> np.ndarray:
    """wxyz of a rotation, by the eigenvector of its symmetric 4×4 form: independent of the reader."""
    K = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0, 0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [0, 0, 0, R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    K = K + np.triu(K, 1).T
    return np.linalg.eigh(K)[1][:, -1]


# ── COLMAP ───────────────────────────────────────────────────────────────────────────────────────────

MODELS: list[tuple[int, str, list[float], list[float], list[float]]] = [
    (0, "SIMPLE_PINHOLE", [500, 4, 3], [500, 500, 4, 3], [0, 0, 0, 0]),
    (1, "PINHOLE", [500, 510, 4, 3], [500, 510, 4, 3], [0, 0, 0, 0]),
    (2, "SIMPLE_RADIAL", [500, 4, 3, 0.1], [500, 500, 4, 3], [0.1, 0, 0, 0]),
    (3, "RADIAL", [500, 4, 3, 0.1, 0.2], [500, 500, 4, 3], [0.1, 0.2, 0, 0]),
    (4, "OPENCV", [500, 510, 4, 3, 0.1, 0.2, 0.3, 0.4], [500, 510, 4, 3], [0.1, 0.2, 0.3, 0.4]),
]


def colmap(folder: Path, viewmats: list[np.ndarray], text: bool, model: int = 1) -> Path:
    """A model whose images come in reverse order of their names, with 2D points to step over."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    number, name, parameters, _, _ = MODELS[model]
    images = list(enumerate(viewmats))[::-1]
    points = [((1.5, 2, 3), (255, 128, 0), 2), ((-4, 5, 6), (0, 1, 2), 0)]
    if text:
        values = " ".join(map(str, parameters))
        (sparse / "cameras.txt").write_text(f"# a comment\n7 {name} 8 6 {values}\n")
        lines = ["# two lines an image"]
        for i, view in images:
            pose = " ".join(repr(float(v)) for v in (*quaternion(view[:3, :3]), *view[:3, 3]))
            lines += [f"{i + 1} {pose} 7 photo {i}.png", "1 2 -1 3 4 5" if i % 2 else ""]
        (sparse / "images.txt").write_text("\n".join(lines) + "\n")
        rows = [
            f"{i} {' '.join(map(str, p))} {' '.join(map(str, c))} 0.5" + " 1 2" * track
            for i, (p, c, track) in enumerate(points)
        ]
        (sparse / "points3D.txt").write_text("# points\n" + "\n".join(rows) + "\n")
        return folder
    head = struct.pack("<QiiQQ", 1, 7, number, 8, 6)
    (sparse / "cameras.bin").write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))
    data = struct.pack("<Q", len(images))
    for i, view in images:
        data += struct.pack("<I7dI", i + 1, *quaternion(view[:3, :3]), *view[:3, 3], 7)
        data += f"photo {i}.png".encode() + b"\0" + struct.pack("<Q", i) + bytes(24 * i)
    (sparse / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for i, (p, c, track) in enumerate(points):
        data += struct.pack("<Q3d3BdQ", i, *p, *c, 0.5, track) + bytes(8 * track)
    (sparse / "points3D.bin").write_bytes(data)
    for extra in ("rigs.bin", "frames.bin"):
        (sparse / extra).write_bytes(b"not read")
    return folder


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", range(len(MODELS)))
def test_colmap(tmp_path: Path, text: bool, model: int) -> None:
    truth = orbit(5)
    folder = colmap(tmp_path / "project", truth, text, model)
    for i in range(5):
        photo(folder / "images" / f"photo {i}.png")
    for path in (folder, folder / "sparse" / "0"):
        cameras = read_views(path)
        assert cameras.names == tuple(f"photo {i}.png" for i in range(5))
        np.testing.assert_allclose(cameras.viewmats, truth, atol=1e-12)
        fx, fy, cx, cy = MODELS[model][3]
        np.testing.assert_array_equal(cameras.Ks[0], [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        np.testing.assert_array_equal(cameras.distortions[0], [*MODELS[model][4], 0])
        assert (cameras.widths == 8).all()
        assert (cameras.heights == 6).all()
        assert cameras.image_paths[2] == folder / "images" / "photo 2.png"
    assert kind(folder) == "views"


@pytest.mark.parametrize("text", [False, True])
def test_colmap_points(tmp_path: Path, text: bool) -> None:
    folder = colmap(tmp_path / "project", orbit(2), text)
    file = folder / "sparse" / "0" / f"points3D.{'txt' if text else 'bin'}"
    assert kind(file) == "points"
    for path in (folder, file):
        points = read_points(path)
        np.testing.assert_array_equal(points.positions, [[1.5, 2, 3], [-4, 5, 6]])
        np.testing.assert_allclose(points.colors * 255, [[255, 128, 0], [0, 1, 2]], atol=1e-4)


def test_colmap_photos_elsewhere(tmp_path: Path) -> None:
    folder = colmap(tmp_path / "project", orbit(2), text=False)
    for i in range(2):
        photo(tmp_path / "elsewhere" / f"photo {i}.png")
    cameras = read_views(folder, images=tmp_path / "elsewhere")
    assert cameras.image_paths[1] == tmp_path / "elsewhere" / "photo 1.png"
    assert read_views(folder).image_paths == (None, None)
    with pytest.raises(InputError, match="no such folder of photos"):
        read_views(folder, images=tmp_path / "gone")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("keep", [4, 30, -10])
def test_truncated_colmap(tmp_path: Path, name: str, keep: int) -> None:
    folder = colmap(tmp_path / "project", orbit(3), text=False)
    path = folder / "sparse" / "0" / name
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=rf"{name}: truncated"):
        (read_points if "points" in name else read_views)(folder)


def test_fisheye_is_refused(tmp_path: Path) -> None:
    folder = colmap(tmp_path / "project", orbit(2), text=True)
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text("7 OPENCV_FISHEYE 8 6 500 500 4 3 0 0 0 0\n")
    with pytest.raises(InputError, match="OPENCV_FISHEYE is not supported"):
        read_views(folder)
    cameras.write_text("9 PINHOLE 8 6 500 500 4 3\n")
    with pytest.raises(InputError, match="names camera 7, which is absent"):
        read_views(folder)
    cameras.write_text("7 PINHOLE 8 six 500 500 4 3\n")
    with pytest.raises(InputError, match=r"cameras\.txt: malformed"):
        read_views(folder)


def test_caliterra() -> None:
    folder = real("caliterra")
    cameras = read_views(folder)
    assert len(cameras) == 75
    assert all(p is not None and p.is_file() for p in cameras.image_paths)
    points = read_points(folder)
    assert len(points) == 41_590
    split = json.loads((folder / "split.json").read_text())
    for which in ("train", "test"):
        assert sorted(read_views(folder, split=which).names) == sorted(split[which])
    # every point in front of some camera lands in its image: axes and intrinsics agree
    X = np.c_[points.positions, np.ones(len(points))] @ cameras.viewmats[30].T
    seen = X[:, 2] > 0
    uv = (X[seen, :3] @ cameras.Ks[30].T) / X[seen, 2:3]
    inside = (uv[:, 0] > 0) & (uv[:, 0] < 1000) & (uv[:, 1] > 0) & (uv[:, 1] < 751)
    assert inside.sum() > 1000


# ── transforms.json ──────────────────────────────────────────────────────────────────────────────────


def transforms(path: Path, viewmats: list[np.ndarray], **extra: Any) -> Path:
    """As instant-ngp writes it: camera to world, y up and looking along −z."""
    frames = []
    for i, view in enumerate(viewmats):
        world = np.linalg.inv(view)
        world[:3, 1:3] *= -1
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": world.tolist()})
    content = {"fl_x": 10.0, "fl_y": 11.0, "cx": 4.5, "cy": 2.5, "w": 8.0, "h": 6.0, "frames": frames} | extra
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    return path


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


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


BAD: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda c: c.update(frames=[]), "no views found"),
    (lambda c: c["frames"][1].pop("file_path"), "frame 1: lacks 'file_path'"),
    (lambda c: c["frames"][1].update(transform_matrix=[[1, 2], [3, 4]]), "frame 1: its pose is not a finite"),
    (lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(0, float("nan")), "frame 0: its pose"),
    (lambda c: c["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "not a rotation"),
    (lambda c: c["frames"][0].update(transform_matrix=np.diag([1, 2, 3, 1]).tolist()), "not a rotation"),
    (lambda c: c["frames"][0].update(transform_matrix="x"), "frame 0: malformed"),
    (lambda c: c.pop("fl_x"), "no focal length"),
    (lambda c: c.pop("w"), "tell the size"),
    (lambda c: c.update(w=8.5), "frame 0: 'w' is 8.5, not a whole number"),
    (lambda c: c["frames"][1].update(h=6.25), "frame 1: 'h' is 6.25, not a whole number"),
    (lambda c: c.update(fl_x=-3), "focal length must be positive"),
    (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE"),
    (lambda c: c.update(is_fisheye=True), "fisheye"),
    (lambda c: c["frames"][1].update(file_path="images/000.png"), "2 views are named '000.png'"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_bad_transforms(tmp_path: Path, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    path = transforms(tmp_path / "a.json", orbit(2), fl_y=None)
    edit(path, change)
    with pytest.raises(InputError, match=message) as caught:
        read_views(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not JSON"),
        ("[1]", "expected a JSON object"),
        ("{}", "neither"),
        ('{"views": []}', "not g2ard's"),
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


# ── g2ard's own ──────────────────────────────────────────────────────────────────────────────────────


def views(count: int, seed: int = 0, photos: Path | None = None) -> Cameras:
    rng = np.random.default_rng(seed)
    Ks = [[[rng.uniform(1, 999), 0, rng.uniform(0, 9)], [0, rng.uniform(1, 999), 3.3], [0, 0, 1]]] * count
    return Cameras.from_lists(
        orbit(count),
        Ks,
        [(8, 6)] * count,
        [f"v{i}" for i in range(count)],
        [photo(photos / f"{i}.png") for i in range(count)] if photos else (),
        rng.normal(size=(count, 5)) if seed % 2 else (),
    )


@settings(max_examples=20, deadline=None)
@given(count=st.integers(1, 12), seed=st.integers(0, 1000))
def test_own_views_round_trip(tmp_path_factory: pytest.TempPathFactory, count: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("views") / "a.json"
    truth = views(count, seed)
    write_views(path, truth)
    found = read_views(path)
    for name in ("viewmats", "Ks", "widths", "heights", "distortions"):
        np.testing.assert_array_equal(getattr(found, name), getattr(truth, name))
    assert found.names == truth.names
    assert found.image_paths == (None,) * count


def test_own_views_name_photos_splits_and_weights(tmp_path: Path) -> None:
    truth = views(4, photos=tmp_path / "photos")
    (tmp_path / "deep").mkdir()
    path = tmp_path / "deep" / "a.json"
    write_views(path, truth, splits=["train", "test", "train", None], weights=[1, 0.5, 2, 0])
    assert json.loads(path.read_text())["views"][1]["image"] == "../photos/1.png"
    found = read_view_set(path)
    assert [p.resolve() for p in found.cameras.image_paths if p] == list(truth.image_paths)
    assert found.splits == ("train", "test", "train", None)
    assert found.weights is not None
    assert found.weights.tolist() == [1, 0.5, 2, 0]
    train = read_view_set(path, split="train")
    assert train.cameras.names == ("v0", "v2")
    assert train.weights is not None
    assert train.weights.tolist() == [1, 2]
    (tmp_path / "photos" / "2.png").unlink()
    assert [(n.code, n.count) for n in read_view_set(path).notes] == [("missing_photos", 1)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(version=2), "version 2"),
        (lambda c: c["views"][0].pop("K"), "view 0: lacks 'K'"),
        (lambda c: c["views"][1].update(K=[1, 2]), "view 1: malformed"),
        (lambda c: c["views"][1].update(weight=-1), "view 1: weight -1"),
        (lambda c: c["views"][1].update(width=80.5), r"view 1: 'width' is 80\.5, not a whole number"),
        (lambda c: c["views"][0].update(height=math.inf), "view 0: 'height' is inf, not a whole number"),
        (lambda c: c.update(views=[]), "no views found"),
        (lambda c: c["views"][0].update(camera_from_world=np.zeros((4, 4)).tolist()), "not a rotation"),
    ],
)
def test_bad_own_views(tmp_path: Path, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    write_views(tmp_path / "a.json", views(2))
    edit(tmp_path / "a.json", change)
    with pytest.raises(InputError, match=message):
        read_views(tmp_path / "a.json")


def test_a_whole_width_may_be_a_float(tmp_path: Path) -> None:
    write_views(tmp_path / "a.json", views(2))
    edit(tmp_path / "a.json", lambda c: c["views"][1].update(width=80.0))
    assert read_views(tmp_path / "a.json").widths.tolist() == [8, 80]


def test_own_views_refuse_what_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="do not fit"):
        write_views(tmp_path / "a.json", views(2), weights=[1])
    with pytest.raises(OutputError, match=r"written as \.json"):
        write_views(tmp_path / "a.txt", views(2))
    assert list(tmp_path.iterdir()) == []


def test_no_views_in_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing known in this folder"):
        read_views(tmp_path)


# ── splits ───────────────────────────────────────────────────────────────────────────────────────────


def test_every_eighth_sorted_name_is_test() -> None:
    names = [f"{i:02d}" for i in range(20)][::-1]
    assert split_names("x", names, "test") == ["16", "08", "00"]
    assert set(split_names("x", names, "train")) == set(names) - {"16", "08", "00"}
    assert split_mask("x", names, "all").all()


def test_split_file_wins(tmp_path: Path) -> None:
    split = {"train": ["images/a.jpg", "b.jpg"], "test": ["c.png"], "ood": ["d"]}
    (tmp_path / "split.json").write_text(json.dumps(split))
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert split_names(tmp_path, names, "test") == ["c.jpg"]
    assert split_names(tmp_path / "transforms.json", names, "ood") == ["d.jpg"]
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    assert split_names(sparse, names, "train") == ["a.jpg", "b.jpg"]
    assert split_names(tmp_path, ["left/b.jpg", "b.jpg"], "train") == ["b.jpg"]  # stems alone would confuse
    with pytest.raises(InputError, match=r"no split 'val' \(there are ood, test, train\)"):
        split_names(tmp_path, names, "val")
    with pytest.raises(InputError, match="none of the 1 views is in split 'test'"):
        split_names(tmp_path, ["b.jpg"], "test")


@pytest.mark.parametrize("content", ['{"train": [1]}', "{}", "[]"])
def test_bad_split_file(tmp_path: Path, content: str) -> None:
    (tmp_path / "split.json").write_text(content)
    with pytest.raises(InputError, match=r"split\.json"):
        split_names(tmp_path, ["a"], "train")
