"""Reader for COLMAP models: cameras and images, binary or text.

Rigs and frames (COLMAP 3.12 and later) give the poses of images that have none of their own.
"""

import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, damaged
from g2ard.io.finding import Finder
from g2ard.io.paths import decoded
from g2ard.io.photos import Frame, Lens, photo_size, posed, view_set
from g2ard.io.types import ViewSet
from g2ard.progress import plural
from g2ard.scene.lenses import PARAMETERS, PhotoLens

_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
    *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM"),
    "EQUIRECTANGULAR",
)
_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}


_MODEL_FILES = tuple(
    f"{part}{suffix}" for suffix in (".bin", ".txt") for part in ("cameras", "images", "points3D")
)
"""Files of a model."""


class NotFinite(InputError):
    """A number that is not finite; its view is left out."""


class _Image(NamedTuple):
    """A row of the table of images; `fault` is what is wrong with its pose, if a number is not finite."""

    key: int
    name: str
    camera: int
    pose: tuple[float, ...]
    fault: NotFinite | None = None


def holds(folder: Path) -> bool:
    """Return whether a folder holds a model, or photos beside one."""
    return model_folder(folder) is not None or photos_beside(folder) is not None


def model_folder(path: Path) -> Path | None:
    """Return the model's folder, or None: that of `path` itself, otherwise the one with the most images in
    sparse, colmap/sparse or a numbered folder in these.
    """
    found = _models(path)
    return found[0] if found else None


def _models(path: Path) -> list[Path]:
    """Return the folders of models, that of `path` or otherwise the one with the most images first."""
    path = path.parent if path.is_file() else path
    if _tables(path):
        return [path, *(folder for folder in _numbered(path.parent) if folder != path)]
    for sparse in (path / "sparse", path / "colmap" / "sparse"):
        folders = [folder for folder in (*_numbered(sparse), sparse) if _tables(folder)]
        if folders:
            return sorted(folders, key=_count, reverse=len(folders) > 1)
    return sorted(_numbered(path), key=_count, reverse=True)


def _numbered(folder: Path) -> list[Path]:
    """Return the models in the numbered folders of one, as COLMAP's mapper writes them."""
    if not folder.is_dir():
        return []
    numbered = sorted((p for p in folder.iterdir() if p.name.isdecimal()), key=lambda p: int(p.name))
    return [place for place in numbered if _tables(place)]


def _count(folder: Path) -> int:
    """Return the number of images of a model, 0 if they cannot be read."""
    tables = _tables(folder)
    try:
        if tables is None or tables[1].suffix.lower() == ".txt":
            return 0 if tables is None else len(_images_txt(tables[1]))
        with tables[1].open("rb") as file:
            (count,) = _COUNT.unpack(file.read(_COUNT.size))
            return int(count)
    except (InputError, OSError, ValueError, struct.error):
        return 0


def models_below(path: Path) -> list[Path]:
    """Return the folders of models up to three levels below a folder, the nearest first."""
    level, found = [path], list[Path]()
    for _ in range(3):
        inner = [sorted(p for p in folder.iterdir() if p.is_dir())[:_MOST_FOLDERS] for folder in level]
        level = [folder for folders in inner for folder in folders][:_MOST_FOLDERS]
        found += [folder for folder in level if _tables(folder)]
    return found


_MOST_FOLDERS = 64
"""Folders of a level to look into."""


def photos_beside(path: Path) -> tuple[Path, Path] | None:
    """Return (project, photos) if `path` is a folder of photos beside a model, such as images_4."""
    if not path.is_dir() or not path.name.startswith("images") or model_folder(path) is not None:
        return None
    return (path.parent, path) if model_folder(path.parent) is not None else None


def points_file(path: Path) -> Path | None:
    """Return the file of points of the model that `read` takes for `path`, which may not exist, or None."""
    beside = photos_beside(path)
    folder = model_folder(beside[0] if beside else path)
    if folder is None:
        return None
    held = _held(folder)
    return next((held[name] for name in _POINT_FILES if name in held), folder / "points3D.bin")


_POINT_FILES = ("points3d.bin", "points3d.txt")


def _held(folder: Path) -> dict[str, Path]:
    """Return the files of a folder by name in small letters."""
    return {p.name.lower(): p for p in sorted(folder.iterdir()) if p.is_file()} if folder.is_dir() else {}


