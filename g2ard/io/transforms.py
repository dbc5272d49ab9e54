"""Reader and writer for transforms.json of instant-ngp, nerfstudio and NeRF's synthetic scenes."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from g2ard.arrays import Float
from g2ard.errors import InputError
from g2ard.io.finding import Finder, is_end
from g2ard.io.frames import Frame, Lens, Listed, invert_pose, make_rigid
from g2ard.io.jsonfile import Json, Number, Place, Pose, Vector, Whole, checked, read_json
from g2ard.io.paths import beside
from g2ard.io.photo_headers import have_same_aspect, read_size
from g2ard.io.types import Note, Notes, Size, Splits, ViewFiles
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import PhotoLens

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

_NO_COEFFICIENTS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4")
"""Coefficients that lenses lack; of these, fisheyes have k4."""

_LEAST_ANGLE = 1e-6  # smallest distance of a field of view from 0 and π, radians
_TRAIN = "transforms_train.json"
_TEST = "transforms_test.json"

_APART = {
    "test_frames": "test",
    "val_frames": "val",
    "eval_frames": "test",
}
"""Further lists of frames, as of ScanNet++, and their splits."""

_SPLITS = ("train", "val", "test")
"""Splits for which nerfstudio lists the names of photos, as in train_filenames."""

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes (y up, looking along −z) to OpenCV's (y down, looking along z)."""


_Pixels = Whole | UnsetType
_Given = Number | UnsetType


class _Frame(msgspec.Struct):
    """A frame, with the file's own properties as defaults."""

    file_path: str
    transform_matrix: Pose
    mask_path: str | None = None
    camera_model: str = "OPENCV"
    is_fisheye: Any = False
    w: _Pixels = UNSET
    h: _Pixels = UNSET
    width: _Pixels = UNSET
    height: _Pixels = UNSET
    fl_x: _Given = UNSET
    fl_y: _Given = UNSET
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    cx: _Given = UNSET
    cy: _Given = UNSET
    k1: Number = 0.0
    k2: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    k5: Number = 0.0
    k6: Number = 0.0
    s1: Number = 0.0
    s2: Number = 0.0
    s3: Number = 0.0
    s4: Number = 0.0
    K: Any = None
    intrinsics: Any = None


class _Numbered(msgspec.Struct):
    frame_index: Whole
    rot_mat: Any


def read(views: ViewFiles) -> Listed:
    """Read frames with their photos and intrinsics, which override those of the file.

    `path` is the JSON, or a folder with transforms.json, or with transforms_train.json and
    transforms_test.json, which then are the splits. transforms_train.json finds the other beside it.
    """
    path = views.path
    if path.name != _TRAIN:
        return listed(views)
    test = path.parent / _TEST
    if test.is_file():
        files = {path: "train", test: "test"}
        found = _listed(path, files, views.images)
        return found.noted("test_beside", 1, f"{_TEST} beside it has the test views")
    text = f"no {_TEST} beside it; every 8th of its views is held out"
    return listed(views).noted("no_test_beside", 1, text)


def listed(views: ViewFiles) -> Listed:
    """Return the frames of `read`, of a transforms_train.json without the other beside it."""
    path = views.path
    files: dict[Path, str | None] = {path: None}
    if not path.is_file():
        files = files_of(path)
    return _listed(path, files, views.images)


def files_of(folder: Path) -> dict[Path, str | None]:
    """Return a folder's transforms.json, or its transforms_{train,val,test}.json with their splits."""
    whole = folder / "transforms.json"
    if whole.is_file():
        return {whole: None}
    named = {folder / f"transforms_{split}.json": split for split in _SPLITS}
    return {file: split for file, split in named.items() if file.is_file()}


def _listed(
    path: Path,
    files: Mapping[Path, str | None],
    among: Path | None,
) -> Listed:
    frames = list[Frame]()
    left_out = list[tuple[str, InputError]]()
    notes = list[Note]()
    for file, split in files.items():
        own, further = _frames(file, among, left_out, split)
        frames += own
        notes += further
    return Listed(path, frames, left_out, tuple(notes))


