"""Reader for COLMAP models, cameras and images, binary or text; writer for text.

Rigs and frames (COLMAP 3.12 and later) give the poses of images that have none of their own.
"""

import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from g2ard.arrays import Float
from g2ard.errors import InputError, damaged
from g2ard.io.finding import Finder, files_in
from g2ard.io.frames import Frame, Lens, Listed, make_pose
from g2ard.io.jsonfile import Place
from g2ard.io.paths import about, read_text
from g2ard.io.transforms import intrinsics_of
from g2ard.io.types import ViewFiles
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import PARAMETERS, PhotoLens
from g2ard.scene.transform import quaternion_of

_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
)
"""Names of models by their number in binary tables."""
_PINHOLES = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
}
_PARAMETERS = {**_PINHOLES, **PARAMETERS, "EQUIRECTANGULAR": 2}
"""Supported models and their number of parameters; those of a panorama are its width and height."""

_MODEL_FILES = (
    "cameras.bin",
    "images.bin",
    "points3D.bin",
    "cameras.txt",
    "images.txt",
    "points3D.txt",
)
"""Files of a model."""


def holds(folder: Path) -> bool:
    """Return whether a folder holds a model, or photos beside one."""
    return model_folder(folder) is not None or photos_beside(folder) is not None


def model_folder(path: Path) -> Path | None:
    """Return the model's folder, or None: that of `path` itself, otherwise the one with the most images in
    sparse, colmap/sparse or a numbered folder in these.
    """
    return next(iter(_models(path)), None)


def _models(path: Path) -> list[Path]:
    """Return the folders of models, that of `path` or otherwise the one with the most images first."""
    if path.is_file():
        path = path.parent
    if _tables(path):
        beside = [folder for folder in _numbered(path.parent) if folder != path]
        return [path, *beside]
    for sparse in (path / "sparse", path / "colmap" / "sparse"):
        folders = [folder for folder in (*_numbered(sparse), sparse) if _tables(folder)]
        if folders:
            return sorted(folders, key=_count, reverse=len(folders) > 1)
    return sorted(_numbered(path), key=_count, reverse=True)


def _numbered(folder: Path) -> list[Path]:
    """Return the models in the numbered folders of one, as COLMAP's mapper writes them."""
    if not folder.is_dir():
        return []
    numbered = [place for place in folder.iterdir() if place.name.isdecimal() and _tables(place)]
    return sorted(numbered, key=lambda place: int(place.name))


def _count(folder: Path) -> int:
    """Return the number of images of a model, 0 if they cannot be read."""
    tables = _tables(folder)
    try:
        if tables is None:
            return 0
        if tables[1].suffix.lower() == ".txt":
            return len(_images(TextTable(tables[1], "image")))
        with tables[1].open("rb") as file:
            (count,) = _COUNT.packed.unpack(file.read(_COUNT.packed.size))
            return int(count)
    except (InputError, OSError, ValueError, struct.error):
        return 0


def models_below(path: Path) -> list[Path]:
    """Return the folders of models up to three levels below a folder, the nearest first."""
    level = [path]
    found: list[Path] = []
    for _ in range(3):
        inner = []
        for folder in level:
            inner += sorted(filter(Path.is_dir, folder.iterdir()))[:_MOST_FOLDERS]
        level = inner[:_MOST_FOLDERS]
        found += filter(_tables, level)
    return found


_MOST_FOLDERS = 64  # folders of a level to look into


def photos_beside(path: Path) -> tuple[Path, Path] | None:
    """Return (project, photos) if `path` is a folder of photos beside a model, such as images_4."""
    if not path.is_dir() or not path.name.startswith("images") or model_folder(path) is not None:
        return None
    if model_folder(path.parent) is None:
        return None
    return (path.parent, path)


def points_file(path: Path) -> Path | None:
    """Return the file of points of the model that `read` takes for `path`, which may not exist, or None."""
    beside = photos_beside(path)
    if beside:
        path = beside[0]
    folder = model_folder(path)
    if folder is None:
        return None
    held = _held(folder)
    for name in _POINT_FILES:
        if name in held:
            return held[name]
    return folder / "points3D.bin"


def numbers_of(folder: Path, names: Sequence[str]) -> set[int]:
    """Return the numbers by which points name some images of the model in a folder."""
    tables = _tables(folder)
    wanted = set(names)
    if tables is None:
        return set()
    with parsing(tables[1]):
        images = _images(open_table(tables[1], "image"))
    return {key for name, key, *_ in images if name in wanted}