def _tables(folder: Path) -> tuple[Path, Path] | None:
    """Return the files of cameras and images, binary before text; None if either is missing."""
    held = _held(folder)
    for suffix in (".bin", ".txt"):
        cameras, images = held.get(f"cameras{suffix}"), held.get(f"images{suffix}")
        if cameras and images:
            return cameras, images
    return None


def incomplete(path: Path) -> InputError | None:
    """Return the error for a model without cameras or images, or None if there is no part of one."""
    folder = path.parent if path.is_file() else path
    above = [folder / "sparse", folder / "colmap" / "sparse"]
    for place in (folder, *above, *(p for up in above if up.is_dir() for p in sorted(up.iterdir()))):
        names = _held(place)
        held = [name for name in _MODEL_FILES if name.lower() in names]
        if held and _tables(place) is None:
            suffix = Path(held[0]).suffix
            lacking = [f"{part}{suffix}" for part in ("cameras", "images") if f"{part}{suffix}" not in held]
            text = f"COLMAP model without {' and '.join(lacking)}; found {', '.join(held)}"
            return InputError(text, path=place, hint="copy the whole model: cameras (lenses), images (poses)")
    return None


@contextmanager
def parsing(path: Path) -> Iterator[None]:
    """Turn parsing errors into an `InputError` that names the file."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(f"malformed ({error})", path=path) from error
    except OSError as error:
        raise InputError(f"{error.strerror}", path=path) from error


def read(path: Path, images: Path | None = None) -> ViewSet:
    """Read the registered images of a COLMAP model as views, sorted by name.

    `path` is the project folder, the model's folder, one of its files, or a folder of photos beside the
    model, such as images_4. Cameras are scaled to resized photos (Mip-NeRF 360's images_2, images_4). Of
    several models in numbered folders, the one with the most images is read, unless `path` is one.
    """
    left_out: list[tuple[str, InputError]] = []
    folder, listed = frames(path, images, left_out)
    views = view_set(folder, listed, left_out)
    beside = photos_beside(path)
    others = [other for other in _models(beside[0] if beside else path) if other != folder]
    if not others:
        return views
    largest = max(others, key=_count)
    text = f"read {folder} of {len(others) + 1} models; {largest} has {plural(_count(largest), 'image')}"
    return views.noted("other_models", len(others), text)


def frames(
    path: Path, images: Path | None = None, left_out: list[tuple[str, InputError]] | None = None
) -> tuple[Path, list[Frame]]:
    """Return the model's folder and its frames, with or without photos.

    Views with numbers that are not finite are appended to `left_out`; None raises their error.
    """
    if images is None and (beside := photos_beside(path)):
        path, images = beside
    folder = model_folder(path)
    tables = _tables(folder) if folder else None
    if folder is None or tables is None:
        error = incomplete(path)
        raise error or InputError("has no COLMAP model (cameras and images, .bin or .txt)", path=path)
    binary = tables[0].suffix.lower() == ".bin"
    with parsing(tables[0]):
        cameras = (_cameras_bin if binary else _cameras_txt)(tables[0])
    with parsing(tables[1]):
        images_read = (_images_bin if binary else _images_txt)(tables[1])
    if not images_read:
        raise InputError("has no images", path=tables[1])
    finder = Finder(images) if images else Finder(*_photo_folders(path, folder))
    listed, faults = list[Frame](), list[tuple[str, InputError]]()
    by_rig = None
    sizes: dict[int, tuple[int, int]] = {}
    for image in sorted(images_read, key=lambda i: i.name):
        if image.camera not in cameras:
            raise InputError(f"{image.name!r} has the unknown camera {image.camera}", path=tables[1])
        camera = cameras[image.camera]
        if isinstance(camera, NotFinite):
            faults.append((image.name, camera))
            continue
        photo = finder.photo(image.name)
        if images is not None and photo.is_file():
            if image.camera not in sizes:  # one lens, one size
                sizes[image.camera] = photo_size(photo, tables[1], camera.size)
            camera = camera.at(sizes[image.camera])
        pose = None
        if image.fault is None and any(image.pose[:4]):
            pose = posed(image.pose[:4], image.pose[4:])
        else:
            by_rig = _rig_poses(folder, binary) if by_rig is None else by_rig
            pose = by_rig.get((image.key, image.camera))
        if pose is None:
            if image.fault is None:
                raise InputError(f"{image.name!r}: its quaternion is zero", path=tables[1])
            faults.append((image.name, image.fault))
            continue
        listed.append(Frame(image.name, pose, camera, photo, listed=image.name))
    if faults and left_out is None:
        raise faults[0][1]
    if left_out is not None:
        left_out += faults
    return folder, listed


def _photo_folders(path: Path, model: Path) -> list[Path]:
    """Return folders of photos: `images` beside `path`, the model or up to three folders above it."""
    roots = (path, model, model.parent, model.parent.parent, model.parent.parent.parent)
    found = [root / "images" for root in roots if (root / "images").is_dir()]
    return found[:1] or [path / "images"]


class Table:
    """A binary table: little-endian values without padding, read one after the other."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0
        (self.count,) = self.take("table", 0, _COUNT, ["COUNT"])

    def take(self, item: str, i: int, layout: struct.Struct, names: Sequence[str]) -> tuple[Any, ...]:
        """Return the next values, which errors call by these names of entry `i`, such as camera 3."""
        try:
            values = layout.unpack_from(self.data, self.at)
        except struct.error:
            ends = (self.at + struct.calcsize(layout.format[: k + 2]) for k in range(len(names)))
            raise self.cut_off(item, i, names[sum(end <= len(self.data) for end in ends)]) from None
        self.at += layout.size
        return values

    def finite(self, item: str, i: int, layout: struct.Struct, names: Sequence[str]) -> tuple[Any, ...]:
        """Return the next values as `take` does, or raise an `InputError` if one is not finite."""
        values = self.take(item, i, layout, names)
        for name, value in zip(names, values, strict=True):
            if not math.isfinite(value):
                raise NotFinite(f"is {value}", path=self.path, property=name, index=i, item=item)
        return values

    def skip(self, item: str, i: int, size: int, name: str) -> None:
        """Move past bytes, which errors call by this name."""
        self.at += size
        if self.at > len(self.data):
            raise self.cut_off(item, i, name)

    def cut_off(self, item: str, i: int, name: str) -> InputError:
        return damaged("is cut off", path=self.path, property=name, index=i, item=item)


def _camera(path: Path, model: str, size: tuple[int, int], p: tuple[float, ...]) -> Lens:
    known = _PARAMETERS | PARAMETERS
    if model not in known:
        raise InputError(
            f"unsupported camera model {model}; expected {', '.join(known)}",
            path=path,
            hint="undistort with COLMAP",
        )
    if len(p) != known[model] and model != "EQUIRECTANGULAR":
        raise InputError(f"{model} takes {known[model]} parameters, got {len(p)}", path=path)
    if model in PARAMETERS:
        lens = PhotoLens(model, size, p)
        if min(size) < 1 or min(lens.focal) <= 0:
            raise InputError(f"invalid camera of {size[0]:,}×{size[1]:,} pixels", path=path)
        return Lens.of(lens)
    single_focal = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    fx, fy, cx, cy, *k = (p[0], *p) if single_focal else p
    if min(size) < 1 or min(fx, fy) <= 0:
        raise InputError(
            f"invalid camera of {size[0]:,}×{size[1]:,} pixels and focal lengths {fx}, {fy}", path=path
        )
    k1, k2, p1, p2 = (*k, 0.0, 0.0, 0.0, 0.0)[:4]
    return Lens(size, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), (k1, k2, p1, p2, 0.0))


