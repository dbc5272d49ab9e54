"""Reader for laser scans, .e57, with pye57: their points, and their photos as views."""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float
from g2ard.errors import G2ardError, InputError, missing
from g2ard.io.atomic import atomic_output
from g2ard.io.frames import Frame, Lens, Listed, invert_pose, make_pose
from g2ard.io.judge import full_scales
from g2ard.io.paths import check_unpacked, file_identity, user_cache
from g2ard.io.stream import JoinedClouds, MarkedPoints, Names, PointStream, telling
from g2ard.io.transforms import FLIP
from g2ard.io.types import Note, Notes, ViewFiles
from g2ard.progress import plural
from g2ard.scene.lenses import PhotoLens
from g2ard.scene.transform import rotation_matrices

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_INTENSITY = ("intensity",)
_UNSEEN = {_COLORS: ("isColorInvalid",), _INTENSITY: ("isIntensityInvalid",)}
_SAMPLE_ROWS = 100_000  # points of each scan that tell where it is and how it is coloured

_PANORAMA_AXES = np.array(
    [
        [0.0, 0, 1, 0],
        [-1, 0, 0, 0],
        [0, -1, 0, 0],
        [0, 0, 0, 1],
    ]
)
"""OpenCV's camera axes in those of a panorama, whose middle is along x, with z up."""

_FULL_CIRCLE = 0.01  # largest relative difference of a panorama's aspect from 2:1
_SUFFIXES = {"jpegImage": ".jpg", "pngImage": ".png"}
_NO_NAME = re.compile(r"[^\w.-]+")


class Stream(JoinedClouds):
    """Points of all scans in the world of their poses, with colours, or grey from intensities.

    Points that a scan marks as invalid are dropped; a scan without points counts for nothing.
    """

    def __init__(self, path: Path) -> None:
        with _opened(path) as file:
            headers = [file.get_header(number) for number in range(file.scan_count)]
            counts = [header.point_count for header in headers]
            check_unpacked(path.stat().st_size, 24 * sum(counts))
            self._photos = sum(node.isDefined("pose") for node in _images(file))
            scans = [_Scan(path, headers[i], i) for i, count in enumerate(counts) if count]
        if not scans:
            raise InputError("has no points")
        super().__init__(scans)

    def identity(self) -> list[Any]:
        return file_identity([self.path])

    def header_notes(self) -> Notes:
        found: dict[str, list[Note]] = {}
        for number, scan in enumerate(self.streams):
            for note in scan.header_notes():
                if len(self.streams) > 1:
                    note = replace(note, text=f"scan {number}: {note}")
                found.setdefault(note.code, []).append(note)
        notes = []
        for same in found.values():
            count = sum(note.count for note in same)
            text = str(same[0])
            if len(same) > 1:
                text += f"; similar in {plural(len(same) - 1, 'other scan')}"
            notes.append(replace(same[0], count=count, text=text))
        if self._photos:
            photos = plural(self._photos, "photo")
            text = f"{photos} with poses inside; --views {self.path} uses them"
            notes.append(Note("photos", self._photos, text))
        return tuple(notes)


