"""Rough time and memory of commands, from counts alone.

They serve remaining times, `--dry-run`, `--memory` and the number of workers.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from g2ard.errors import InputError, require
from g2ard.io import open_stream
from g2ard.io.tile_store import TileStore, row_width
from g2ard.jobs.tiling import Tiling, cut_into, folder_of_tiles
from g2ard.jobs.views import FULL_PIXELS
from g2ard.progress import plural
from g2ard.rendering.targets import CACHE_BYTES
from g2ard.scene.samples import evenly_spaced

if TYPE_CHECKING:
    from g2ard.jobs.distill import DistillJob

_USUAL_PIXELS = 480_000
"""Pixels of a generated view."""
_RENDER, _VISIBILITY, _SCORE = 0.03, 0.01, 0.06
"""Seconds per view of these pixels: a target, a small render for visibility, and a score. These and the next
were measured on playbot, 500,000 → 50,000 Gaussians on two cores."""
_SIMPLIFY, _STEP, _REPORT, _PAGE = 1.2 / 500_000, 0.02, 1.5, 1.0
"""Seconds per Gaussian of simplification, per step of recovery, of the report, and of the viewer page."""

_PAGE_BYTES, _PAGE_FULL = 170, 130_000
"""Memory of packing the viewer page: bytes per Gaussian and SH coefficient above degree 0, and the count from
which it stops growing. Measured on playbot: 113 MB for 25,000 Gaussians, 511 for 125,000, 538 for 250,000.
"""
LARGEST_DENSE = 250_000
"""Largest dense scene that view.html shows beside the result: it adds at most 8 MB of SOG at SH degree 2."""
_PROGRAM_BYTES = 90_000_000
"""Bytes of the interpreter and loaded libraries."""
_TRAINER_BYTES = 983
"""Bytes per Gaussian in recovery: parameters, Adam's moments, buffers (`docs/benchmarks.md`)."""

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

_MEMORY_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmMgGtT]?)(?:i?[bB])?")


@dataclass(frozen=True)
class Cost:
    """Rough cost of a distillation.

    Args:
        views: number of views that need a target, including those for scoring.
        pixels: mean of the training views.
        steps: of all recoveries.
        stages: stages to come, in order, with their seconds on two cores.
        bytes: peak memory.
    """

    views: int
    pixels: int
    steps: int
    stages: tuple[tuple[str, float], ...]
    bytes: int

    @property
    def seconds(self) -> float:
        """Seconds of all stages."""
        return sum(seconds for _, seconds in self.stages)


def cost_of(job: DistillJob, count: int, *, recover: bool = True, page: bool = True) -> Cost:
    """Return the cost of distilling a prepared job's scene to `count` Gaussians.

    Args:
        recover: whether the merged scene is recovered.
        page: whether pages with the result are written.
    """
    train, test = job.views.train.cameras, job.views.test
    apart = 0 if job.views.apart is None or job.teacher is None else len(job.views.apart)
    pixels = int(np.mean(train.widths.astype(np.int64) * train.heights))
    kept, size = job.is_kept(count), pixels / _USUAL_PIXELS
    steps = 0 if kept or not recover else _steps(job, count)
    views = len(test) + apart + (len(train) if recover else 0)
    stages = [("targets", _RENDER * size * (views if steps else len(test) + apart))]
    if not kept:
        stages += [("visibility", _VISIBILITY * len(train)), ("simplify", _SIMPLIFY * len(job.prior))]
        stages += [("recover", job.config.recover.recovery_time or _STEP * size * steps)] if recover else []
    stages.append(("scoring", _SCORE * size * len(test)))
    stages += [("report.html", _REPORT), ("view.html", _PAGE)] if page else []
    return Cost(views, pixels, steps, tuple(stages), _peak_bytes(job, count, views * pixels, page))


def _peak_bytes(job: DistillJob, count: int, pixels: int, page: bool) -> int:
    """Return the peak memory: of simplification, of recovery, or of packing the page."""
    given = job.config.recover.sh_degree
    degree = job.prior.sh_degree if given is None else given
    scene, small = job.prior.nbytes, 4 * row_width(degree) * count
    packed, deepest = count, degree
    if len(job.prior) <= LARGEST_DENSE:  # shown beside the result
        packed, deepest = max(count, len(job.prior)), max(degree, job.prior.sh_degree)
    packing = _PAGE_BYTES * 3 * ((deepest + 1) ** 2 - 1) * min(packed, _PAGE_FULL)
    targets = min(CACHE_BYTES, pixels * (12 if job.teacher is not None else 3))
    trained = targets + scene + _TRAINER_BYTES * count
    full = (
        0
        if job.views.full is None
        else 12 * min(FULL_PIXELS, int((job.views.full.widths * job.views.full.heights).sum()))
    )
    written = targets + full + 2 * scene + (packing if page else 0)
    # The recovered scene and its rows come on top.
    return _PROGRAM_BYTES + int(max(targets + WHOLE_TIMES * scene, trained, written)) + 2 * small


