"""COLMAP's models as views and as points."""

import struct
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError, damaged
from g2ard.io import kind, read_points, read_views
from g2ard.io.colmap import _MODELS, _PARAMETERS
from g2ard.scene.lenses import PhotoLens, photo_of
from helpers.faults import Fault, check_fault, faulty
from helpers.view_files import MODELS, colmap, orbit, photo, quaternion


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


@pytest.mark.parametrize(
    ("name", "keep", "fault"),
    [
        ("cameras.bin", 7, ("COUNT", 0)),
        ("cameras.bin", 8 + 11, ("WIDTH", 0)),
        ("cameras.bin", 8 + 24 + 3 * 8, ("PARAMS[3]", 0)),
        ("images.bin", 8 + 4 + 4 * 8 + 7, ("TX", 0)),
        ("images.bin", 8 + 64 + 3, ("NAME", 0)),
        ("images.bin", 8 + 64 + 12 + 8 + 47, ("POINTS2D", 0)),
        ("points3D.bin", 109, ("B", 1)),
    ],
)
def test_a_cut_column_is_named(tmp_path: Path, name: str, keep: int, fault: Fault) -> None:
    folder = colmap(tmp_path / "project", orbit(3), text=False)
    path = folder / "sparse" / "0" / name
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError) as caught:
        (read_points if "points" in name else read_views)(folder)
    check_fault(caught.value, path, fault)
    assert caught.value.hint == damaged("").hint


@pytest.mark.parametrize(
    ("name", "at", "fault"),
    [("cameras.bin", 8 + 24 + 8, ("PARAMS[1]", 0)), ("images.bin", 8 + 4 + 5 * 8, ("TY", 0))],
)
def test_a_binary_value_that_is_not_finite_is_named(
    tmp_path: Path, name: str, at: int, fault: Fault
) -> None:
    folder = colmap(tmp_path / "project", orbit(1), text=False)
    path = folder / "sparse" / "0" / name
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, at, float("nan"))
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"is nan$") as caught:
        read_views(folder)
    check_fault(caught.value, path, fault)


@pytest.mark.parametrize("number", [-1, 18, 99])
def test_a_model_of_unknown_number_is_rejected(tmp_path: Path, number: int) -> None:
    folder = colmap(tmp_path / "project", orbit(1), text=False)
    path = folder / "sparse" / "0" / "cameras.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<i", data, 8 + 4, number)
    path.write_bytes(data)
    with faulty(path, f"number {number}"):
        read_views(folder)


def test_other_and_absent_cameras_are_rejected(tmp_path: Path) -> None:
    folder = colmap(tmp_path / "project", orbit(2), text=True)
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text("7 EUCM 8 6 500 500 4 3 0 0\n")
    with pytest.raises(InputError, match="unsupported camera model EUCM"):
        read_views(folder)
    cameras.write_text("9 PINHOLE 8 6 500 500 4 3\n")
    with pytest.raises(InputError, match="has the unknown camera 7"):
        read_views(folder)


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("cameras", "7 PINHOLE 8 six 500 500 4 3\n", ("HEIGHT", 0)),
        ("cameras", "7 PINHOLE 8 1_0 500 500 4 3\n", ("HEIGHT", 0)),
        ("cameras", "7 PINHOLE 8 ٣ 500 500 4 3\n", ("HEIGHT", 0)),
        ("cameras", "7 PINHOLE 8 6 500 x 4 3\n", ("PARAMS[1]", 0)),
        ("cameras", "7 PINHOLE 8\n", ("HEIGHT", 0)),
        ("images", "1 1 0 0 0 0 0 4 7 a.png\n\n2 1 0 0 0 0 deep 4 7 b.png\n\n", ("TY", 1)),
        ("images", "1 1 0 0 0 0 0 inf 7 a.png\n\n", ("TZ", 0)),
        ("images", "1 1 0 0 0 0 0 4 7\n\n", ("NAME", 0)),
    ],
)
def test_a_bad_column_of_a_text_table_is_named(
    tmp_path: Path, name: str, text: str, fault: Fault
) -> None:
    folder = colmap(tmp_path / "project", orbit(2), text=True)
    path = folder / "sparse" / "0" / f"{name}.txt"
    path.write_text(text, encoding="utf-8")
    with faulty(path, fault):
        read_views(folder)