class _Scan(PointStream):
    """A scan's points, at world = rotation @ x + translation."""

    def __init__(self, path: Path, header: Any, number: int) -> None:
        self.path = path
        self.count = header.point_count
        self._number = number
        self.fields = tuple(header.point_fields)
        self._names = set(self.fields)
        places = list(filter(self._names.issuperset, (_CARTESIAN, _SPHERICAL)))
        if not places:
            what = "has no positions (cartesianX, cartesianY, cartesianZ)"
            raise InputError(what, index=number, item="scan")
        self._place = places[0]
        quats = np.array([header.rotation], float)
        self._rotation = rotation_matrices(quats)[0]
        self._translation = np.asarray(header.translation, float)
        choices = list(filter(self._names.issuperset, (_COLORS, _INTENSITY)))
        self._color, sample = telling(choices, self._sampled)
        limits = None
        if self._color == _INTENSITY:
            limits = _limits(header, "intensity")
        scales = full_scales(np.dtype(float))
        super().__init__(path, self.count, sample, scales, limits)
        self.axes = "RFU"
        stated = _limits(header, "colorRed")
        if self.channels == 3 and stated is not None:
            white = next((scale for scale in scales if scale >= stated[1]), self._full)
            if self._full != 255:
                self._full = max(self._full, white)

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError("a scan cannot be searched, so that other processes would read all of it")

    def header_notes(self) -> Notes:
        scaled = ("eight_bit_colors", "color_range")  # fields have no range of their own
        return tuple(note for note in super().header_notes() if note.code not in scaled)

    def _sampled(self, color: Names) -> Iterator[MarkedPoints]:
        """Yield points from all parts of the scan."""
        self._color = color
        step = max(1, self.count // _SAMPLE_ROWS)
        for positions, colors, noise in self.raw(_SAMPLE_ROWS, 0):
            yield positions[::step], colors[::step], noise[::step]

    def _marks(self) -> list[str]:
        """Return the fields that mark points without positions or colours."""
        marks = ["cartesianInvalidState", "sphericalInvalidState"]
        if marks[0] in self._names:
            del marks[1]
        marks += _UNSEEN.get(self._color, ())
        return [mark for mark in marks if mark in self._names]

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        """Yield points from a row on; those before are read too, since files cannot be searched."""
        from pye57 import libe57

        with _opened(self.path) as file:
            names = (*self._place, *self._color, *self._marks(), *self.also)
            fields = {name: np.empty(rows) for name in names}
            buffers = libe57.VectorSourceDestBuffer()
            for name, values in fields.items():
                buffer = libe57.SourceDestBuffer(
                    file.image_file,
                    name,
                    values,
                    rows,
                    True,
                    True,
                )
                buffers.append(buffer)
            reader = file.get_header(self._number)["points"].reader(buffers)
            at = 0
            while got := reader.read():
                skipped = min(got, max(0, start - at))
                at += got
                if skipped == got:
                    continue
                here = {name: values[skipped:got] for name, values in fields.items()}
                yield self._points(here)
            reader.close()
        if at < self.count:
            text = f"scan {self._number} has {at:,} of {self.count:,} points"
            raise InputError(text, path=self.path)

    def _points(self, fields: dict[str, Float]) -> MarkedPoints:
        own = [fields[name] for name in self._place]
        if self._place == _SPHERICAL:
            distance, azimuth, elevation = own
            across = distance * np.cos(elevation)
            own = [
                across * np.cos(azimuth),
                across * np.sin(azimuth),
                distance * np.sin(elevation),
            ]
        turned = np.stack(own, axis=1) @ self._rotation.T
        positions = turned + self._translation
        names = self._color + self.also
        colors = np.zeros((len(positions), len(names)), np.float32)
        for channel, name in enumerate(names):
            colors[:, channel] = fields[name]
        noise = ~np.any(own, axis=0)  # relative to the scanner: no return
        for name in self._marks():
            marked = fields[name] != 0
            if name in _UNSEEN.get(self._color, ()):
                colors[marked, : len(self._color)] = 0
            else:
                noise |= marked
        return positions, colors, noise


def _limits(header: Any, name: str) -> tuple[float, float] | None:
    """Return the stated range of a scan's intensities or colours, or None."""
    limits = f"{name.removesuffix('Red')}Limits"
    if limits not in header.scan_fields:
        return None
    try:
        stated = header[limits]
        low = float(stated[f"{name}Minimum"].value())
        high = float(stated[f"{name}Maximum"].value())
    except Exception:  # libe57's own, for a structure without them
        return None
    if low < high:
        return low, high
    return None


def _images(file: Any) -> list[Any]:
    root = file.image_file.root()
    if not root.isDefined("images2D"):
        return []
    images = root["images2D"]
    return [images[i] for i in range(images.childCount())]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file; errors of the library become an `InputError`."""
    try:
        import pye57
    except ImportError as error:
        raise missing("reading .e57", "pye57", path=path) from error
    try:
        file = pye57.E57(str(path))
        try:
            yield file
        finally:
            file.close()
    except (G2ardError, GeneratorExit):
        raise
    except Exception as error:  # those of libE57Format have several lines
        text = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"cannot be read as E57: {text}", path=path) from error


def read(views: ViewFiles) -> Listed:
    """Read photos with poses as views; their files are copied to a cache once.

    Panoramas of the full sphere look along x with z up; pinhole images look along −z with y up, as the format
    defines. Others (for reference, cylindrical, without a pose) are left out with a note.
    """
    path = views.path
    if views.images is not None:
        raise InputError("has its photos inside", hint="leave {images} out")
    with _opened(path) as file:
        nodes = _images(file)
        if not nodes:
            raise InputError("holds no photos", hint="give views with photos of their own")
        folder = _cache_of(path)
        found = [_frame(number, node, folder) for number, node in enumerate(nodes)]
    frames = [frame for frame in found if isinstance(frame, Frame)]
    left_out = [reason for reason in found if isinstance(reason, str)]
    listed = Listed(path, frames)
    if not left_out:
        return listed
    if not frames:
        photos = plural(len(nodes), "photo")
        raise InputError(f"none of its {photos} can be used: {left_out[0]}")
    photos = plural(len(left_out), "photo")
    text = f"{photos} of {len(nodes)} left out: {left_out[0]}"
    return listed.noted("left_out_photos", len(left_out), text)


def _frame(number: int, node: Any, folder: Path) -> Frame | str:
    """Return the view of a photo, or the reason why it cannot be used."""
    stem = f"{number:04d}"
    if node.isDefined("name"):
        named = str(node["name"].value())
        plain = _NO_NAME.sub("_", named).strip("_.")[:80]
        if plain:
            stem += f"_{plain}"
    kind = next((k for k in ("spherical", "pinhole") if node.isDefined(f"{k}Representation")), None)
    if kind is None:
        return f"{stem} has no spherical or pinhole representation"
    if not node.isDefined("pose"):
        return f"{stem} has no pose"
    shown = node[f"{kind}Representation"]
    size = int(shown["imageWidth"].value()), int(shown["imageHeight"].value())
    if min(size) < 1:
        return f"{stem} has {size[0]}×{size[1]} pixels"
    if kind == "spherical":
        if abs(size[0] - 2 * size[1]) > _FULL_CIRCLE * size[0]:
            return f"{stem} is a panorama of {size[0]}×{size[1]} pixels, not of the full sphere"
        lens = Lens.of(PhotoLens("EQUIRECTANGULAR", size, ()))
    else:
        focal, across, down, cx, cy = (
            float(shown[name].value())
            for name in (
                "focalLength",
                "pixelWidth",
                "pixelHeight",
                "principalPointX",
                "principalPointY",
            )
        )
        if not (focal > 0 and across > 0 and down > 0):
            return f"{stem} has no focal length"
        lens = Lens.pinhole(size, (focal / across, focal / down), (cx, cy))
    blob = next((name for name in _SUFFIXES if shown.isDefined(name)), None)
    if blob is None:
        return f"{stem} has no JPEG or PNG"
    photo = _copied(shown[blob], folder / f"{stem}{_SUFFIXES[blob]}")
    mask = None
    if shown.isDefined("imageMask"):
        mask = _copied(shown["imageMask"], folder / "masks" / f"{stem}.png")
    axes = FLIP
    if kind == "spherical":
        axes = _PANORAMA_AXES
    world_from_camera = _pose(node["pose"]) @ axes
    return Frame(
        photo.name,
        invert_pose(world_from_camera),
        lens,
        photo,
        mask=mask,
        listed=photo.name,
    )


def _pose(node: Any) -> Float:
    """Return world_from_photo; parts that are missing are those of the identity."""
    quat = [1.0, 0.0, 0.0, 0.0]
    shift = [0.0, 0.0, 0.0]
    if node.isDefined("rotation"):
        quat = [float(node["rotation"][axis].value()) for axis in "wxyz"]
    if node.isDefined("translation"):
        shift = [float(node["translation"][axis].value()) for axis in "xyz"]
    return make_pose(quat, shift)


def _copied(blob: Any, target: Path) -> Path:
    """Copy a photo into the cache, unless it is there."""
    if target.is_file() and target.stat().st_size == blob.byteCount():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(target, overwrite=True) as temporary:
        temporary.write_bytes(np.asarray(blob.read_buffer()).tobytes())
    return target


def _cache_of(path: Path) -> Path:
    """Return the folder of a file's photos below the user's cache folder; another file has another one."""
    state = path.stat()
    key = f"{path.resolve()}\n{state.st_size}\n{state.st_mtime_ns}"
    digest = hashlib.sha256(os.fsencode(key)).hexdigest()
    return user_cache() / "e57" / f"{path.stem}-{digest[:16]}"
