"""Memory of scenes in one piece and in tiles, and the workers that fit, from counts alone."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from g2ard.errors import InputError, require
from g2ard.io.source import Source
from g2ard.io.stream import PointStream, SceneStream
from g2ard.io.tile_store import TileStore, row_width
from g2ard.jobs.tile_options import Tiling, cut_into

_WHOLE_BYTES = 215
"""Bytes per Gaussian of simplification in one piece besides its arrays. Measured with the next: 1.26 GB for 4.2
million of SH 0, 2.47 GB for 5 million of SH 3."""

_WHOLE_TIMES = 1.2
"""Further memory as a multiple of the scene's arrays."""

LEVELS_TIMES = 7.0
"""Memory of levels without recovery in one piece as a multiple of the scene's arrays."""

_TASK_BYTES = 200_000_000
"""Bytes of a task's program. The peak of a task, measured: 1.95 GB for 5.5 million Gaussians of SH 0, 0.98 GB
for 1.8 million of SH 3 (`docs/benchmarks.md`)."""

_ROW_BYTES = 290
"""Bytes of a task per Gaussian, halo included."""

_ROW_TIMES = 0.8
"""Further memory of a task as a multiple of its arrays."""

_VISIBILITY_BYTES = 450
"""Bytes per Gaussian of measuring a tile's visibility, halo included: 2.2 GB for 4.4 million, whatever their SH."""

RECOVERY_TIMES = 1.5
"""Memory of recovering or scoring a tile, renders included, relative to merging it."""

WRITING_TIMES = 0.1
"""Memory of writing a tile relative to merging it: its rows come in parts."""

_LIFTING_TIMES = 1.7
"""Memory of lifting a tile's points relative to merging it: 550 bytes per point."""

_DISK_COPIES = 2
"""Copies of a scene on the disk: its tiles with their halos, and the files of tasks. Points have one more."""

_LEAST_ROWS = 1000
"""Rows of the smallest tiles that messages advise."""

_HALO_TIMES = 1.5
"""Rows of the largest tile, halo included, relative to `--tile-rows`, at most."""

_MEMORY_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmMgGtT]?)(?:i?[bB])?")


