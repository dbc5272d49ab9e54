"""Reader for transforms.json of instant-ngp, nerfstudio and NeRF's synthetic scenes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import (
    Fields,
    fields_of,
    matrix,
    number,
    numbers,
    optional_text,
    read_json,
    text,
    whole,
)
from g2ard.io.photos import Frame, Lens, find_photo, inverse, photo_size, rigid, view_set
from g2ard.io.types import ViewSet

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

_LEAST_ANGLE = 1e-6
"""Smallest distance of a field of view from 0 and π, radians."""

_TRAIN, _TEST = "transforms_train.json", "transforms_test.json"

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes (y up, looking along −z) to OpenCV's (y down, looking along z)."""


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
    content = read_json(path)
    listed = content.get("frames")
    if not isinstance(listed, list) or not listed:
        raise InputError("no views found ('frames' is empty)", path=path)
    parsed = [_frame(path, i, content, frame, images) for i, frame in enumerate(listed)]
    split_of = _stated(path, content)
    if not split_of:
        return [frame._replace(split=split) for frame in parsed]
    names = [Path(str(frame.get("file_path"))).as_posix() for frame in listed]
    return [frame._replace(split=split_of.get(name)) for frame, name in zip(parsed, names, strict=True)]


def _stated(path: Path, content: dict[str, Any]) -> dict[str, str]:
    """Return file_path → split from nerfstudio's lists train_filenames, val_filenames and test_filenames."""
    stated: dict[str, str] = {}
    for split in ("train", "val", "test"):
        names = content.get(f"{split}_filenames", ())
        if not isinstance(names, list | tuple):
            raise InputError("is not a list", path=path, property=f"{split}_filenames")
        for listed in names:
            name = Path(str(listed)).as_posix()
            if stated.setdefault(name, split) != split and stated[name] == "train":
                raise InputError(f"{name!r} is in both train_filenames and {split}_filenames", path=path)
    return stated


def _frame(path: Path, index: int, content: dict[str, Any], entry: Any, images: Path | None) -> Frame:
    frame = fields_of(path, {**content, **entry} if isinstance(entry, dict) else entry, index, "frame")
    if "rot_mat" in frame:
        frame.update(_from_matrix_city(path, frame))
    file_path, named = text(frame, "file_path"), optional_text(frame, "mask_path")
    mask = None if named is None else path.parent / named
    if mask is not None and not mask.is_file():
        raise frame.place.to("mask_path").error(f"is {mask}, which does not exist")
    world_from_camera = rigid(matrix(frame, "transform_matrix"), frame.place.to("transform_matrix"))
    photo = find_photo(images / Path(file_path).name if images else path.parent / file_path)
    if images is None and not photo.is_file():  # photos beside the file that names them in a folder
        beside = find_photo(path.parent / Path(file_path).name)
        photo = beside if beside.is_file() else photo
    return Frame(
        name=file_path.removeprefix("./").removeprefix("images/"),
        viewmat=opencv_view(world_from_camera),
        photo=photo,
        mask=mask,
        lens=_intrinsics(path, frame, photo),
    )


def _from_matrix_city(path: Path, frame: Fields) -> dict[str, Any]:
    """Convert a frame of MatrixCity's blocks: photos by number, rotations scaled by 0.01.

    Positions are in metres; MatrixCity's pose folders (transforms_train.json) use 100 m instead.
    """
    name = f"{whole(frame, 'frame_index'):04d}.png"
    places = [folder for folder in ("", "rgb/", "input/") if (path.parent / folder / name).is_file()]
    return {"file_path": (places or [""])[0] + name, "transform_matrix": frame["rot_mat"]}


def opencv_view(world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a rigid world_from_camera in OpenGL axes to a (4, 4) camera_from_world in OpenCV axes."""
    return inverse(world_from_camera @ FLIP)


def _intrinsics(path: Path, values: Fields, photo: Path) -> Lens:
    model = text(values, "camera_model", "OPENCV")
    if model not in _MODELS or values.get("is_fisheye"):
        known = ", ".join(_MODELS)
        lens = "fisheye" if values.get("is_fisheye") else model
        error = values.place.error(f"has an unsupported {lens} lens; expected {known}")
        raise error.at(hint="undistort the photos")
    width, height = _size(path, values, photo)
    distortion = tuple(number(values, key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if (K := _matrix(values)) is not None:
        return Lens((width, height), K, distortion)
    fx = _focal(values, "x", width)
    fy = _focal(values, "y", height) or fx
    if fx is None or fy is None:
        raise values.place.error("has no focal length (fl_x, camera_angle_x, or a 3×3 K or intrinsics)")
    cx, cy = number(values, "cx", width / 2), number(values, "cy", height / 2)
    return Lens((width, height), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), distortion)


def _matrix(values: Fields) -> NDArray[np.float64] | None:
    """Return a frame's 3×3 `K` or `intrinsics`, without skew, or None."""
    key = next((key for key in ("K", "intrinsics") if isinstance(values.get(key), list)), None)
    if key is None:
        return None
    K = np.array(numbers(values, key, 3, 3))
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1])):
        raise values.place.to(key).error("is not a matrix of focal lengths and a principal point")
    K[0, 1] = K[1, 0] = 0
    return K


def _focal(values: Fields, axis: str, pixels: int) -> float | None:
    if f"fl_{axis}" in values:
        return number(values, f"fl_{axis}")
    if axis == "y" and "fl_x" in values:
        return None  # square pixels; camera_angle_y may be of another camera
    key = f"camera_angle_{axis}"
    if values.get(key) is None:
        return None
    angle = number(values, key)
    if not _LEAST_ANGLE < angle < math.pi - _LEAST_ANGLE:
        raise values.place.to(key).unexpected(angle, "radians between 0 and π")
    return 0.5 * pixels / math.tan(0.5 * angle)


def _size(path: Path, values: Fields, photo: Path) -> tuple[int, int]:
    for width, height in (("w", "h"), ("width", "height")):
        if width in values and height in values:
            return whole(values, width), whole(values, height)
    if photo.is_file():
        return photo_size(photo, path)
    error = values.place.error(f"has neither w and h nor a photo {photo}")
    raise error.at(hint="{images=DIR} names the folder of photos that are elsewhere")