_POINT_FILES = ("points3d.bin", "points3d.txt")


def _held(folder: Path) -> dict[str, Path]:
    """Return the files of a folder by name in small letters."""
    return {path.name.lower(): path for path in files_in(folder)}


def _tables(folder: Path) -> tuple[Path, Path] | None:
    """Return the files of cameras and images, binary before text; None if either is missing."""
    held = _held(folder)
    for suffix in (".bin", ".txt"):
        cameras = held.get(f"cameras{suffix}")
        images = held.get(f"images{suffix}")
        if cameras and images:
            return cameras, images
    return None


def incomplete(path: Path) -> InputError | None:
    """Return the error for a model without cameras or images, or None if there is no part of one."""
    folder = path.parent if path.is_file() else path
    above = [folder / "sparse", folder / "colmap" / "sparse"]
    places = [folder, *above]
    for up in filter(Path.is_dir, above):
        places += sorted(up.iterdir())
    for place in places:
        names = _held(place)
        held = [name for name in _MODEL_FILES if name.lower() in names]
        if held and _tables(place) is None:
            suffix = Path(held[0]).suffix
            needed = [f"cameras{suffix}", f"images{suffix}"]
            lacking = " and ".join(name for name in needed if name not in held)
            return InputError(
                f"COLMAP model without {lacking}; found {', '.join(held)}",
                path=place,
                hint="copy the whole model: cameras (lenses), images (poses)",
            )
    return None


@contextmanager
def parsing(path: Path) -> Iterator[None]:
    """Turn parsing errors into an `InputError` that names the file."""
    with about(path):
        try:
            yield
        except InputError:
            raise
        except (ValueError, IndexError, KeyError, OverflowError) as error:
            raise InputError(f"malformed ({error})") from error


def read(views: ViewFiles) -> Listed:
    """Read the registered images of a COLMAP model as views, sorted by name.

    `path` is the project folder, the model's folder, one of its files, or a folder of photos beside the
    model, such as images_4. Cameras are scaled to resized photos (Mip-NeRF 360's images_2, images_4). Of
    several models in numbered folders, the one with the most images is read, unless `path` is one.
    """
    path = views.path
    found = listed(views)
    beside = photos_beside(path)
    if beside:
        path = beside[0]
    others = [other for other in _models(path) if other != found.path]
    if not others:
        return found
    largest = max(others, key=_count)
    images = plural(_count(largest), "image")
    text = f"read {found.path} of {len(others) + 1} models; {largest} has {images}"
    return found.noted("other_models", len(others), text)


def listed(views: ViewFiles) -> Listed:
    """Return the frames of `read`, without a note on other models."""
    path = views.path
    images = views.images
    if images is None:
        beside = photos_beside(path)
        if beside:
            path, images = beside
    folder = model_folder(path)
    tables = _tables(folder) if folder else None
    if folder is None or tables is None:
        text = "has no COLMAP model (cameras and images, .bin or .txt)"
        raise incomplete(path) or InputError(text, path=path)
    with parsing(tables[0]):
        cameras = _cameras(open_table(tables[0], "camera"))
    with parsing(tables[1]):
        images_read = _images(open_table(tables[1], "image"))
    if not images_read:
        raise InputError("has no images", path=tables[1])
    names = [name for name, *_ in images_read]
    finder = Finder.among(images, names, *_photo_folders(path, folder))
    frames = []
    faults = []
    by_rig = _rig_poses(folder, tables[1].suffix.lower())
    stale = 0
    for name, key, number, own, fault in sorted(images_read, key=lambda image: image[0]):
        if number not in cameras:
            raise InputError(f"{name!r} has the unknown camera {number}", path=tables[1])
        camera = cameras[number]
        if isinstance(camera, InputError):
            faults.append((name, camera))
            continue
        pose = None
        if fault is None and any(own[:4]):
            pose = make_pose(own[:4], own[4:])
        in_rig = by_rig.get((key, number))
        if in_rig is not None:
            if pose is None:
                pose = in_rig
            elif not np.allclose(in_rig, pose, rtol=_SAME, atol=_SAME):
                stale += 1
                pose = in_rig
        if pose is None:
            if fault is None:
                raise InputError(f"{name!r}: its quaternion is zero", path=tables[1])
            faults.append((name, fault))
            continue
        photo = finder.photo(name)
        frames.append(Frame(name, pose, camera, photo, listed=name))
    found = Listed(folder, frames, faults, finder.notes)
    poses = plural(stale, "pose")
    text = f"{poses} of {tables[1].name} differ from rigs and frames, which count"
    return found.noted("stale_poses", stale, text)


