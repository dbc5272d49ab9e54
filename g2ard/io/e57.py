"""Reader for laser scans, .e57, with pye57."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import G2ardError, InputError, missing
from g2ard.io.limits import check_unpacked
from g2ard.io.stream import MarkedPoints, PointStream, from_row, full_scales
from g2ard.io.types import Note
from g2ard.progress import plural
from g2ard.scene.transform import rotation_matrices

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")

_SAMPLE_ROWS = 100_000
"""Points at the beginning of each scan that tell where it is."""


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
        with opened(path) as file:
            self._scans = [_scan(path, file, number) for number in range(file.scan_count)]
            self._photos = posed_photos(file)
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

        with opened(self.path) as file:
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
    """Return the least and the largest intensity of a scan, as its header says, or 0 and 1."""
    if "intensityLimits" not in header.scan_fields:
        return 0.0, 1.0
    found = header["intensityLimits"]
    return float(found["intensityMinimum"].value()), float(found["intensityMaximum"].value())


def image_count(file: Any) -> int:
    """Return the number of images of an open file."""
    root = file.image_file.root()
    return int(root["images2D"].childCount()) if root.isDefined("images2D") else 0


def posed_photos(file: Any) -> int:
    """Return the number of images of an open file that have a pose."""
    images = range(image_count(file))
    return sum(file.image_file.root()["images2D"][i].isDefined("pose") for i in images)


@contextmanager
def opened(path: Path) -> Iterator[Any]:
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
