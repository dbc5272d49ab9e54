"""What memory tiles take, and which tiles fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["RECOVERY_TIMES", "TASK_BYTES", "TileMemory", "amount", "cut_into"]

TASK_BYTES, _ROW_BYTES, _ROW_TIMES = 200_000_000, 290, 0.8
"""Of a task at its peak: of the program, and of a tile's Gaussians, halo included, so many and so many times
what their arrays take. Measured are 1.95 GB for 5.5 million of SH 0, and 0.98 GB for 1.8 million of SH 3
(`benchmarks/record/tiles.md`)."""

RECOVERY_TIMES = 1.5
"""Memory of a tile's recovery or scores, renders included, over that of merging it."""

_LEAST_ROWS = 1000
"""Rows of the smallest tiles that are advised."""


@dataclass(frozen=True)
class TileMemory:
    """What tiles of a scene take.

    Args:
        count: Gaussians of the scene.
        row_bytes: of a Gaussian's arrays.
        times: over what merging a tile takes.
        folder: of tiles that `--tile-rows` cannot cut anew; None where it can.
    """

    count: int
    row_bytes: float
    times: float = 1.0
    folder: Path | None = None

    def of(self, rows: int) -> int:
        """Bytes of a task on so many rows, halo included."""
        return TASK_BYTES + int(self.times * rows * (_ROW_BYTES + _ROW_TIMES * self.row_bytes))

    def advice(self, memory: int, most: int, largest: Callable[[int], int]) -> str:
        """Which tiles take no more than `memory` bytes; where none do, the least that tiles take.

        Args:
            memory: bytes.
            most: rows of the largest tiles that would be another answer.
            largest: of `--tile-rows`: rows of the largest tile, halo included (`g2ard.tiles.pour.foretold`).

        >>> TileMemory(60_000, 56).advice(210_000_000, 30_000, lambda rows: round(1.3 * rows))
        '--tile-rows 22,000 takes less'
        >>> TileMemory(60_000, 56).advice(100_000_000, 30_000, lambda rows: round(1.3 * rows))
        'the least that tiles take is about 201 MB, with --tile-rows 1,000'
        """
        from g2ard.tiles.ingest import MOST_TILES

        a_row = self.of(1) - TASK_BYTES
        least = min(max(_LEAST_ROWS, -(-self.count // MOST_TILES)), most)
        rows = _rounded_down(min((memory - TASK_BYTES) / a_row, most))
        while rows >= least:
            if self.of(held := largest(rows)) <= memory:
                return f"{cut_into(self.folder, rows)} takes less"
            rows = _rounded_down(min(rows * (memory - TASK_BYTES) / a_row / held, rows - 1))
        need = amount(self.of(largest(least)), up=True)
        return f"the least that tiles take is about {need}, with {cut_into(self.folder, least)}"


def cut_into(folder: Path | None, rows: int) -> str:
    """What is typed for tiles of so many rows: the option, or where a folder holds tiles the command."""
    return (
        f"--tile-rows {rows:,}" if folder is None else f"`g2ard ingest {folder} -o DIR --tile-rows {rows:,}`"
    )


def amount(size: float, *, up: bool = False) -> str:
    """Bytes in words; below a gigabyte whole megabytes, above it two digits after the point.

    >>> amount(207_100_000), amount(207_100_000, up=True), amount(1_500_000_000), amount(20_349_000_000)
    ('207 MB', '208 MB', '1.5 GB', '20.34 GB')
    """
    rounded = math.ceil if up else math.floor
    if (megabytes := rounded(size / 1e6)) < 1000:
        return f"{megabytes} MB"
    return f"{rounded(size / 1e7) / 100:g} GB"


def _rounded_down(value: float) -> int:
    """To two digits."""
    step = 10 ** max(0, len(str(int(max(0, value)))) - 2)
    return int(max(0, value) // step * step)