@dataclass(frozen=True)
class TileMemory:
    """Estimate of the memory that tiles of a scene take.

    Args:
        times: memory relative to merging a tile.
        folder: folder of existing tiles, which `--tile-rows` cannot change; None if it can.
    """

    count: int
    row_bytes: float
    times: float = 1.0
    folder: Path | None = None

    def of(self, rows: int) -> int:
        """Return the bytes of a task on this many rows, halo included."""
        a_row = self.times * (_ROW_BYTES + _ROW_TIMES * self.row_bytes)
        if self.times >= 1:  # writing tiles measures nothing
            a_row = max(a_row, _VISIBILITY_BYTES)
        return _TASK_BYTES + int(rows * a_row)

    def advice(self, memory: int, most: int) -> str:
        """Return a tile size, at most `most`, that fits into `memory` bytes, or the least that tiles take.

        >>> TileMemory(60_000, 56).advice(210_000_000, 30_000)
        '--tile-rows 14,000 takes less'
        >>> TileMemory(60_000, 56).advice(100_000_000, 30_000)
        'the least that tiles take is about 201 MB, with --tile-rows 1,000'
        """
        from g2ard.tiles.ingest import MOST_TILES

        a_row = _HALO_TIMES * (self.of(1) - _TASK_BYTES)
        least = min(max(_LEAST_ROWS, -(-self.count // MOST_TILES)), most)
        rows = _round_down(min((memory - _TASK_BYTES) / a_row, most))
        if rows >= least:
            return f"{cut_into(self.folder, rows)} takes less"
        need = format_bytes(self.of(round(_HALO_TIMES * least)), ceil=True)
        return f"the least that tiles take is about {need}, with {cut_into(self.folder, least)}"


def format_bytes(size: float, *, ceil: bool = False) -> str:
    """Format bytes: whole megabytes below a gigabyte, at most two decimals above.

    >>> [format_bytes(size) for size in (207_100_000, 1_500_000_000, 20_349_000_000)]
    ['207 MB', '1.5 GB', '20.34 GB']
    >>> format_bytes(207_100_000, ceil=True)
    '208 MB'
    """
    rounded = math.ceil if ceil else math.floor
    if (megabytes := rounded(size / 1e6)) < 1000:
        return f"{megabytes} MB"
    return f"{rounded(size / 1e7) / 100:g} GB"


def _round_down(value: float) -> int:
    """Round down to two digits."""
    step = 10 ** max(0, len(str(int(max(0, value)))) - 2)
    return int(max(0, value) // step * step)


def _describe_limit(tiling: Tiling) -> str:
    size = format_bytes(tiling.usable_memory)
    return f"--memory {size}" if tiling.memory else f"the {size} used of the machine's memory"


def parse_bytes(text: str) -> int:
    """Parse a size such as 4GB, 500MB or 2GiB; units are powers of 1000, with an i of 1024.

    >>> parse_bytes("4GB"), parse_bytes("1.5 gib")
    (4000000000, 1610612736)
    """
    match = _MEMORY_SIZE.fullmatch(text.strip())
    base = 1024 if "i" in text.lower() else 1000
    size = (
        0.0
        if match is None
        else float(match[1]) * base ** ["", "k", "m", "g", "t"].index(match[2].lower())
    )
    require("memory", repr(text), size >= 1e6, "a size such as 4GB or 800MB")
    return int(size)


def whole_bytes(count: int, row_bytes: float) -> int:
    """Return the memory of simplifying a scene in one piece, program and views excluded."""
    return int(count * (_WHOLE_BYTES + _WHOLE_TIMES * row_bytes))


def check_whole_memory(
    source: Source,
    tiling: Tiling,
    times: float | None = None,
    tile_times: float = 1.0,
) -> None:
    """Reject a scene that takes more than `--memory` in one piece.

    Args:
        tiling: with the limit; nothing is checked without one.
        times: memory in one piece relative to the scene's arrays; None means that of simplification.
        tile_times: memory of a tile relative to merging it.
    """
    if tiling.memory is None:
        return
    stream = source.scene
    row_bytes = 4 * row_width(stream.sh_degree)
    if times is None:
        need = whole_bytes(stream.count, row_bytes)
    else:
        need = int(times * stream.count * row_bytes)
    need += _TASK_BYTES
    if need > tiling.memory:
        tiles = TileMemory(
            stream.count, row_bytes, tile_times, None if source.store is None else source.path
        )
        raise InputError(
            f"{stream.count:,} Gaussians in one piece take about {format_bytes(need, ceil=True)}, "
            f"{format_bytes(_TASK_BYTES)} of it the program, more than {_describe_limit(tiling)}; "
            f"{tiles.advice(tiling.memory, max(1, stream.count // 2))}",
            path=source.path,
        )


@dataclass(frozen=True)
class TilePlan:
    """Tiles of a scene, and the workers that process them.

    Args:
        count: Gaussians of the scene.
        tiles: number of tiles; expected, if they are not written yet.
        bytes: peak memory of all processes together.
        memory: bytes that they may take.
        disk: bytes of the tiles and of the files of their tasks.
    """

    count: int
    tiles: int
    workers: int
    bytes: int
    memory: int
    disk: int


def plan_tiles(
    scene: TileStore | SceneStream | PointStream, tiling: Tiling, times: float = 1.0
) -> TilePlan:
    """Return the tiles of a scene, written or not, and the number of workers that memory and cores allow.

    Args:
        scene: or a point cloud, which is lifted to tiles.
        times: memory of a tile relative to merging it.
    """
    from g2ard.tiles.writer import expected_tiles

    memory = tiling.usable_memory
    count = scene.count
    folder = None
    if isinstance(scene, TileStore):
        number = len(scene.tiles)
        most = scene.settings.get("tile_rows")
        largest = max(scene.tiles, key=lambda tile: tile.rows + tile.halo)
        rows = int(largest.rows)
        halo = int(largest.halo)
        folder = None if scene.folder.parent == tiling.folder else scene.folder
    else:
        times = max(times, _LIFTING_TIMES) if isinstance(scene, PointStream) else times
        number = expected_tiles(count, tiling.most_rows)
        most = tiling.most_rows
        rows = -(-count // number)
        halo = round((_HALO_TIMES - 1) * rows)
    row_bytes = 4 * row_width(0 if isinstance(scene, PointStream) else scene.sh_degree)
    tiles = TileMemory(count, row_bytes, times, folder)
    need = tiles.of(rows + halo)
    fit = memory // need
    if fit > 1:  # several workers are processes beside this one
        fit = max(1, (memory - _TASK_BYTES) // need)
    if fit < 1:
        raise InputError(
            f"a tile of {rows:,} Gaussians and {halo:,} around it takes about "
            f"{format_bytes(need, ceil=True)}, {format_bytes(_TASK_BYTES)} of it the program, more than "
            f"{_describe_limit(tiling)}; {tiles.advice(memory, most or rows)}"
        )
    if tiling.workers is not None and tiling.scheduler is None and tiling.workers > fit:
        raise InputError(
            f"--workers {tiling.workers} take about {format_bytes(tiling.workers * need, ceil=True)}, more "
            f"than {_describe_limit(tiling)}; --workers {fit} fit"
        )
    workers = tiling.workers or max(1, min(fit, tiling.usable_cores))
    return TilePlan(
        count,
        number,
        workers,
        workers * need + (_TASK_BYTES if workers > 1 else 0),
        memory,
        (_DISK_COPIES + isinstance(scene, PointStream)) * count * row_bytes,
    )
