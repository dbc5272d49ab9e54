"""Reader for Polycam's raw data: one .json of ARKit's camera per photo in `keyframes`."""

from pathlib import Path

import msgspec
import numpy as np

from g2ard.errors import InputError
from g2ard.io.finding import Finder, files_in
from g2ard.io.frames import Frame, Lens, Listed, make_rigid
from g2ard.io.jsonfile import Number, Place, Whole, checked, read_json
from g2ard.io.transforms import opencv_view
from g2ard.io.types import ViewFiles

_FOLDERS = (
    ("corrected_cameras", "corrected_images"),
    ("cameras", "images"),
)
"""Folders of cameras and photos: after Polycam's optimisation, and as ARKit tracked them."""


_POSE = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_FIELDS = [(name, Number) for name in (*_POSE, "fx", "fy", "cx", "cy")]
_Keyframe = msgspec.defstruct("_Keyframe", [*_FIELDS, ("width", Whole), ("height", Whole)])


def holds(folder: Path) -> bool:
    return cameras_in(folder) is not None


def cameras_in(path: Path) -> tuple[Path, Path] | None:
    """Return the folders of cameras and of photos of a capture, optimised ones first, or None."""
    for cameras, photos in _FOLDERS:
        folder = path / "keyframes" / cameras
        if files_in(folder, ".json"):
            return folder, path / "keyframes" / photos
    return None


def read(views: ViewFiles) -> Listed:
    """Read the keyframes of a capture: fx, fy, cx, cy, width, height, and rows t_00 … t_23 of
    world_from_camera in OpenGL axes, metres, y up.
    """
    folders = cameras_in(views.path)
    if folders is None:
        raise InputError("has no keyframes/cameras with .json files")
    cameras, photos = folders
    files = files_in(cameras, ".json")
    files.sort(key=lambda file: (len(file.stem), file.stem))
    finder = Finder(views.images or photos)
    found = Listed(views.path, [_frame(file, finder) for file in files])
    if cameras.name == "corrected_cameras":
        return found
    text = "the capture has no corrected_cameras; these are ARKit's poses as tracked"
    return found.noted("tracked_poses", len(files), text)


def _frame(file: Path, finder: Finder) -> Frame:
    place = Place(file)
    keyframe = checked(read_json(file), _Keyframe, place)
    *pose, fx, fy, cx, cy, width, height = msgspec.structs.astuple(keyframe)
    if not (fx > 0 and fy > 0 and min(width, height) > 0):
        raise place.error(f"has focal lengths {fx}, {fy} and {width}×{height} pixels")
    name = f"{file.stem}.jpg"
    lens = Lens.pinhole((width, height), (fx, fy), (cx, cy))
    viewmat = opencv_view(make_rigid(np.array(pose).reshape(3, 4), place))
    return Frame(name, viewmat, lens, finder.photo(name), listed=name)
