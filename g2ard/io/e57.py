"""Reader for laser scans, .e57, with pye57: their points, and their photos as views."""

import hashlib
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import G2ardError, InputError, missing
from g2ard.io.atomic import atomic_output
from g2ard.io.paths import check_unpacked
from g2ard.io.photos import Frame, Lens, Listed, inverse, posed
from g2ard.io.stream import MarkedPoints, PointStream, from_row, full_scales
from g2ard.io.transforms import FLIP
from g2ard.io.types import Note
from g2ard.progress import plural
from g2ard.scene.lenses import PhotoLens
from g2ard.scene.transform import rotation_matrices

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_SAMPLE_ROWS = 100_000  # points at the beginning of each scan that tell where it is

_PANORAMA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""OpenCV's camera axes in those of a panorama, whose middle is along x, with z up."""

_FULL_CIRCLE = 0.01  # largest relative difference of a panorama's aspect from 2:1
_SUFFIXES = {"jpegImage": ".jpg", "pngImage": ".png"}
_NO_NAME = re.compile(r"[^\w.-]+")


@dataclass(frozen=True)
class _Scan:
    """A scan's points: count, fields to read, and pose (world = rotation @ x + translation)."""

    count: int
    place: tuple[str, ...]
    color: tuple[str, ...]
    invalid: tuple[str, ...]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    dark: float
    bright: float


class Stream(PointStream):
    """Points of all scans in the world of their poses, with colours, or grey from intensities.

    Points that a scan marks as invalid are dropped.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _opened(path) as file:
            self._scans = [_scan(path, file, number) for number in range(file.scan_count)]
            self._photos = sum(node.isDefined("pose") for node in _images(file))
        count = sum(scan.count for scan in self._scans)
        check_unpacked(path, path.stat().st_size, 24 * count)
        sample = [np.zeros((0, 3))]
        for number, scan in enumerate(self._scans):
            for positions, _, noise in self._blocks(number, min(_SAMPLE_ROWS, scan.count), 0):
                sample.append(positions[~noise])
                break
        super().__init__(path, count, np.concatenate(sample), full_scales(np.dtype(np.float64)))

    def header_notes(self) -> tuple[Note, ...]:
        notes = tuple(note for note in super().header_notes() if note.code != "eight_bit_colors")
        if not self._photos:
            return notes
        text = f"{plural(self._photos, 'photo')} with poses inside; --views {self.path} uses them"
        return (*notes, Note("photos", self._photos, text))

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        for number, begin in from_row([scan.count for scan in self._scans], start):
            yield from self._blocks(number, rows, begin)

    def _blocks(self, number: int, rows: int, begin: int) -> Iterator[MarkedPoints]:
        """Yield a scan's points from a row on; those before are read too, since files cannot be searched."""
        scan = self._scans[number]
        if not rows:
            return
        from pye57 import libe57

        with _opened(self.path) as file:
            fields = {name: np.empty(rows) for name in (*scan.place, *scan.color, *scan.invalid)}
            buffers = libe57.VectorSourceDestBuffer()
            for name, values in fields.items():
                buffers.append(libe57.SourceDestBuffer(file.image_file, name, values, rows, True, True))
            reader = file.get_header(number)["points"].reader(buffers)
            at = 0
            while got := reader.read():
                skipped = min(got, max(0, begin - at))
                at += got
                if skipped < got:
                    yield _points(scan, {name: v[skipped:got] for name, v in fields.items()})
            reader.close()
        if at < scan.count:
            raise InputError(f"scan {number} has {at:,} of {scan.count:,} points", path=self.path)


def _points(scan: _Scan, fields: dict[str, NDArray[np.float64]]) -> MarkedPoints:
    a, b, c = (fields[name] for name in scan.place)
    if scan.place == _SPHERICAL:  # range, azimuth, elevation
        a, b, c = a * np.cos(c) * np.cos(b), a * np.cos(c) * np.sin(b), a * np.sin(c)
    positions = np.stack([a, b, c], axis=1) @ scan.rotation.T + scan.translation
    colors = np.stack([fields[name] for name in scan.color], axis=1)
    if len(scan.color) == 1:
        grey = (colors - scan.dark) / max(scan.bright - scan.dark, 1e-300)
        colors = np.repeat(255 * np.clip(grey, 0, 1), 3, axis=1)
    noise = np.zeros(len(positions), bool)
    for name in scan.invalid:
        noise |= fields[name] != 0
    return positions, colors.astype(np.float32), noise