@pytest.mark.parametrize(
    ("row", "column"),
    [
        ("2 0 0 0 -1 9 9 0.1", "R"),
        ("2 0 0 0 9 nine 9 0.1", "G"),
        ("2 0 0 0 9 256 9 0.1", "G"),
        ("2 0 0 0 9 9 nan 0.1", "B"),
        ("2 0 0 0 9 9 1e308 0.1", "B"),
        ("2 0 0 0 9 9 inf 0.1", "B"),
        ("2 0 1_0 0 9 9 9 0.1", "Y"),
        ("2 0 0 0 9 \u0663 9 0.1", "G"),
    ],
)
def test_numbers_of_points3d_text(tmp_path: Path, row: str, column: str) -> None:
    points = tmp_path / "points3D.txt"
    points.write_text(f"1 0 0 0 0 255 9 0.1\n{row}\n", encoding="utf-8")
    with faulty(points, (column, 1)):
        read_points(points)
    points.write_text("1 nan 0 0 0 255 9 0.1\n2 0 0 0 0 255 9 0.1\n")
    assert read_points(points).colors.tolist() == [[0, 1, np.float32(9 / 255)]]


@pytest.mark.parametrize("rows", [1, 5, 6, 12])
def test_points_that_all_lack_a_column(tmp_path: Path, rows: int) -> None:
    points = tmp_path / "points3D.txt"
    points.write_text("".join(f"{i} 1 2 3 9 9\n" for i in range(rows)))
    with faulty(points, ("B", 0)):
        read_points(points)


def rig_model(folder: Path, text: bool) -> Path:
    """Write a model of three frames of a rig of three cameras with pycolmap."""
    pycolmap = pytest.importorskip("pycolmap")
    rng, model, rig = np.random.default_rng(0), pycolmap.Reconstruction(), pycolmap.Rig(rig_id=5)

    def pose() -> object:
        return pycolmap.Rigid3d(
            pycolmap.Rotation3d(quaternion(turn(rng))[[1, 2, 3, 0]]), rng.normal(size=3)
        )

    cameras = [
        pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[9, 9, 4, 3], camera_id=i)
        for i in (7, 2, 4)
    ]
    for camera in cameras:
        model.add_camera(camera)
        added = [] if camera is cameras[0] else [pose()]
        (rig.add_sensor if added else rig.add_ref_sensor)(camera.sensor_id, *added)
    model.add_rig(rig)
    for number in range(3):
        frame, images = pycolmap.Frame(frame_id=10 + number, rig_id=5), []
        for camera in cameras:
            key = 20 + 10 * number + camera.camera_id
            name = f"cam{camera.camera_id}/{number}.png"
            images.append(
                pycolmap.Image(
                    name=name, camera_id=camera.camera_id, image_id=key, frame_id=10 + number
                )
            )
            frame.add_data_id(images[-1].data_id)
        frame.rig_from_world = pose()
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(10 + number)
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return folder