_SAME = 1e-5  # difference of poses that rounding may cause


def _photo_folders(path: Path, model: Path) -> tuple[list[Path], list[Path]]:
    """Return folders of photos: `images` beside `path`, the model or up to three folders above it; and where
    photos may be otherwise, up to the project's folder, which is above `sparse`."""
    beside = (root / "images" for root in (path, model, *model.parents[:3]))
    found = next(filter(Path.is_dir, beside), path / "images")
    project = model
    while project.name.isdecimal() or project.name in ("sparse", "colmap"):
        project = project.parent
    return [found], [path, model, project]


class Columns(NamedTuple):
    """Columns of a table: how binary tables pack them, one letter of `struct` each, and their names."""

    packed: struct.Struct
    names: tuple[str, ...]

    @classmethod
    def of(cls, letters: str, *names: str) -> Self:
        return cls(struct.Struct(f"<{letters}"), names)


_POSE = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")
_COUNT = Columns.of("Q", "COUNT")
_CAMERA = Columns.of("iiQQ", "CAMERA_ID", "MODEL", "WIDTH", "HEIGHT")
_IMAGE = Columns.of("IdddddddI", "IMAGE_ID", *_POSE, "CAMERA_ID")
_POINTS = Columns.of("Q", "POINTS2D")
_RIG = Columns.of("II", "RIG_ID", "NUM_SENSORS")
_SENSOR = Columns.of("iI", "SENSOR_TYPE", "SENSOR_ID")
_HAS_POSE = Columns.of("B", "HAS_POSE")
_IN_RIG = Columns.of("ddddddd", *_POSE)
_FRAME = Columns.of("IIdddddddI", "FRAME_ID", "RIG_ID", *_POSE, "NUM_DATA_IDS")
_DATA = Columns.of("iIQ", "SENSOR_TYPE", "SENSOR_ID", "DATA_ID")
_WORDS = ("MODEL", "SENSOR_TYPE")  # columns that are numbers in binary tables, and words in text
_CAMERA_SENSOR = (0, "CAMERA")
_SPLITS = {"image": len(_IMAGE.names), "point": 7}
"""Columns of a line of text before its rest: the name of an image, the error and track of a point."""


class Table:
    """A binary table, read one value after the other. Iterating yields the index of each row, an `item`."""

    def __init__(self, path: Path, item: str) -> None:
        self.path = path
        self.item = item
        self.row = 0
        self.data = path.read_bytes()
        self._at = 0
        (self.count,) = self.take(_COUNT)

    def __iter__(self) -> Iterator[int]:
        for row in range(self.count):
            self.row = row
            yield row

    def take(self, columns: Columns) -> tuple[Any, ...]:
        """Return the next values of this row; raise an `InputError` if one is missing or malformed."""
        layout = columns.packed
        try:
            values = layout.unpack_from(self.data, self._at)
        except struct.error:
            room = len(self.data) - self._at
            formats = accumulate(layout.format[1:], initial="<")
            sizes = map(struct.calcsize, formats)
            whole = sum(size <= room for size in sizes) - 1
            raise self._cut_off(columns.names[whole]) from None
        self._at += layout.size
        return values

    def params(self, model: str) -> tuple[str, tuple[float, ...]]:
        """Return the name of a model of cameras, and its parameters, which come next."""
        number = int(model)
        name = f"number {number}"
        if 0 <= number < len(_MODELS):
            name = _MODELS[number]
        count = _PARAMETERS.get(name, 0)
        return name, self.take(Columns.of(count * "d", *_params(count)))

    def name(self) -> str:
        """Return the name of an image, which ends with a zero byte."""
        end = self.data.find(b"\0", self._at)
        if end < 0:
            raise self._cut_off("NAME")
        start = self._at
        self._at = end + 1
        return self.data[start:end].decode(errors="surrogateescape")

    def skip_points(self) -> None:
        self.skip(24 * self.take(_POINTS)[0], "POINTS2D")

    def skip(self, size: int, name: str) -> bytes:
        """Move past the bytes of a column, and return them."""
        start = self._at
        self._at += size
        if self._at > len(self.data):
            raise self._cut_off(name)
        return self.data[start : self._at]

    def place(self, name: str) -> Place:
        return Place(self.path, self.row, self.item, name)

    def fault(self, names: Sequence[str], values: Sequence[float]) -> InputError | None:
        """Return what is wrong with the first of these values that is not finite."""
        for name, value in zip(names, values, strict=True):
            if not math.isfinite(value):
                return self.place(name).error(f"is {value}")
        return None

    def _cut_off(self, name: str) -> InputError:
        return damaged(
            "is cut off",
            path=self.path,
            property=name,
            index=self.row,
            item=self.item,
        )


