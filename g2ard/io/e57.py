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

_PANORAMA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
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
            scans = [
                _Scan(path, header, number)
                for number, header in enumerate(headers)
                if counts[number]
            ]
        if not scans:
            raise InputError("has no points")
        super().__init__(scans)

    def identity(self) -> list[Any]:
        return file_identity([self.path])

    def header_notes(self) -> Notes:
        found: dict[str, list[Note]] = {}
        for number, scan in enumerate(self.streams):
            part = f"scan {number}: " if len(self.streams) > 1 else ""
            for note in scan.header_notes():
                found.setdefault(note.code, []).append(replace(note, text=f"{part}{note}"))
        notes = [
            replace(
                same[0], count=sum(note.count for note in same), text=f"{same[0]}{_more(len(same))}"
            )
            for same in found.values()
        ]
        if self._photos:
            text = (
                f"{plural(self._photos, 'photo')} with poses inside; --views {self.path} uses them"
            )
            notes.append(Note("photos", self._photos, text))
        return tuple(notes)


def _more(count: int) -> str:
    if count > 1:
        return f"; similar in {plural(count - 1, 'other scan')}"
    return ""


class _Scan(PointStream):
    """A scan's points, at world = rotation @ x + translation."""

    def __init__(self, path: Path, header: Any, number: int) -> None:
        self.path = path
        self.count = header.point_count
        self._number = number
        self.fields = tuple(header.point_fields)
        self._names = names = set(self.fields)
        place = next(
            (fields for fields in (_CARTESIAN, _SPHERICAL) if names.issuperset(fields)), None
        )
        if place is None:
            what = "has no positions (cartesianX, cartesianY, cartesianZ)"
            raise InputError(what, index=number, item="scan")
        self._place = place
        self._rotation = rotation_matrices(np.asarray(header.rotation, float)[None])[0]
        self._translation = np.asarray(header.translation, float)
        choices = [fields for fields in (_COLORS, _INTENSITY) if names.issuperset(fields)]
        self._color, sample = telling(choices, self._sampled)
        limits = _limits(header, "intensity") if self._color == _INTENSITY else None
        scales = full_scales(np.dtype(float))
        super().__init__(path, self.count, sample, scales, limits)
        self.axes = "RFU"
        if self.channels == 3 and (stated := _limits(header, "colorRed")):
            dark, full = self._range
            white = next((scale for scale in scales if scale >= stated[1]), full)
            self._range = dark, full if full == 255 or full > white else white

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
                buffers.append(
                    libe57.SourceDestBuffer(file.image_file, name, values, rows, True, True)
                )
            reader = file.get_header(self._number)["points"].reader(buffers)
            at = 0
            while got := reader.read():
                skipped = min(got, max(0, start - at))
                at += got
                if skipped < got:
                    yield self._points({name: v[skipped:got] for name, v in fields.items()})
            reader.close()
        if at < self.count:
            text = f"scan {self._number} has {at:,} of {self.count:,} points"
            raise InputError(text, path=self.path)

    def _points(self, fields: dict[str, Float]) -> MarkedPoints:
        a, b, c = (fields[name] for name in self._place)
        own = a, b, c
        if self._place == _SPHERICAL:  # range, azimuth, elevation
            across = a * np.cos(c)
            own = across * np.cos(b), across * np.sin(b), a * np.sin(c)
        positions = np.stack(own, axis=1) @ self._rotation.T + self._translation
        names = self._color + self.also
        colors = np.zeros((len(positions), len(names)), np.float32)
        for channel, name in enumerate(names):
            colors[:, channel] = fields[name]
        noise = ~np.any(own, axis=0)  # relative to the scanner: no return
        for name in self._marks():
            if name in _UNSEEN.get(self._color, ()):
                colors[fields[name] != 0, : len(self._color)] = 0
            else:
                noise |= fields[name] != 0
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
    count = root["images2D"].childCount() if root.isDefined("images2D") else 0
    return [root["images2D"][i] for i in range(count)]


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
    if not frames:
        raise InputError(f"none of its {plural(len(nodes), 'photo')} can be used: {left_out[0]}")
    first = left_out[0] if left_out else ""
    text = f"{plural(len(left_out), 'photo')} of {len(nodes)} left out: {first}"
    return Listed(path, frames).noted("left_out_photos", len(left_out), text)


def _frame(number: int, node: Any, folder: Path) -> Frame | str:
    """Return the view of a photo, or the reason why it cannot be used."""
    named = str(node["name"].value()) if node.isDefined("name") else ""
    plain = _NO_NAME.sub("_", named).strip("_.")[:80]
    stem = f"{number:04d}_{plain}" if plain else f"{number:04d}"
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
    if shown.isDefined("imageMask"):
        mask = _copied(shown["imageMask"], folder / "masks" / f"{stem}.png")
    else:
        mask = None
    world_from_camera = _pose(node["pose"]) @ (_PANORAMA_AXES if kind == "spherical" else FLIP)
    return Frame(
        photo.name, invert_pose(world_from_camera), lens, photo, mask=mask, listed=photo.name
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