def turn(rng: np.random.Generator) -> np.ndarray:
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Q * np.linalg.det(Q)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("value", [0.0, float("nan")])
@pytest.mark.parametrize("lost", [[0], [4, 8], list(range(9))])
def test_rigs_and_frames_give_poses_that_images_lack(
    tmp_path: Path, text: bool, value: float, lost: list[int]
) -> None:
    folder = rig_model(tmp_path / "sparse" / "0", text)
    known = read_views(tmp_path)
    file = folder / f"images.{'txt' if text else 'bin'}"
    if text:
        lines = file.read_text().splitlines()
        rows = [i for i, line in enumerate(lines) if line.endswith(".png")]
        for row in (rows[k] for k in lost):
            words = lines[row].split()
            lines[row] = " ".join([words[0], *[str(value)] * 7, *words[8:]])
        file.write_text("\n".join(lines) + "\n")
    else:
        data, at = bytearray(file.read_bytes()), 8
        for k in range(9):
            if k in lost:
                data[at + 4 : at + 60] = struct.pack("<7d", *[value] * 7)
            at = data.index(b"\0", at + 64) + 9
        file.write_bytes(data)
    found = read_views(tmp_path)
    assert found.names == known.names
    assert len(found) == 9
    np.testing.assert_allclose(found.viewmats, known.viewmats, atol=1e-9)
    for name in ("rigs", "frames"):
        table = folder / f"{name}{file.suffix}"
        whole = table.read_bytes()
        table.write_bytes(whole[:-30])
        with pytest.raises(InputError, match=rf"{table.name}") as caught:
            read_views(tmp_path)
        assert caught.value.property
        assert caught.value.index is not None
        table.write_bytes(whole)
    (folder / f"frames{file.suffix}").unlink()
    if len(lost) < 9 and value:
        assert len(read_views(tmp_path)) == 9 - len(lost)
    else:
        with pytest.raises(InputError, match=r"images\."):
            read_views(tmp_path)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("text", [False, True])
def test_models_of_cameras_are_those_of_colmap(tmp_path: Path, text: bool, seed: int) -> None:
    """Cameras of every model, in any order, as COLMAP's own library writes them."""
    pycolmap = pytest.importorskip("pycolmap")
    ids = [model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    assert [model.name for model in sorted(ids, key=int)] == list(_MODELS)
    rng = np.random.default_rng(seed)
    cameras = {}
    for number, place in enumerate(rng.permutation(len(ids)).tolist(), 1):
        camera = pycolmap.Camera.create_from_model_id(number, ids[place], 90, 200, 150)
        if camera.model_name != "EQUIRECTANGULAR":
            camera.params = camera.params + rng.uniform(0, 0.01, len(camera.params))
        cameras[number] = camera
        assert _PARAMETERS.get(camera.model_name, len(camera.params)) == len(camera.params)

    def written(numbers: list[int]) -> Path:
        folder = tmp_path / str(len(numbers)) / str(numbers[0])
        folder.mkdir(parents=True)
        model = pycolmap.Reconstruction()
        for number in numbers:
            model.add_camera_with_trivial_rig(cameras[number])
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=4)), rng.normal(size=3))
            image = pycolmap.Image(name=f"{number:02}.png", camera_id=number, image_id=number)
            model.add_image_with_trivial_frame(image, pose)
        (model.write_text if text else model.write_binary)(folder)
        return folder

    for number, camera in cameras.items():
        if camera.model_name not in _PARAMETERS:
            with pytest.raises(InputError, match=f"unsupported camera model {camera.model_name};"):
                read_views(written([number]))
    known = [number for number, camera in cameras.items() if camera.model_name in _PARAMETERS]
    found = {photo_of(view.name): view for view in read_views(written(known))}
    rays = np.stack([*rng.uniform(-0.4, 0.4, (2, 50)), np.ones(50)], 1)
    assert set(found) == {f"{number:02}.png" for number in known}
    for number in known:
        view, camera = found[f"{number:02}.png"], cameras[number]
        if view.lens is None:
            fx, fy, cx, cy = view.K[[0, 1, 0, 1], [0, 1, 2, 2]]
            lens = PhotoLens("FULL_OPENCV", (200, 150), (fx, fy, cx, cy, *view.distortion, 0, 0, 0))
        else:
            lens = view.lens.turned(np.eye(3))
        np.testing.assert_allclose(lens.project(rays)[0], camera.img_from_cam(rays), atol=1e-9)
