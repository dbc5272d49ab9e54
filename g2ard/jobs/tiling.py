"""When a scene is processed in tiles, what size of tiles fits into memory, and which options tiles reject."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.errors import InputError, require
from g2ard.io import open_stream
from g2ard.io.detect import MANIFEST, kind
from g2ard.io.tile_store import TileStore, row_width

if TYPE_CHECKING:
    from g2ard.jobs.budget import Budget
    from g2ard.jobs.distill_options import DistillOptions

_SMALLEST_ROW = 4
"""Least bytes per Gaussian in a file: a smaller file is known to be small without opening it."""

WHOLE_TIMES, LEVELS_TIMES = 3.6, 7.0
"""Memory in one piece as a multiple of the scene's arrays: simplification, and levels without recovery."""

_TASK_BYTES, _ROW_BYTES, _ROW_TIMES = 200_000_000, 290, 0.8
"""Peak memory of a task: bytes of the program, bytes per Gaussian (halo included), and a multiple of its
arrays. Measured: 1.95 GB for 5.5 million of SH 0, 0.98 GB for 1.8 million of SH 3
(`docs/benchmarks.md`)."""

RECOVERY_TIMES = 1.5
"""Memory of recovering or scoring a tile, renders included, relative to merging it."""

_LEAST_ROWS = 1000
"""Rows of the smallest tiles that messages advise."""

_HALO_TIMES = 1.5
"""Rows of the largest tile, halo included, relative to `--tile-rows`, at most."""

_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmMgGtT]?)(?:i?[bB])?")


@dataclass(frozen=True)
class Tiling:
    """Options for scenes larger than memory. Only `tile_rows` affects the result.

    Args:
        tile_rows: a scene of more Gaussians is processed in tiles of at most this many; None is 5,000,000.
        memory: bytes for all workers together; None is most of the machine's.
        workers: processes at once; None is as many as cores and memory allow.
        cores: cores that workers share; None is all.
        scheduler: address of a Dask cluster, see `g2ard.tiles.executor.executor`.
        folder: for tiles and the files of tasks.
        keep: whether the folder stays after success.
    """

    tile_rows: int | None = None
    memory: int | None = None
    workers: int | None = None
    cores: int | None = None
    scheduler: str | None = None
    folder: Path | None = None
    keep: bool = True

    @property
    def most_rows(self) -> int:
        """Largest number of Gaussians per tile."""
        from g2ard.tiles.ingest import TILE_ROWS

        return self.tile_rows or TILE_ROWS

    @property
    def usable_cores(self) -> int:
        """Number of cores that workers share."""
        if self.cores:
            return self.cores
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    @property
    def usable_memory(self) -> int:
        """Bytes for all workers together."""
        return self.memory or int(0.8 * _physical_memory())

    @property
    def memory_limit(self) -> str:
        """`usable_memory` with its origin, as text for messages."""
        size = amount(self.usable_memory)
        return f"--memory {size}" if self.memory else f"the {size} used of the machine's memory"


