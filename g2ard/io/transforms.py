"""Reader for transforms.json of instant-ngp, nerfstudio and NeRF's synthetic scenes."""

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import Number, Place, Pose, Vector, Whole, checked, read_json
from g2ard.io.photos import Frame, Lens, find_photo, inverse, photo_size, rigid, view_set
from g2ard.io.types import ViewSet

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

_LEAST_ANGLE = 1e-6
"""Smallest distance of a field of view from 0 and π, radians."""

_TRAIN, _TEST = "transforms_train.json", "transforms_test.json"

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes (y up, looking along −z) to OpenCV's (y down, looking along z)."""


class _Content(msgspec.Struct):
    frames: list[Any] = []
    train_filenames: list[Any] = []
    val_filenames: list[Any] = []
    test_filenames: list[Any] = []


class _Frame(msgspec.Struct):
    """A frame, with the file's own properties as defaults."""

    file_path: str
    transform_matrix: Pose
    mask_path: str | None = None
    camera_model: str = "OPENCV"
    is_fisheye: Any = False
    w: Whole | UnsetType = UNSET
    h: Whole | UnsetType = UNSET
    width: Whole | UnsetType = UNSET
    height: Whole | UnsetType = UNSET
    fl_x: Number | UnsetType = UNSET
    fl_y: Number | UnsetType = UNSET
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    cx: Number | UnsetType = UNSET
    cy: Number | UnsetType = UNSET
    k1: Number = 0.0
    k2: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    k3: Number = 0.0
    K: Any = None
    intrinsics: Any = None


class _Numbered(msgspec.Struct):
    frame_index: Whole
    rot_mat: Any


def holds(folder: Path) -> bool:
    return bool(files_of(folder))


def describes(content: Any) -> bool:
    return isinstance(content, dict) and "frames" in content


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read frames with their photos and intrinsics, which override those of the file.

    `path` is the JSON, or a folder with transforms.json, or with transforms_train.json and
    transforms_test.json, which then are the splits. transforms_train.json finds the other beside it.
    """
    if path.name != _TRAIN:
        return view_set(path, frames(path, images))
    if (path.parent / _TEST).is_file():
        both = [*_frames(path, images, "train"), *_frames(path.parent / _TEST, images, "test")]
        return view_set(path, both).noted("test_beside", 1, f"{_TEST} beside it has the test views")
    text = f"no {_TEST} beside it; every 8th of its views is held out"
    return view_set(path, frames(path, images)).noted("no_test_beside", 1, text)


def frames(path: Path, images: Path | None = None) -> list[Frame]:
    """Return the frames of `read`, with or without photos."""
    if path.is_file():
        return _frames(path, images)
    return [frame for file, split in files_of(path).items() for frame in _frames(file, images, split)]


def files_of(folder: Path) -> dict[Path, str | None]:
    """Return a folder's transforms.json, or its transforms_{train,val,test}.json with their splits."""
    whole = folder / "transforms.json"
    if whole.is_file():
        return {whole: None}
    named = {folder / f"transforms_{split}.json": split for split in ("train", "val", "test")}
    return {file: split for file, split in named.items() if file.is_file()}


def _frames(path: Path, images: Path | None, split: str | None = None) -> list[Frame]:
    """Read the frames of a transforms.json.

    If it lists the names of its splits, these count (None for an unlisted frame), otherwise `split`.
    """
    shared = read_json(path)
    content = checked(shared, _Content, Place(path))
    if not content.frames:
        raise InputError("no views found ('frames' is empty)", path=path)
    parsed = [
        _frame(Place(path, i, "frame"), shared, frame, images) for i, frame in enumerate(content.frames)
    ]
    split_of = _stated(path, content)
    if not split_of:
        return [frame._replace(split=split) for frame in parsed]
    names = [Path(str(frame.get("file_path"))).as_posix() for frame in content.frames]
    return [frame._replace(split=split_of.get(name)) for frame, name in zip(parsed, names, strict=True)]


def _stated(path: Path, content: _Content) -> dict[str, str]:
    """Return file_path → split from nerfstudio's lists train_filenames, val_filenames and test_filenames."""
    stated: dict[str, str] = {}
    for split in ("train", "val", "test"):
        for listed in getattr(content, f"{split}_filenames"):
            name = Path(str(listed)).as_posix()
            if stated.setdefault(name, split) != split and stated[name] == "train":
                raise InputError(f"{name!r} is in both train_filenames and {split}_filenames", path=path)
    return stated