def _steps(job: DistillJob, count: int) -> int:
    """Return the steps of all recoveries: after each round, if the schedule has rounds, and of the last."""
    config, photos = job.config, job.photos_over_renders or job.teacher is None
    like = job.prior.take(np.array(evenly_spaced(len(job.prior), count)))
    last = config.recover.final_steps(like, job.views.train.cameras, photos=photos)
    if not config.recover.schedule.round_steps:
        return last
    rounds = config.simplify.rounds(len(job.prior), count, recovered=True)
    return last + len(rounds) * config.recover.schedule.round_steps


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


def _limit_text(tiling: Tiling) -> str:
    size = amount(tiling.usable_memory)
    return f"--memory {size}" if tiling.memory else f"the {size} used of the machine's memory"


def bytes_of(text: str) -> int:
    """Parse a size such as 4GB, 500MB or 2GiB; units are powers of 1000, with an i of 1024.

    >>> bytes_of("4GB"), bytes_of("1.5 gib")
    (4000000000, 1610612736)
    """
    match = _MEMORY_SIZE.fullmatch(text.strip())
    base = 1024 if "i" in text.lower() else 1000
    size = (
        0.0 if match is None else float(match[1]) * base ** ["", "k", "m", "g", "t"].index(match[2].lower())
    )
    require("memory", repr(text), size >= 1e6, "a size such as 4GB or 800MB")
    return int(size)


def check_whole_memory(scene: Path, tiling: Tiling, times: float, tile_times: float = 1.0) -> None:
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
        tiles = TileMemory(stream.count, row_bytes, tile_times, folder_of_tiles(scene))
        raise InputError(
            f"{stream.count:,} Gaussians in one piece take about {amount(need, up=True)}, "
            f"{amount(_TASK_BYTES)} of it the program, more than {_limit_text(tiling)}; "
            f"{tiles.advice(tiling.memory, max(1, stream.count // 2))}",
            path=scene,
        )


def check_job_memory(job: DistillJob, most: int | None, need: int) -> None:
    """Reject a job that needs more than `most` bytes; None means no limit."""
    if most is None or need <= most:
        return
    count = len(job.prior)
    message = f"--memory: {plural(count, 'Gaussian')} in one piece take about {amount(need, up=True)}, "
    message += f"more than {amount(most)}; smaller views, --size, take less"
    if job.teacher is not None and not job.lifted:  # tiles support this job
        tiles = TileMemory(count, 4 * row_width(job.prior.sh_degree), RECOVERY_TIMES)
        message += f"; in tiles {tiles.advice(most, max(1, count // 2))}"
    raise InputError(message)


def workers_for(store: TileStore, tiling: Tiling, times: float = 1.0) -> int:
    """Return the number of workers that memory and cores allow.

    Args:
        times: memory of a tile relative to merging it.
    """
    memory = tiling.usable_memory
    largest = max(store.tiles, key=lambda tile: tile.rows + tile.halo)
    rows, most = largest.rows + largest.halo, store.settings.get("tile_rows") or largest.rows
    made_here = store.folder.parent == tiling.folder
    tiles = TileMemory(store.count, store.row_bytes, times, None if made_here else store.folder)
    need = tiles.of(rows)
    fit = memory // need
    if fit > 1:  # several workers are processes beside this one
        fit = max(1, (memory - _TASK_BYTES) // need)
    if fit < 1:
        raise InputError(
            f"a tile of {largest.rows:,} Gaussians and {largest.halo:,} around it takes about "
            f"{amount(need, up=True)}, {amount(_TASK_BYTES)} of it the program, more than "
            f"{_limit_text(tiling)}; {tiles.advice(memory, most)}"
        )
    if tiling.workers is not None and tiling.scheduler is None and tiling.workers > fit:
        raise InputError(
            f"--workers {tiling.workers} take about {amount(tiling.workers * need, up=True)}, more than "
            f"{_limit_text(tiling)}; --workers {fit} fit"
        )
    return tiling.workers or max(1, min(fit, tiling.usable_cores))