def _physical_memory() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 8_000_000_000


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
        return _TASK_BYTES + int(self.times * rows * (_ROW_BYTES + _ROW_TIMES * self.row_bytes))

    def advice(self, memory: int, most: int) -> str:
        """Return a tile size, at most `most`, that fits into `memory` bytes, or the least that tiles take.

        >>> TileMemory(60_000, 56).advice(210_000_000, 30_000)
        '--tile-rows 19,000 takes less'
        >>> TileMemory(60_000, 56).advice(100_000_000, 30_000)
        'the least that tiles take is about 201 MB, with --tile-rows 1,000'
        """
        from g2ard.tiles.ingest import MOST_TILES

        a_row = _HALO_TIMES * (self.of(1) - _TASK_BYTES)
        least = min(max(_LEAST_ROWS, -(-self.count // MOST_TILES)), most)
        rows = _rounded_down(min((memory - _TASK_BYTES) / a_row, most))
        if rows >= least:
            return f"{cut_into(self.folder, rows)} takes less"
        need = amount(self.of(round(_HALO_TIMES * least)), up=True)
        return f"the least that tiles take is about {need}, with {cut_into(self.folder, least)}"


def cut_into(folder: Path | None, rows: int) -> str:
    """Return what to type for tiles of this many rows: an option, or a command if a folder holds tiles."""
    return (
        f"--tile-rows {rows:,}" if folder is None else f"`g2ard ingest {folder} -o DIR --tile-rows {rows:,}`"
    )


def amount(size: float, *, up: bool = False) -> str:
    """Format bytes: whole megabytes below a gigabyte, at most two decimals above.

    >>> amount(207_100_000), amount(207_100_000, up=True), amount(1_500_000_000), amount(20_349_000_000)
    ('207 MB', '208 MB', '1.5 GB', '20.34 GB')
    """
    rounded = math.ceil if up else math.floor
    if (megabytes := rounded(size / 1e6)) < 1000:
        return f"{megabytes} MB"
    return f"{rounded(size / 1e7) / 100:g} GB"


def _rounded_down(value: float) -> int:
    """Round down to two digits."""
    step = 10 ** max(0, len(str(int(max(0, value)))) - 2)
    return int(max(0, value) // step * step)


def bytes_of(text: str) -> int:
    """Parse a size such as 4GB, 500MB or 2GiB; units are powers of 1000, with an i of 1024.

    >>> bytes_of("4GB"), bytes_of("1.5 gib")
    (4000000000, 1610612736)
    """
    match = _SIZE.fullmatch(text.strip())
    base = 1024 if "i" in text.lower() else 1000
    size = (
        0.0 if match is None else float(match[1]) * base ** ["", "k", "m", "g", "t"].index(match[2].lower())
    )
    require("memory", repr(text), size >= 1e6, "a size such as 4GB or 800MB")
    return int(size)


def is_tiled(scene: Path, tiling: Tiling) -> bool:
    """Return whether a scene is a folder of several tiles or has too many Gaussians for one piece.

    Point clouds are never processed in tiles.
    """
    if (scene / MANIFEST).is_file():
        return len(TileStore.open(scene).tiles) > 1
    if (
        scene.is_file()
        and scene.suffix.lower() != ".json"
        and scene.stat().st_size < _SMALLEST_ROW * tiling.most_rows
    ):
        return False

    return kind(scene) == "splats" and open_stream(scene).count > tiling.most_rows


def check_memory(scene: Path, tiling: Tiling, times: float, tile_times: float = 1.0) -> None:
    """Reject a scene that takes more than `--memory` in one piece.

    Args:
        tiling: with the limit; nothing is checked without one.
        times: memory in one piece relative to the scene's arrays.
        tile_times: memory of a tile relative to merging it.
    """
    if tiling.memory is None:
        return
    stream = open_stream(scene)
    row_bytes = 4 * row_width(stream.sh_degree)
    need = _TASK_BYTES + int(times * stream.count * row_bytes)
    if need > tiling.memory:
        tiles = TileMemory(stream.count, row_bytes, tile_times, _folder_of_tiles(scene))
        raise InputError(
            f"{stream.count:,} Gaussians in one piece take about {amount(need, up=True)}, "
            f"{amount(_TASK_BYTES)} of it the program, more than {tiling.memory_limit}; "
            f"{tiles.advice(tiling.memory, max(1, stream.count // 2))}",
            path=scene,
        )


def workers_for(store: TileStore, tiling: Tiling, times: float = 1.0) -> int:
    """Return the number of workers that memory and cores allow.

    Args:
        times: memory of a tile relative to merging it.
    """
    memory = tiling.usable_memory
    largest = max(store.tiles, key=lambda tile: tile.rows + tile.halo)
    rows, most = largest.rows + largest.halo, store.settings.get("tile_rows") or largest.rows
    made_here = tiling.folder is not None and store.folder.parent == tiling.folder
    tiles = TileMemory(store.count, store.row_bytes, times, None if made_here else store.folder)
    need = tiles.of(rows)
    fit = memory // need
    if fit > 1:  # several workers are processes beside this one
        fit = max(1, (memory - _TASK_BYTES) // need)
    if fit < 1:
        raise InputError(
            f"a tile of {largest.rows:,} Gaussians and {largest.halo:,} around it takes about "
            f"{amount(need, up=True)}, {amount(_TASK_BYTES)} of it the program, more than "
            f"{tiling.memory_limit}; {tiles.advice(memory, most)}"
        )
    if tiling.workers is not None and tiling.scheduler is None and tiling.workers > fit:
        raise InputError(
            f"--workers {tiling.workers} take about {amount(tiling.workers * need, up=True)}, more than "
            f"{tiling.memory_limit}; --workers {fit} fit"
        )
    return tiling.workers or max(1, min(fit, tiling.usable_cores))


def _folder_of_tiles(scene: Path) -> Path | None:
    return scene if (scene / MANIFEST).is_file() else None


def refuse_whole(scene: Path, options: Sequence[str]) -> None:
    """Reject options that need the whole scene in memory."""
    if not options:
        return

    one = cut_into(_folder_of_tiles(scene), open_stream(scene).count)
    takes = "needs" if len(options) == 1 else "need"
    raise InputError(
        f"{' and '.join(options)} {takes} the whole scene in memory, but it is processed in tiles; "
        f"use {one} for one piece",
        path=scene,
    )


def whole_budgets(budgets: Sequence[Budget]) -> list[str]:
    """Return the budgets that need the whole scene, as options: bytes and qualities.

    >>> from g2ard.jobs.budget import Budget
    >>> whole_budgets([Budget(fit="web")]), whole_budgets([Budget(min_psnr=30, min_ssim=0.9)])
    ([], ['--min-psnr 30', '--min-ssim 0.9'])
    """
    given = {
        name: value
        for budget in budgets
        for name, value in (
            ("--fit", budget.fit if budget.bytes else None),
            ("--min-psnr", budget.min_psnr),
            ("--min-ssim", budget.min_ssim),
        )
    }
    return [f"{name} {value}" for name, value in given.items() if value is not None]


def whole_method(method: str | None, preset: str | None) -> list[str]:
    """Return the option for a method other than `default`, or the preset that sets it."""
    if preset is not None and preset.startswith("paper"):
        return [f"--preset {preset}"]
    return [f"--method {method}"] if method not in (None, "default") else []


def whole_options(options: DistillOptions) -> list[str]:
    """Return the options of a distillation that need the whole scene.

    Tiles learn from renders, so `photos=False` is fine.
    """
    if options.preset.startswith("paper"):
        return whole_method(None, options.preset)
    config = options.config
    given = {
        "--set select.views_count": config.select.views_count is not None,
        "--schedule paper": config.recover.schedule.round_steps > 0,
        "--clean": options.clean,
        "--photos": bool(options.photos),
        "--set select.reselect": config.select.reselect,
        "--recovery-time": config.recover.recovery_time is not None,
        "--device cuda": config.recover.engine != "fused",
    }
    return whole_method(config.simplify.method, None) + [name for name, there in given.items() if there]