class TextTable(Table):
    """A table of lines of words, without comments."""

    def __init__(self, path: Path, item: str) -> None:
        self.path = path
        self.item = item
        self.row = -1
        lines = read_text(path).splitlines()
        self._lines = [line for line in lines if not line.startswith("#")]
        self._next = 0
        self.words = list[str]()
        self._at = 0

    def __iter__(self) -> Iterator[int]:
        while self._next < len(self._lines):
            line = self._lines[self._next]
            self.words = line.split(maxsplit=_SPLITS.get(self.item, -1))
            self._at = 0
            self._next += 1
            if self.words:
                self.row += 1
                yield self.row

    def take(self, columns: Columns) -> tuple[Any, ...]:
        return tuple(map(self._value, columns.names, columns.packed.format[1:]))

    def _value(self, name: str, kind: str) -> int | float | str:
        if self._at >= len(self.words):
            raise self.place(name).error("is missing")
        word = self.words[self._at]
        self._at += 1
        if name in _WORDS:
            return word
        if kind == "d":
            unusual = _NOT_FINITE.fullmatch(word)
            if unusual:
                return math.inf if unusual["inf"] else math.nan
        try:
            if "_" in word or not word.isascii():  # Python reads both
                raise ValueError(word)
            if kind == "d":
                value = float(word)
            else:
                value = int(word)
            if not math.isfinite(value):
                raise ValueError(word)
        except (ValueError, OverflowError):
            raise self.place(name).error(f"is {word!r}") from None
        return value

    def params(self, model: str) -> tuple[str, tuple[float, ...]]:
        count = len(self.words) - self._at
        return model, self.take(Columns.of(count * "d", *_params(count)))

    def name(self) -> str:
        """Return the rest of the line, which may have spaces."""
        if self._at >= len(self.words):
            raise self.place("NAME").error("is missing")
        return self.words[self._at].strip()

    def skip_points(self) -> None:
        """Move past the next line if it has the points of an image; it may be empty or missing."""
        if self._next < len(self._lines) and _is_points(self._lines[self._next]):
            self._next += 1


_NOT_FINITE = re.compile(r"[+-]?(nan(\(.*\))?|(?P<inf>inf(inity)?)|\d\.#\w+)", re.IGNORECASE)
"""Numbers that are not finite, as C and C++ write them on any system."""


def _is_points(line: str) -> bool:
    """Return whether a line of images.txt has triples x, y, POINT3D_ID, unlike the line of an image."""
    words = line.split()
    numbers = words[2::3]
    if len(words) % 3 or not all(map(_WHOLE.fullmatch, numbers)):
        return False
    return all(_NUMBER.fullmatch(word) or _NOT_FINITE.fullmatch(word) for word in words[:30])


_WHOLE = re.compile(r"-?\d+")
_NUMBER = re.compile(r"[+-]?[\d.]+(e[+-]?\d+)?", re.IGNORECASE)


def _params(count: int) -> list[str]:
    return [f"PARAMS[{k}]" for k in range(count)]


def open_table(path: Path, item: str) -> Table:
    """Open a table, .bin or .txt."""
    if path.suffix.lower() == ".txt":
        return TextTable(path, item)
    return Table(path, item)