def _scan(path: Path, file: Any, number: int) -> _Scan:
    header = file.get_header(number)
    names = set(header.point_fields)
    place = next((fields for fields in (_CARTESIAN, _SPHERICAL) if names.issuperset(fields)), None)
    if place is None:
        what = "has no positions (cartesianX, cartesianY, cartesianZ)"
        raise InputError(what, path=path, index=number, item="scan")
    color = _COLORS if names.issuperset(_COLORS) else ("intensity",)
    if not names.issuperset(color):
        raise InputError("has neither colours nor intensities", path=path, index=number, item="scan")
    invalid = tuple({"cartesianInvalidState", "sphericalInvalidState"} & names)[:1]
    limits = _limits(header) if color == ("intensity",) else (0.0, 1.0)
    rotation = rotation_matrices(np.asarray(header.rotation, np.float64)[None])[0]
    translation = np.asarray(header.translation, np.float64)
    return _Scan(header.point_count, place, color, invalid, rotation, translation, *limits)


def _limits(header: Any) -> tuple[float, float]:
    if "intensityLimits" not in header.scan_fields:
        return 0.0, 1.0
    found = header["intensityLimits"]
    return float(found["intensityMinimum"].value()), float(found["intensityMaximum"].value())


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


def read(path: Path, images: Path | None = None) -> Listed:
    """Read photos with poses as views; their files are copied to a cache once.

    Panoramas of the full sphere look along x with z up; pinhole images look along −z with y up, as the format
    defines. Others (for reference, cylindrical, without a pose) are left out with a note.
    """
    if images is not None:
        raise InputError("has its photos inside", path=path, hint="leave {images} out")
    with _opened(path) as file:
        nodes = _images(file)
        if not nodes:
            raise InputError("holds no photos", path=path, hint="give views with photos of their own")
        folder = _cache_of(path)
        found = [_frame(path, number, node, folder) for number, node in enumerate(nodes)]
    frames = [frame for frame in found if isinstance(frame, Frame)]
    left_out = [reason for reason in found if isinstance(reason, str)]
    if not frames:
        raise InputError(f"none of its {plural(len(nodes), 'photo')} can be used: {left_out[0]}", path=path)
    text = f"{plural(len(left_out), 'photo')} of {len(nodes)} left out: {left_out[0] if left_out else ''}"
    return Listed(path, frames, notes=(Note("left_out_photos", len(left_out), text),) if left_out else ())


def _frame(path: Path, number: int, node: Any, folder: Path) -> Frame | str:
    """Return the view of a photo, or the reason why it cannot be used."""
    named = str(node["name"].value()) if node.isDefined("name") else ""
    stem = "_".join(filter(None, [f"{number:04d}", _NO_NAME.sub("_", named).strip("_.")[:80]]))
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
            for name in ("focalLength", "pixelWidth", "pixelHeight", "principalPointX", "principalPointY")
        )
        if not (focal > 0 and across > 0 and down > 0):
            return f"{stem} has no focal length"
        lens = Lens.pinhole(size, (focal / across, focal / down), (cx, cy))
    blob = next((name for name in _SUFFIXES if shown.isDefined(name)), None)
    if blob is None:
        return f"{stem} has no JPEG or PNG"
    photo = _copied(shown[blob], folder / f"{stem}{_SUFFIXES[blob]}")
    mask = (
        _copied(shown["imageMask"], folder / "masks" / f"{stem}.png")
        if shown.isDefined("imageMask")
        else None
    )
    world_from_camera = _pose(node["pose"]) @ (_PANORAMA_AXES if kind == "spherical" else FLIP)
    return Frame(photo.name, inverse(world_from_camera), lens, photo, mask=mask, listed=photo.name)


def _pose(node: Any) -> NDArray[np.float64]:
    """Return world_from_photo; parts that are missing are those of the identity."""
    quat, shift = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    if node.isDefined("rotation"):
        quat = [float(node["rotation"][axis].value()) for axis in "wxyz"]
    if node.isDefined("translation"):
        shift = [float(node["translation"][axis].value()) for axis in "xyz"]
    return posed(quat, shift)


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
    usual = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else os.environ.get("XDG_CACHE_HOME")
    base = Path(usual) if usual else Path.home() / ".cache"
    return base / "g2ard" / "e57" / f"{path.stem}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
