"""Reader for LiDAR point clouds, .las and .laz, with laspy and lazrs."""

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.errors import InputError, damaged
from g2ard.io.judge import full_scales
from g2ard.io.paths import about, check_unpacked
from g2ard.io.stream import MarkedPoints, Names, PointStream, telling
from g2ard.io.types import Note

_LARGEST_CHUNK = 1 << 30
"""Largest chunk, in bytes of unpacked points, of a file with fewer points than a chunk holds."""


_SAMPLES = 20  # runs of points that tell where a file's points are

_SAMPLE_ROWS = 5000  # points of each of these runs

_NOISE = (7, 18)  # classes of low and high noise


_NOTHING = (
    np.zeros((0, 3)),
    np.zeros((0, 0), np.float32),
    np.zeros(0, bool),
)
_RGB = ("red", "green", "blue")


class Stream(PointStream):
    """Positions and colours or intensities, without points of the classes of noise and withheld ones.

    One chunk of a .laz is unpacked at a time.
    """

    def __init__(self, path: Path) -> None:
        with _opened(path) as reader:
            count = reader.header.point_count
            header = reader.header
            self.fields = tuple(header.point_format.dimension_names)
            fields = set(self.fields)
            choices = list(filter(fields.issuperset, (_RGB, ("intensity",))))
            runs = []
            starts = set[int]()
            if count:
                starts = {count * part // _SAMPLES for part in range(_SAMPLES)}
            for first in sorted(starts):
                reader.seek(first)
                runs.append(reader.read_points(min(_SAMPLE_ROWS, count - first)))
            notes = list[Note]()
            if reader.recovered:
                text = f"the header states 0 points; {count:,} follow, and are read"
                notes.append(Note("header_count", count, text))
            system, metres_per_unit = _map_of(header)

        def sampled(color: Names) -> list[MarkedPoints]:
            return [_points(run, color) for run in runs] or [_NOTHING]

        self._color, sample = telling(choices, sampled)
        scales = full_scales(np.dtype(np.uint16))
        super().__init__(
            path,
            count,
            sample,
            scales,
            notes=tuple(notes),
        )
        self.system = system
        self.axes = "RFU"
        self.metres_per_unit = metres_per_unit
        if choices[0] != _RGB:
            number = header.point_format.id
            self.lack = f"point format {number} has no colours ('red', 'green', 'blue'), and intensities are equal"

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        with _opened(self.path) as reader:
            if start:
                reader.seek(start)
            for first in range(start, self.count, rows):
                wanted = min(rows, self.count - first)
                las = reader.read_points(wanted)
                if len(las) < wanted:
                    _check_count(first + len(las), self.count)
                yield _points(las, self._color + self.also)


def _points(las: Any, color: Names) -> MarkedPoints:
    places = [np.asarray(las[axis], float) for axis in "xyz"]
    columns = [np.asarray(las[name], np.float32) for name in color]
    noise = np.isin(las["classification"], _NOISE)
    noise |= np.asarray(las["withheld"], bool)
    return np.stack(places, axis=1), np.stack(columns, axis=1), noise


# code of a unit of length in GeoTIFF keys → its metres
_UNITS = {
    9001: 1.0,
    9002: 0.3048,
    9003: 1200 / 3937,
}


def _map_of(header: Any) -> tuple[str | None, float | None]:
    """Return the map system that a header states, by EPSG code or name, and the metres of its unit."""
    systems = []
    units = []
    for record in header.vlrs:
        if record.record_id == 34735 and hasattr(record, "geo_keys"):
            codes = {key.id: key.value_offset for key in record.geo_keys}
            systems += [
                f"EPSG:{codes[key]}" for key in (3072, 2048) if 0 < codes.get(key, 0) < 32767
            ]
            if codes.get(3076) in _UNITS:
                units.append(_UNITS[codes[3076]])
        if record.record_id == 2112 and hasattr(record, "string"):
            for name, rest in re.findall(
                r'PROJ(?:CS|CRS)\["([^"]+)"(.*)',
                record.string,
                re.DOTALL,
            ):
                own = re.split(r"VERT_?C(?:S|RS)\[", rest)[0]
                code = re.search(r'(?:AUTHORITY|ID)\["EPSG",\s*"?(\d+)"?\][\]\s,\0]*$', own)
                systems.append(f"EPSG:{code[1]}" if code else name)
                units += map(float, re.findall(r'UNIT\["[^"]*",\s*([0-9.eE+-]+)', own)[-1:])
    return next(iter(systems), None), next(iter(units), None)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file with laspy, after checking its header against the file's size."""
    import laspy

    with about(path):
        _check_records(path)
        try:
            with laspy.open(path) as reader:
                header = reader.header
                reader.recovered = _recovered(path, header)
                scales = header.scales
                offsets = header.offsets
                if not np.isfinite(scales).all() or not scales.all():
                    raise damaged(f"broken header: its scales are {scales.tolist()}")
                if not np.isfinite(offsets).all():
                    raise damaged(f"broken header: its offsets are {offsets.tolist()}")
                if header.are_points_compressed:
                    _check_chunk_table(path, header.offset_to_point_data, header.point_count)
                    _check_chunks(path, header)
                else:
                    room = max(0, path.stat().st_size - header.offset_to_point_data)
                    _check_count(room // header.point_format.size, header.point_count)
                yield reader
        except (InputError, GeneratorExit):
            raise
        except BaseException as error:
            # laspy raises any exception for damaged files, and lazrs may panic
            kind = type(error).__name__
            if not isinstance(error, Exception) and kind != "PanicException":
                raise
            raise InputError(f"cannot be read as LAS: {str(error) or kind}") from error


def _number(path: Path, at: int, kind: str) -> Any:
    """Return the value of a type of `struct` at a byte; bytes past the end of the file are 0."""
    size = struct.calcsize(kind)
    with path.open("rb") as file:
        file.seek(at)
        return struct.unpack(kind, file.read(size).ljust(size, b"\0"))[0]


def _recovered(path: Path, header: Any) -> bool:
    """Set a count of points of 0 to the number that follow, and return whether there are any."""
    if header.point_count:
        return False
    minor = _number(path, 25, "<B")
    legacy = _number(path, 107, "<I")
    extended = _number(path, 235, "<Q")
    end = path.stat().st_size
    if minor >= 4 and header.offset_to_point_data < extended < end:
        end = extended
    room = max(0, end - header.offset_to_point_data)
    if header.are_points_compressed:
        if not legacy and room > 64:  # bytes of an empty chunk table, and some
            raise damaged("broken header: it states 0 points, and compressed ones follow")
        header.point_count = legacy
    else:
        header.point_count = room // header.point_format.size
    return bool(header.point_count)


def _check_records(path: Path) -> None:
    """Check the number of variable-length records against the file's size, since laspy tries to read all."""
    begin = _number(path, 0, "4s")
    if begin != b"LASF":
        raise InputError(f"cannot be read as LAS (begins with {begin!r})")
    points_at = _number(path, 96, "<I")
    records = _number(path, 100, "<I")
    extended = 0
    if _number(path, 25, "<B") >= 4:
        extended = _number(path, 243, "<I")
    size = path.stat().st_size
    if points_at > size:
        raise damaged(f"truncated: points begin at byte {points_at:,} of {size:,}")
    if records * 54 > points_at or extended * 60 > size:
        raise damaged(f"broken header: {records + extended:,} variable-length records")


def _check_count(there: int, promised: int) -> None:
    if there < promised:
        raise damaged(f"truncated: {there:,} of {promised:,} points")


def _check_chunk_table(path: Path, points_at: int, promised: int) -> None:
    """Check the number of chunks against points and bytes, since lazrs aborts when out of memory."""
    table = _number(path, points_at, "<q")
    size = path.stat().st_size
    if table == -1:  # streamed file: the offset is at its end
        table = _number(path, size - 8, "<q")
    if not points_at < table <= size - 8:
        raise damaged("truncated: the chunk table is cut off")
    chunks = _number(path, table + 4, "<I")
    if chunks > max(promised, 1):
        raise damaged(f"broken chunk table: {chunks:,} chunks for {promised:,} points")
    if chunks > table - points_at:
        raise damaged(f"broken chunk table: {chunks:,} chunks in {table - points_at:,} bytes")


def _check_chunks(path: Path, header: Any) -> None:
    """Check the sizes of chunks against the file's size, since lazrs aborts when out of memory."""
    import lazrs

    records = header.vlrs.get("LasZipVlr")
    if not records:
        raise damaged("broken header: the LASzip record is missing")
    layout = lazrs.LazVlr(records[0].record_data)
    size = layout.item_size()
    wanted = header.point_format.size
    if size != wanted:
        raise damaged(f"broken header: compressed points of {size} bytes, not {wanted}")
    if not layout.uses_variable_size_chunks():
        chunk = layout.chunk_size()
        if not 0 < chunk * size <= max(_LARGEST_CHUNK, header.point_count * size):
            raise damaged(f"broken header: chunks of {chunk:,} points")
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        table = lazrs.read_chunk_table(file, layout)
    there = path.stat().st_size
    sizes = [packed for _, packed in table]
    taken = sum(sizes)
    if min(sizes, default=0) < 0 or taken > there - header.offset_to_point_data:
        raise damaged(f"broken chunk table: chunks of {taken:,} bytes")
    room = sum(points for points, _ in table)
    if room < header.point_count:
        raise damaged(f"truncated: at most {room:,} of {header.point_count:,} points")
    check_unpacked(there, header.point_count * size)
