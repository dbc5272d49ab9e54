"""transforms.json, as instant-ngp, nerfstudio and NeRF's synthetic scenes write it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.jsonfile import fields_of, read_json
from g2ard.io.photos import Frame, find_photo, inverse, photo_size, pixels, rigid, view_set
from g2ard.io.types import ViewSet

__all__ = ["files_of", "frames", "opencv_view", "read"]

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

_LEAST_ANGLE = 1e-6
"""Radians from 0 and π: past them a focal length is no number of pixels that means something."""

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes (y up, looking along −z) to OpenCV's (y down, looking along z)."""


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read frames, their intrinsics (a frame's own win over the file's) and photos.

    Args:
        path: the JSON, or the folder that holds transforms.json, or transforms_train.json and
            transforms_test.json, whose views then state their split.
        images: a folder to look for photos in, by their file names; None takes paths as written, relative
            to the JSON.

    Raises:
        InputError: no frames, a pose or intrinsics that make no sense, or a fisheye lens.
    """
    return view_set(path, frames(path, images))


def frames(path: Path, images: Path | None = None) -> list[Frame]:
    """As `read`, before photos that are missing are left out.

    Raises:
        InputError: as `read`.
    """
    if path.is_file():
        return _frames(path, images)
    return [frame for file, split in files_of(path).items() for frame in _frames(file, images, split)]


def files_of(folder: Path) -> dict[Path, str | None]:
    """The files of a folder and the split each stands for: transforms.json, else transforms_train.json and
    its kin (NeRF's synthetic scenes, MatrixCity's pose folders)."""
    whole = folder / "transforms.json"
    if whole.is_file():
        return {whole: None}
    named = {folder / f"transforms_{split}.json": split for split in ("train", "val", "test")}
    return {file: split for file, split in named.items() if file.is_file()}


def _frames(path: Path, images: Path | None, split: str | None = None) -> list[Frame]:
    content = read_json(path)
    listed = content.get("frames")
    if not isinstance(listed, list) or not listed:
        raise InputError("no views found ('frames' is empty)", path=path)
    found = [_frame(path, i, content, frame, images) for i, frame in enumerate(listed)]
    stated = _stated(path, content)
    if not stated:
        return [frame._replace(split=split) for frame in found]
    names = [Path(str(frame.get("file_path"))).as_posix() for frame in listed]
    return [frame._replace(split=stated.get(name)) for frame, name in zip(found, names, strict=True)]


def _stated(path: Path, content: dict[str, Any]) -> dict[str, str]:
    """file_path → split, where the file lists them as nerfstudio's data may (train_filenames and its kin)."""
    stated: dict[str, str] = {}
    for split in ("train", "val", "test"):
        names = content.get(f"{split}_filenames", ())
        if not isinstance(names, list | tuple):
            raise InputError(f"'{split}_filenames' is not a list", path=path)
        for listed in names:
            name = Path(str(listed)).as_posix()
            if stated.setdefault(name, split) != split and stated[name] == "train":
                raise InputError(f"{name!r} is in both train_filenames and {split}_filenames", path=path)
    return stated


def _frame(path: Path, index: int, content: dict[str, Any], entry: Any, images: Path | None) -> Frame:
    where = f"{path}: frame {index}"
    shared = content if isinstance(entry, dict) else {}
    with fields_of(where, {**shared, **entry} if shared else entry) as frame:
        if "rot_mat" in frame:
            frame.update(_from_matrix_city(path, frame))
        file_path = str(frame["file_path"])
        mask = frame.get("mask_path")
        world_from_camera = np.array(frame["transform_matrix"], np.float64)
        photo = find_photo(images / Path(file_path).name if images else path.parent / file_path)
        return Frame(
            name=file_path.removeprefix("./").removeprefix("images/"),
            viewmat=opencv_view(rigid(where, world_from_camera)),
            photo=photo,
            mask=None if mask is None else _there(where, path.parent / str(mask)),
            **_intrinsics(where, frame, photo),
        )


def _from_matrix_city(path: Path, frame: dict[str, Any]) -> dict[str, Any]:
    """A frame of one of its blocks: photos by number, and rotations a hundredth of what they should be.

    Positions stay as written, metres; its pose folders (transforms_train.json) count in 100 m instead.
    """
    name = f"{int(frame['frame_index']):04d}.png"
    places = [folder for folder in ("", "rgb/", "input/") if (path.parent / folder / name).is_file()]
    return {"file_path": (places or [""])[0] + name, "transform_matrix": frame["rot_mat"]}


def _there(where: str, mask: Path) -> Path:
    if not mask.is_file():
        raise InputError(f"its mask {mask} does not exist", path=where)
    return mask


def opencv_view(world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) camera_from_world with OpenCV's axes, of a rigid world_from_camera with OpenGL's."""
    return inverse(world_from_camera @ _FLIP)


def _intrinsics(where: str, values: dict[str, Any], photo: Path) -> dict[str, Any]:
    model = str(values.get("camera_model", "OPENCV"))
    if model not in _MODELS or values.get("is_fisheye"):
        known = ", ".join(_MODELS)
        raise InputError(
            f"a {model} lens, or a fisheye, is not supported ({known} are); undistort the photos", path=where
        )
    width, height = _size(where, values, photo)
    fx = _focal(values, "x", width)
    fy = _focal(values, "y", height) or fx
    if fx is None or fy is None:
        raise InputError("no focal length (fl_x or camera_angle_x)", path=where)
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    return {
        "K": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        "size": (width, height),
        "distortion": tuple(float(values.get(key, 0)) for key in ("k1", "k2", "p1", "p2", "k3")),
    }


def _focal(values: dict[str, Any], axis: str, pixels: int) -> float | None:
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    if axis == "y" and "fl_x" in values:
        return None  # square pixels, rather than an angle of another camera
    angle = values.get(f"camera_angle_{axis}")
    if angle is None:
        return None
    if not _LEAST_ANGLE < float(angle) < math.pi - _LEAST_ANGLE:
        raise ValueError(f"camera_angle_{axis} is {angle!r}, expected radians between 0 and π")
    return 0.5 * pixels / math.tan(0.5 * float(angle))


def _size(where: str, values: dict[str, Any], photo: Path) -> tuple[int, int]:
    if "w" in values and "h" in values:
        return pixels(where, values, "w"), pixels(where, values, "h")
    if photo.is_file():
        return photo_size(where, photo)
    raise InputError("neither w and h nor its photo is there to tell the size", path=where)