def _camera(model: str, size: tuple[int, int], p: tuple[float, ...]) -> Lens:
    if model not in _PARAMETERS:
        raise InputError(
            f"unsupported camera model {model}; expected {', '.join(_PARAMETERS)}",
            hint="undistort with COLMAP",
        )
    if len(p) != _PARAMETERS[model]:
        raise InputError(f"{model} takes {_PARAMETERS[model]} parameters, got {len(p)}")
    if model not in _PINHOLES:
        lens = PhotoLens(model, size, p[: PARAMETERS[model]])
        if min(size) < 1 or min(lens.focal) <= 0:
            raise InputError(f"invalid camera of {size[0]:,}×{size[1]:,} pixels")
        return Lens.of(lens)
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):  # one focal length
        p = p[0], *p
    fx, fy, cx, cy, *k = p
    if min(size) < 1 or min(fx, fy) <= 0:
        width, height = size
        pixels = f"{width:,}×{height:,} pixels"
        raise InputError(f"invalid camera of {pixels} and focal lengths {fx}, {fy}")
    distortion = (*k, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return Lens.pinhole(size, (fx, fy), (cx, cy), distortion)


def _cameras(table: Table) -> dict[int, Lens | InputError]:
    cameras = {}
    for _ in table:
        key, kind, width, height = table.take(_CAMERA)
        model, params = table.params(kind)
        fault = table.fault(_params(len(params)), params)
        cameras[key] = fault or _camera(model, (width, height), params)
    return cameras


def _images(table: Table) -> list[tuple[str, int, int, list[float], InputError | None]]:
    """Read name, number, camera, pose (wxyz and translation, camera from world) of each image.

    The last value is what is wrong with its pose, if a number is not finite.
    """
    images = []
    for _ in table:
        key, *pose, camera = table.take(_IMAGE)
        images.append((table.name(), key, camera, pose, table.fault(_POSE, pose)))
        table.skip_points()
    return images


def _rig_poses(folder: Path, suffix: str) -> dict[tuple[int, int], Float]:
    """Return camera_from_world by image and camera, as frames and rigs say; no poses without their files.

    camera_from_world = sensor_from_rig · rig_from_world. Poses that are unknown or not finite are missing.
    """
    held = _held(folder)
    rigs = held.get(f"rigs{suffix}")
    frames = held.get(f"frames{suffix}")
    if rigs is None or frames is None:
        return {}
    with parsing(rigs):
        sensors = _sensors(open_table(rigs, "rig"))
    found = {}
    with parsing(frames):
        table = open_table(frames, "frame")
        for _ in table:
            _key, rig, *numbers, count = table.take(_FRAME)
            from_world = _known(numbers)
            for _ in range(count):
                kind, sensor, image = table.take(_DATA)
                in_rig = None
                if kind in _CAMERA_SENSOR:
                    in_rig = sensors.get((rig, sensor))
                if from_world is not None and in_rig is not None:
                    found[image, sensor] = in_rig @ from_world
    return found


def _sensors(table: Table) -> dict[tuple[int, int], Float | None]:
    """Return camera_from_rig by rig and camera; the first sensor of a rig is its origin."""
    sensors = {}
    for _ in table:
        rig, count = table.take(_RIG)
        for number in range(count):
            kind, sensor = table.take(_SENSOR)
            pose: Float | None = np.eye(4)
            if number:
                pose = None
                if table.take(_HAS_POSE)[0]:
                    pose = _known(table.take(_IN_RIG))
            if kind in _CAMERA_SENSOR:
                sensors[rig, sensor] = pose
    return sensors


def _known(numbers: Sequence[float]) -> Float | None:
    """Return the rigid transform of seven numbers, or None if it is not one."""
    if not all(map(math.isfinite, numbers)) or not any(numbers[:4]):
        return None
    return make_pose(numbers[:4], numbers[4:])


def texts_of(cameras: Cameras) -> dict[str, str]:
    """Return sparse/0 with cameras.txt, images.txt and an empty points3D.txt; a camera per lens."""
    lenses: dict[str, int] = {}
    images = []
    for i, viewmat in enumerate(cameras.viewmats):
        lens = intrinsics_of(cameras, i)
        params = [lens[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
        bent = [lens[key] for key in ("k1", "k2", "p1", "p2")]
        model = "PINHOLE"
        if any(bent):
            model = "OPENCV"
            params += bent
        words = " ".join(map(str, [model, *params]))
        camera = lenses.setdefault(words, len(lenses) + 1)
        quat = quaternion_of(viewmat[:3, :3]).tolist()
        shift = viewmat[:3, 3].tolist()
        image = [i + 1, *quat, *shift, camera, cameras.names[i]]
        images.append(" ".join(map(str, image)) + "\n\n")
    rows_of_cameras = [f"{number} {words}\n" for words, number in lenses.items()]
    return {
        "sparse/0/cameras.txt": f"{_CAMERAS_HEAD}{''.join(rows_of_cameras)}",
        "sparse/0/images.txt": f"{_IMAGES_HEAD}{''.join(images)}",
        "sparse/0/points3D.txt": _POINTS_HEAD,
    }


_CAMERAS_HEAD = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n"
_IMAGES_HEAD = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D[]\n"
_POINTS_HEAD = "# POINT3D_ID X Y Z R G B ERROR TRACK[]\n"
