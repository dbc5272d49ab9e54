"""When a scene is processed in tiles, and how."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from g2ard.io.source import Source
from g2ard.system.memory import usable_memory
from g2ard.tiles.ingest import TILE_ROWS

_LEAST_ROW_BYTES = 4
"""Least bytes per Gaussian in a file: a smaller file is known to be small without opening it."""


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
        overwrite: replace tiles in it that are damaged, or others that the user keeps there.
    """

    tile_rows: int | None = None
    memory: int | None = None
    workers: int | None = None
    cores: int | None = None
    scheduler: str | None = None
    folder: Path = Path(".tiles")
    keep: bool = True
    overwrite: bool = False

    @property
    def most_rows(self) -> int:
        """Largest number of Gaussians per tile."""
        return self.tile_rows or TILE_ROWS

    @property
    def usable_cores(self) -> int:
        """Number of cores that workers share."""
        if self.cores:
            return self.cores
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1

    @property
    def usable_memory(self) -> int:
        """Bytes for all workers together."""
        return self.memory or int(0.8 * usable_memory())


def cut_into(folder: Path | None, rows: int) -> str:
    """Return what to type for tiles of this many rows: an option, or a command if a folder holds tiles."""
    if folder is None:
        return f"--tile-rows {rows:,}"
    return f"`g2ard ingest {folder} -o DIR --tile-rows {rows:,}`"


def is_tiled(source: Source, tiling: Tiling) -> bool:
    """Return whether a scene or point cloud is a folder of several tiles or is too large for one piece."""
    most = tiling.most_rows
    files = [source.file, *(other.file for other in source.others)]
    known = all(file.is_file() and file.suffix.lower() != ".json" for file in files)
    if known and sum(file.stat().st_size for file in files) < _LEAST_ROW_BYTES * most:
        return False
    if source.kind == "splats" and source.store is not None:
        return len(source.store.tiles) > 1
    return source.kind != "views" and source.count > most