_POSE = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")
_IMAGE_NAMES = ("IMAGE_ID", *_POSE, "CAMERA_ID")
_CAMERA_NAMES = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT")
_COUNT, _CAMERA, _IMAGE = struct.Struct("<Q"), struct.Struct("<iiQQ"), struct.Struct("<IdddddddI")


def _cameras_bin(path: Path) -> dict[int, Lens | NotFinite]:
    table, cameras = Table(path), dict[int, Lens | NotFinite]()
    for i in range(table.count):
        key, model, width, height = table.take("camera", i, _CAMERA, _CAMERA_NAMES)
        name = _MODELS[model] if 0 <= model < len(_MODELS) else f"number {model}"
        names = [f"PARAMS[{k}]" for k in range((_PARAMETERS | PARAMETERS).get(name, 0))]
        try:
            values = table.finite("camera", i, struct.Struct(f"<{len(names) * 'd'}"), names)
            cameras[key] = _camera(path, name, (width, height), values)
        except NotFinite as error:
            cameras[key] = error
    return cameras


def _images_bin(path: Path) -> list[_Image]:
    table = Table(path)
    images: list[_Image] = []
    for i in range(table.count):
        at, fault = table.at, None
        try:
            key, *pose, camera = table.finite("image", i, _IMAGE, _IMAGE_NAMES)
        except NotFinite as error:
            fault, table.at = error, at
            key, *pose, camera = table.take("image", i, _IMAGE, _IMAGE_NAMES)
        end = table.data.find(b"\0", table.at)
        if end < 0:
            raise table.cut_off("image", i, "NAME")
        try:
            name = table.data[table.at : end].decode()
        except UnicodeDecodeError:
            raise InputError("is not UTF-8", path=path, property="NAME", index=i, item="image") from None
        table.at = end + 1
        (points,) = table.take("image", i, _COUNT, ["POINTS2D"])
        table.skip("image", i, 24 * points, "POINTS2D")
        images.append(_Image(key, name, camera, tuple(pose), fault))
    return images