def _frames(
    path: Path,
    among: Path | None,
    left_out: list[tuple[str, InputError]],
    split: str | None,
) -> tuple[list[Frame], Notes]:
    """Read the frames of a transforms.json, and append views with numbers that are not finite to `left_out`.

    If it lists the names of its splits, these count (None for an unlisted frame), otherwise `split`. Frames
    of `test_frames`, `val_frames` and `eval_frames` (as test) are in these splits, the others then in train.
    """
    shared = read_json(path)
    keys = ["frames", *_APART]
    keys += [f"{split}_filenames" for split in _SPLITS]
    lists = {key: checked(shared.get(key, []), list[Any], Place(path).to(key)) for key in keys}
    if not lists["frames"]:
        raise InputError("no views found ('frames' is empty)", path=path)
    folder = path.parent
    above = folder.parent
    names = [str(entry.get("file_path")) for entry in lists["frames"] if isinstance(entry, dict)]
    places = [folder, folder / "images", above / "resized_images"]
    finder = Finder.among(among, names, places, [folder])
    masks = Finder(folder, folder / "masks", above / "resized_anon_masks")
    split_of_list = {key: word for key, word in _APART.items() if lists[key]}
    if split_of_list:
        split = "train"
    frames = []
    for key, word in [("frames", split), *split_of_list.items()]:
        item = "frame" if key == "frames" else f"{key} entry"
        for i, entry in enumerate(lists[key]):
            place = Place(path, i, item)
            try:
                frame = _frame(place, shared, entry, finder, masks)
            except InputError as error:
                if not isinstance(entry, dict) or _finite(entry):
                    raise
                left_out.append((str(entry.get("file_path")), error))
            else:
                frames.append(frame._replace(split=word))
    stated = _stated(path, lists)
    if stated:
        for i, frame in enumerate(frames):
            name = Path(frame.listed).as_posix()
            frames[i] = frame._replace(split=stated.get(name))
    return frames, finder.notes


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _stated(path: Path, lists: dict[str, list[Any]]) -> dict[str, str]:
    """Return file_path → split from nerfstudio's lists train_filenames, val_filenames and test_filenames."""
    stated: dict[str, str] = {}
    for split in _SPLITS:
        for listed in lists[f"{split}_filenames"]:
            name = Path(str(listed)).as_posix()
            if stated.setdefault(name, split) != split and stated[name] == "train":
                raise InputError(
                    f"{name!r} is in both train_filenames and {split}_filenames", path=path
                )
    return stated


def _frame(
    place: Place,
    shared: Json,
    entry: Any,
    finder: Finder,
    masks: Finder,
) -> Frame:
    content = {**shared, **checked(entry, Json, place)}
    folder = place.path.parent
    if "rot_mat" in content:
        content |= _from_matrix_city(folder, checked(content, _Numbered, place))
    frame = checked(content, _Frame, place)
    file_path = frame.file_path
    world_from_camera = make_rigid(np.array(frame.transform_matrix), place.to("transform_matrix"))
    photo = finder.photo(file_path)
    mask = None
    if frame.mask_path is not None:
        mask = masks.find(frame.mask_path)
        if mask is None or (mask.parent == photo.parent and not is_end(frame.mask_path, mask)):
            text = f"is {folder / frame.mask_path}, which does not exist"
            raise place.to("mask_path").error(text)
    return Frame(
        name=file_path.removeprefix("./").removeprefix("images/"),
        viewmat=opencv_view(world_from_camera),
        photo=photo,
        mask=mask,
        lens=_intrinsics(place, frame, photo),
        listed=file_path,
    )


def _from_matrix_city(folder: Path, frame: _Numbered) -> Json:
    """Convert a frame of MatrixCity's blocks: photos by number, rotations scaled by 0.01.

    Positions are in metres; MatrixCity's pose folders (transforms_train.json) use 100 m instead.
    """
    name = f"{frame.frame_index:04d}.png"
    names = [name, f"rgb/{name}", f"input/{name}"]
    held = (name for name in names if (folder / name).is_file())
    return {
        "file_path": next(held, name),
        "transform_matrix": frame.rot_mat,
    }


def opencv_view(world_from_camera: Float) -> Float:
    """Convert a rigid world_from_camera in OpenGL axes to a (4, 4) camera_from_world in OpenCV axes."""
    return invert_pose(world_from_camera @ FLIP)


def _intrinsics(place: Place, frame: _Frame, photo: Path) -> Lens:
    model = "OPENCV_FISHEYE" if frame.is_fisheye else frame.camera_model
    known = (*_MODELS, "OPENCV_FISHEYE", "EQUIRECTANGULAR")
    if model not in known:
        error = place.error(f"has an unsupported {model} lens; expected {', '.join(known)}")
        raise error.at(hint="undistort the photos")
    unused = [name for name in _NO_COEFFICIENTS if getattr(frame, name)]
    if unused and (model in _MODELS or unused != ["k4"]):
        name = unused[0]
        text = f"is {getattr(frame, name)}; lenses have k1, k2, k3, p1 and p2"
        raise place.to(name).error(text).at(hint="undistort the photos")
    size = _size(place, frame, photo)
    if model == "EQUIRECTANGULAR":
        if not have_same_aspect(size, (2, 1)):
            width, height = size
            text = f"is a panorama of {width}×{height} pixels, expected twice as wide as high"
            raise place.error(text)
        return Lens.of(PhotoLens(model, size, ()))
    lens = _pinhole(place, frame, size)
    if model in _MODELS:
        return lens
    (fx, _, cx), (_, fy, cy), _ = lens.K
    bent = (frame.k1, frame.k2, frame.k3, frame.k4)
    params = (fx, fy, cx, cy, *bent)
    return Lens.of(PhotoLens(model, lens.size, params))