def _frame(place: Place, shared: dict[str, Any], entry: Any, images: Path | None) -> Frame:
    content, folder = {**shared, **checked(entry, dict[str, Any], place)}, place.path.parent
    if "rot_mat" in content:
        content |= _from_matrix_city(folder, checked(content, _Numbered, place))
    frame = checked(content, _Frame, place)
    mask = None if frame.mask_path is None else folder / frame.mask_path
    if mask is not None and not mask.is_file():
        raise place.to("mask_path").error(f"is {mask}, which does not exist")
    file_path = frame.file_path
    world_from_camera = rigid(np.array(frame.transform_matrix), place.to("transform_matrix"))
    photo = find_photo(images / Path(file_path).name if images else folder / file_path)
    if images is None and not photo.is_file():  # photos beside the file that names them in a folder
        beside = find_photo(folder / Path(file_path).name)
        photo = beside if beside.is_file() else photo
    return Frame(
        name=file_path.removeprefix("./").removeprefix("images/"),
        viewmat=opencv_view(world_from_camera),
        photo=photo,
        mask=mask,
        lens=_intrinsics(place, frame, photo),
    )


def _from_matrix_city(folder: Path, frame: _Numbered) -> dict[str, Any]:
    """Convert a frame of MatrixCity's blocks: photos by number, rotations scaled by 0.01.

    Positions are in metres; MatrixCity's pose folders (transforms_train.json) use 100 m instead.
    """
    name = f"{frame.frame_index:04d}.png"
    places = [within for within in ("", "rgb/", "input/") if (folder / within / name).is_file()]
    return {"file_path": (places or [""])[0] + name, "transform_matrix": frame.rot_mat}


def opencv_view(world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a rigid world_from_camera in OpenGL axes to a (4, 4) camera_from_world in OpenCV axes."""
    return inverse(world_from_camera @ FLIP)


def _intrinsics(place: Place, frame: _Frame, photo: Path) -> Lens:
    if frame.camera_model not in _MODELS or frame.is_fisheye:
        known = ", ".join(_MODELS)
        lens = "fisheye" if frame.is_fisheye else frame.camera_model
        error = place.error(f"has an unsupported {lens} lens; expected {known}")
        raise error.at(hint="undistort the photos")
    width, height = _size(place, frame, photo)
    distortion = (frame.k1, frame.k2, frame.p1, frame.p2, frame.k3)
    if (K := _matrix(place, frame)) is not None:
        return Lens((width, height), K, distortion)
    if frame.fl_x is UNSET:
        fx = _focal(place, "camera_angle_x", frame.camera_angle_x, width)
        fy = (
            _focal(place, "camera_angle_y", frame.camera_angle_y, height)
            if frame.fl_y is UNSET
            else frame.fl_y
        )
    else:  # beside fl_x, camera_angle_y may be of another camera
        fx, fy = frame.fl_x, frame.fl_x if frame.fl_y is UNSET else frame.fl_y
    fy = fy or fx
    if fx is None or fy is None:
        raise place.error("has no focal length (fl_x, camera_angle_x, or a 3×3 K or intrinsics)")
    cx = width / 2 if frame.cx is UNSET else frame.cx
    cy = height / 2 if frame.cy is UNSET else frame.cy
    return Lens((width, height), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), distortion)


def _matrix(place: Place, frame: _Frame) -> NDArray[np.float64] | None:
    """Return a frame's 3×3 `K` or `intrinsics`, without skew, or None."""
    key = next((key for key in ("K", "intrinsics") if isinstance(getattr(frame, key), list)), None)
    if key is None:
        return None
    K = np.array(checked(getattr(frame, key), tuple[Vector, Vector, Vector], place.to(key)))
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1])):
        raise place.to(key).error("is not a matrix of focal lengths and a principal point")
    K[0, 1] = K[1, 0] = 0
    return K


def _focal(place: Place, key: str, angle: float | None, pixels: int) -> float | None:
    if angle is None:
        return None
    if not _LEAST_ANGLE < angle < math.pi - _LEAST_ANGLE:
        raise place.to(key).error(f"is {angle}, expected radians between 0 and π")
    return 0.5 * pixels / math.tan(0.5 * angle)


def _size(place: Place, frame: _Frame, photo: Path) -> tuple[int, int]:
    for width, height in ((frame.w, frame.h), (frame.width, frame.height)):
        if width is not UNSET and height is not UNSET:
            return width, height
    if photo.is_file():
        return photo_size(photo, place.path)
    error = place.error(f"has neither w and h nor a photo {photo}")
    raise error.at(hint="{images=DIR} names the folder of photos that are elsewhere")