_U32, _SENSOR, _SEVEN = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<ddddddd")
_FRAME, _DATA = struct.Struct("<IIddddddd"), struct.Struct("<iIQ")
_IS_CAMERA = 0


def _rig_poses(folder: Path, binary: bool) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return camera_from_world by image and camera, as frames and rigs say; no poses without their files.

    camera_from_world = sensor_from_rig · rig_from_world. Poses that are unknown or not finite are missing.
    """
    held, suffix = _held(folder), ".bin" if binary else ".txt"
    rigs, frames = held.get(f"rigs{suffix}"), held.get(f"frames{suffix}")
    if rigs is None or frames is None:
        return {}
    with parsing(rigs):
        sensors = (_rigs_bin if binary else _rigs_txt)(rigs)
    found: dict[tuple[int, int], NDArray[np.float64]] = {}
    with parsing(frames):
        for rig, numbers, images in (_frames_bin if binary else _frames_txt)(frames):
            from_world = _known(numbers)
            for camera, image in images:
                in_rig = sensors.get(rig, {}).get(camera)
                if from_world is not None and in_rig is not None:
                    found[image, camera] = in_rig @ from_world
    return found


_Rigs = dict[int, dict[int, NDArray[np.float64] | None]]
_RigFrames = Iterator[tuple[int, tuple[float, ...], list[tuple[int, int]]]]


def _known(numbers: Sequence[float]) -> NDArray[np.float64] | None:
    """Return the rigid transform of seven numbers, or None if it is not one."""
    if not all(map(math.isfinite, numbers)) or not any(numbers[:4]):
        return None
    return posed(numbers[:4], numbers[4:])


def _rigs_bin(path: Path) -> _Rigs:
    table, rigs = Table(path), _Rigs()
    for i in range(table.count):
        (key,) = table.take("rig", i, _U32, ["RIG_ID"])
        (count,) = table.take("rig", i, _U32, ["NUM_SENSORS"])
        rigs[key] = {}
        for number in range(count):
            kind, sensor = table.take("rig", i, _SENSOR, ["SENSOR_TYPE", "SENSOR_ID"])
            pose: NDArray[np.float64] | None = np.eye(4)
            if number:
                (has_pose,) = table.take("rig", i, struct.Struct("<B"), ["HAS_POSE"])
                pose = _known(table.take("rig", i, _SEVEN, _POSE)) if has_pose else None
            if kind == _IS_CAMERA:
                rigs[key][sensor] = pose
    return rigs


def _frames_bin(path: Path) -> _RigFrames:
    table = Table(path)
    for i in range(table.count):
        _key, rig, *pose = table.take("frame", i, _FRAME, ["FRAME_ID", "RIG_ID", *_POSE])
        (count,) = table.take("frame", i, _U32, ["NUM_DATA_IDS"])
        names = ["SENSOR_TYPE", "SENSOR_ID", "DATA_ID"]
        data = [table.take("frame", i, _DATA, names) for _ in range(count)]
        yield rig, tuple(pose), [(sensor, image) for kind, sensor, image in data if kind == _IS_CAMERA]


def _rigs_txt(path: Path) -> _Rigs:
    rigs = _Rigs()
    for words in (iter(line.split()) for line in text_lines(path) if line.strip()):
        key, count = int(next(words, "")), int(next(words, ""))
        rigs[key] = {}
        for number in range(count):
            kind, sensor = next(words, ""), int(next(words, ""))
            pose: NDArray[np.float64] | None = np.eye(4)
            if number:
                has_pose = int(next(words, ""))
                pose = _known([float(next(words, "")) for _ in _POSE]) if has_pose else None
            if kind == "CAMERA":
                rigs[key][sensor] = pose
    return rigs


def _frames_txt(path: Path) -> _RigFrames:
    for words in (iter(line.split()) for line in text_lines(path) if line.strip()):
        _key, rig = int(next(words, "")), int(next(words, ""))
        pose = tuple(float(next(words, "")) for _ in _POSE)
        data = [
            (next(words, ""), int(next(words, "")), int(next(words, ""))) for _ in range(int(next(words, "")))
        ]
        yield rig, pose, [(sensor, image) for kind, sensor, image in data if kind == "CAMERA"]


_CAMERA_COLUMNS = (("CAMERA_ID", 0), ("WIDTH", 2), ("HEIGHT", 3))
_KEY_COLUMNS = (("IMAGE_ID", 0), ("CAMERA_ID", 8))
_POSE_COLUMNS = tuple((name, at) for at, name in enumerate(_POSE, 1))


def text_lines(path: Path) -> list[str]:
    """Return the lines of a COLMAP text table without comments; empty lines may be rows."""
    return [line for line in decoded(path.read_bytes()).splitlines() if not line.startswith("#")]


def _cameras_txt(path: Path) -> dict[int, Lens | NotFinite]:
    cameras: dict[int, Lens | NotFinite] = {}
    rows = [words for line in text_lines(path) if (words := line.split())]
    for i, words in enumerate(rows):
        key, width, height = (number(path, "camera", i, words, name, at) for name, at in _CAMERA_COLUMNS)
        try:
            params = tuple(
                number(path, "camera", i, words, f"PARAMS[{at - 4}]", at, _finite)
                for at in range(4, len(words))
            )
            cameras[int(key)] = _camera(path, words[1], (int(width), int(height)), params)
        except NotFinite as error:
            cameras[int(key)] = error
    return cameras


def number(
    path: Path, item: str, i: int, words: list[str], name: str, at: int, kind: Callable[[str], float] = int
) -> float:
    """Return a column of row `i` of a text table."""
    if at >= len(words):
        raise InputError("is missing", path=path, property=name, index=i, item=item)
    word = words[at]
    if kind is _finite and _NOT_FINITE.fullmatch(word):
        raise NotFinite(f"is {word!r}", path=path, property=name, index=i, item=item)
    try:
        if "_" in word or not word.isascii():  # float() accepts both
            raise ValueError(word)
        return kind(word)
    except ValueError:
        raise InputError(f"is {word!r}", path=path, property=name, index=i, item=item) from None


def _finite(word: str) -> float:
    value = float(word)
    if not math.isfinite(value):
        raise ValueError(word)
    return value


_NOT_FINITE = re.compile(r"[+-]?(nan(\(.*\))?|inf(inity)?|\d\.#\w+)", re.IGNORECASE)
"""Numbers that are not finite, as C and C++ write them on any system."""


def _images_txt(path: Path) -> list[_Image]:
    """Read images.txt: per image a line with its pose (wxyz and translation, camera from world), camera
    and name, then a line with its points, which is skipped and may be empty or missing.
    """
    images: list[_Image] = []
    points = False
    for line in text_lines(path):
        if not line.strip() or (points and _is_points(line)):
            points = False
            continue
        i, words, points = len(images), line.split(maxsplit=9), True
        pose, fault = tuple[float, ...](), None
        try:
            pose = tuple(number(path, "image", i, words, key, at, _finite) for key, at in _POSE_COLUMNS)
        except NotFinite as error:
            fault = error
        key, camera = (int(number(path, "image", i, words, *column)) for column in _KEY_COLUMNS)
        if len(words) < 10:
            raise InputError("is missing", path=path, property="NAME", index=i, item="image")
        images.append(_Image(key, words[9].strip(), camera, pose, fault))
    return images


def _is_points(line: str) -> bool:
    """Return whether a line of images.txt has triples x, y, POINT3D_ID, unlike the line of an image."""
    words = line.split()
    ids = words[2::3]
    return len(words) % 3 == 0 and all(map(_WHOLE.fullmatch, ids)) and all(map(_NUMBER.fullmatch, words[:30]))


_WHOLE, _NUMBER = re.compile(r"-?\d+"), re.compile(r"[+-]?(nan|inf|[\d.]+(e[+-]?\d+)?)", re.IGNORECASE)