def _pinhole(place: Place, frame: _Frame, size: Size) -> Lens:
    width, height = size
    distortion = (frame.k1, frame.k2, frame.p1, frame.p2, frame.k3)
    K = _matrix(place, frame)
    if K is not None:
        return Lens(size, K, distortion)
    if frame.fl_x is UNSET:
        fx = _focal(place, "camera_angle_x", frame.camera_angle_x, width)
        if frame.fl_y is UNSET:
            fy = _focal(place, "camera_angle_y", frame.camera_angle_y, height)
        else:
            fy = frame.fl_y
    else:  # beside fl_x, camera_angle_y may be of another camera
        fx = frame.fl_x
        if frame.fl_y is UNSET:
            fy = frame.fl_x
        else:
            fy = frame.fl_y
    fy = fy or fx
    if fx is None or fy is None:
        raise place.error("has no focal length (fl_x, camera_angle_x, or a 3×3 K or intrinsics)")
    if frame.cx is UNSET:
        cx = width / 2
    else:
        cx = frame.cx
    if frame.cy is UNSET:
        cy = height / 2
    else:
        cy = frame.cy
    return Lens.pinhole(size, (fx, fy), (cx, cy), distortion)


def _matrix(place: Place, frame: _Frame) -> Float | None:
    """Return a frame's 3×3 `K` or `intrinsics`, without skew, or None."""
    if isinstance(frame.K, list):
        stored = frame.K
        place = place.to("K")
    elif isinstance(frame.intrinsics, list):
        stored = frame.intrinsics
        place = place.to("intrinsics")
    else:
        return None
    rows = checked(stored, tuple[Vector, Vector, Vector], place)
    K = np.array(rows)
    focal = K.diagonal()[:2]
    if not (focal > 0).all() or K[2].tolist() != [0, 0, 1]:
        raise place.error("is not a matrix of focal lengths and a principal point")
    K[0, 1] = 0
    K[1, 0] = 0
    return K


def _focal(
    place: Place,
    key: str,
    angle: float | None,
    pixels: int,
) -> float | None:
    if angle is None:
        return None
    if not _LEAST_ANGLE < angle < math.pi - _LEAST_ANGLE:
        raise place.to(key).error(f"is {angle}, expected radians between 0 and π")
    return 0.5 * pixels / math.tan(0.5 * angle)


def _size(place: Place, frame: _Frame, photo: Path) -> Size:
    for width, height in ((frame.w, frame.h), (frame.width, frame.height)):
        if width is not UNSET and height is not UNSET:
            return width, height
    if photo.is_file():
        stated = None
        if frame.cx is not UNSET and frame.cy is not UNSET:
            stated = (2 * frame.cx, 2 * frame.cy)
        return read_size(photo, place.path, stated)
    error = place.error(f"has neither w and h nor a photo {photo}")
    raise error.at(hint="{images=DIR} names the folder of photos that are elsewhere")


def text_of(path: Path, cameras: Cameras, splits: Splits) -> str:
    """Return a transforms.json: world_from_camera in OpenGL axes, and lists of file names per split.

    Photos are relative to `path`; views without one are named `images/NAME`.
    """
    head: Json = {"camera_model": "OPENCV"}
    lenses = [intrinsics_of(cameras, i) for i in range(len(cameras))]
    shared = all(lens == lenses[0] for lens in lenses)
    if shared:
        head |= lenses[0]
    frames = []
    for i, viewmat in enumerate(cameras.viewmats):
        photo = None
        mask = None
        if cameras.lenses[i] is None:
            photo = cameras.image_paths[i]
            mask = cameras.mask_paths[i]
        frame: Json = {"file_path": beside(photo, path) or f"images/{cameras.names[i]}"}
        covered = beside(mask, path)
        if covered is not None:
            frame["mask_path"] = covered
        if not shared:
            frame |= lenses[i]
        pose = invert_pose(viewmat) @ FLIP
        frame["transform_matrix"] = pose.tolist()
        frames.append(frame)
    names = [frame["file_path"] for frame in frames]
    for word in sorted(set(filter(None, splits))):
        own = [name for name, split in zip(names, splits, strict=True) if split == word]
        head[f"{word}_filenames"] = own
    return json.dumps(head)[:-1] + f', "frames": {json_rows(frames)}}}\n'


def intrinsics_of(cameras: Cameras, i: int) -> Json:
    """Return intrinsics as in transforms.json."""
    (fx, _, cx), (_, fy, cy), _ = cameras.Ks[i].tolist()
    k1, k2, p1, p2, k3 = cameras.distortions[i].tolist()
    return {
        "w": int(cameras.widths[i]),
        "h": int(cameras.heights[i]),
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
        "k3": k3,
    }


def json_rows(rows: list[Json]) -> str:
    return "[\n" + ",\n".join(map(json.dumps, rows)) + "\n]"
