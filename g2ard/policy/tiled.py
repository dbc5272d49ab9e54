"""Scenes larger than memory: when a scene is worked on in tiles, by how many workers, and the work itself."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.errors import InputError
from g2ard.policy.tile_memory import TASK_BYTES, TileMemory, amount
from g2ard.policy.whole import refuse_whole, whole_budgets
from g2ard.progress import Progress, Say, silent, unsaid

if TYPE_CHECKING:
    from g2ard.policy.budget import Budget
    from g2ard.policy.inputs import Views
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.stages.simplify import SimplifyConfig
    from g2ard.tiles.simplify import TiledScene
    from g2ard.tiles.store import TileStore

__all__ = [
    "LEVELS_TIMES",
    "WHOLE_TIMES",
    "Tiling",
    "bytes_of",
    "check_memory",
    "cores_of",
    "forget",
    "is_tiled",
    "simplify_in_tiles",
    "tiles_of",
    "workers_for",
]

_SMALLEST_ROW = 4
"""Bytes of a Gaussian in a file, at least: a smaller file need not be opened to know that it is small."""

WHOLE_TIMES, LEVELS_TIMES = 3.6, 7.0
"""Memory in one piece, over the scene's arrays: of a simplification, and of levels that are merged alone."""

_READ_ROWS = 1 << 18
"""Positions that are read at a time."""

_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmMgGtT]?)(?:i?[bB])?")


@dataclass(frozen=True)
class Tiling:
    """How a scene larger than memory is worked on. Only `tile_rows` decides anything of the result.

    Args:
        tile_rows: a scene of more Gaussians is worked on in tiles of at most so many; None is 5,000,000.
        memory: bytes that all workers together may take; None is most of the machine's.
        workers: processes at once; None is as many as cores and memory allow.
        cores: that workers share; None is all.
        scheduler: of a Dask cluster, see `g2ard.tiles.executor.executor`.
        folder: for tiles and the files of tasks.
        keep: whether it stays after success.
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
        """Gaussians of a tile at the most."""
        from g2ard.tiles.ingest import TILE_ROWS

        return self.tile_rows or TILE_ROWS


def bytes_of(text: str) -> int:
    """Bytes of 4GB, 500MB, 2GiB; a unit is a power of 1000, of 1024 with an i.

    Raises:
        InputError: another text, or less than a megabyte.

    >>> bytes_of("4GB"), bytes_of("1.5 gib")
    (4000000000, 1610612736)
    """
    match = _SIZE.fullmatch(text.strip())
    base = 1024 if "i" in text.lower() else 1000
    size = (
        0.0 if match is None else float(match[1]) * base ** ["", "k", "m", "g", "t"].index(match[2].lower())
    )
    if size < 1e6:
        raise InputError(f"memory: expected a size such as 4GB or 800MB, got {text!r}")
    return int(size)


def is_tiled(scene: Path, tiling: Tiling) -> bool:
    """Whether a scene is a folder of several tiles, or has too many Gaussians to be worked on in one piece; a
    cloud of points never is.

    Raises:
        InputError: a scene that cannot be read.
    """
    from g2ard.tiles.store import MANIFEST, TileStore

    if (scene / MANIFEST).is_file():
        return len(TileStore.open(scene).tiles) > 1
    if (
        scene.is_file()
        and scene.suffix.lower() != ".json"
        and scene.stat().st_size < _SMALLEST_ROW * tiling.most_rows
    ):
        return False
    from g2ard.io.detect import kind
    from g2ard.io.stream import open_stream

    return kind(scene) == "splats" and open_stream(scene).count > tiling.most_rows


def check_memory(scene: Path, tiling: Tiling, times: float, tile_times: float = 1.0) -> None:
    """Refuse a scene that in one piece, at so many times its arrays, takes more than `--memory`.

    Raises:
        InputError: with what would do, where a tile takes `tile_times` what merging it takes; or the scene
            cannot be read.
    """
    from g2ard.io.stream import open_stream
    from g2ard.tiles.store import MANIFEST, row_width

    if tiling.memory is None:
        return
    stream = open_stream(scene)
    row_bytes = 4 * row_width(stream.sh_degree)
    need = TASK_BYTES + int(times * stream.count * row_bytes)
    if need > tiling.memory:
        tiles = TileMemory(
            stream.count, row_bytes, tile_times, scene if (scene / MANIFEST).is_file() else None
        )
        raise InputError(
            f"{scene}: {stream.count:,} Gaussians in one piece take about {amount(need, up=True)}, "
            f"{amount(TASK_BYTES)} of it the program, more than {_allowed(tiling)}; "
            f"{tiles.advice(tiling.memory, max(1, stream.count // 2), _foretold(scene))}"
        )


@contextmanager
def tiles_of(
    scene: Path, tiling: Tiling, progress: Progress = silent, say: Say = unsaid
) -> Iterator[TileStore]:
    """The tiles of a scene: the folder itself, or tiles streamed into `tiling.folder`.

    Tiles of another size that an earlier command left there go, unless the user named the folder.
    """
    from g2ard.tiles.ingest import ingest
    from g2ard.tiles.store import MANIFEST, TileStore

    if (scene / MANIFEST).is_file():
        yield TileStore.open(scene)
        return
    assert tiling.folder is not None
    yield ingest(
        scene,
        tiling.folder / "tiles",
        tile_rows=tiling.most_rows,
        overwrite=not tiling.keep,
        progress=progress,
        say=say,
    )


def simplify_in_tiles(
    scene: Path,
    budgets: Sequence[Budget],
    tiling: Tiling,
    *,
    views: Views | None = None,
    blind: bool = False,
    config: SimplifyConfig | None = None,
    up: Sequence[float] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[tuple[TileStore, TiledScene]]:
    """A scene that does not fit into memory at several budgets; each is ready when it is asked for.

    Args:
        scene: its file, or a folder of tiles.
        budgets: counts, ratios or shares.
        tiling: how; `folder` keeps what is done, so that the same call goes on.
        views: as for `g2ard.simplify`.
        blind: use no cameras at all.
        config: constants.
        up: (3,) away from the ground, for poses that are made.
        seed: of poses that are made.
        progress: told of tasks.
        say: told in lines what was decided.

    Raises:
        InputError: budgets that only the whole scene could tell, too little memory for a tile, or as
            `g2ard.tiles.simplify.simplify_tiles`.
    """
    from g2ard.tiles.executor import executor
    from g2ard.tiles.simplify import simplify_tiles

    refuse_whole(scene, whole_budgets(budgets))
    folder = tiling.folder
    assert folder is not None
    with tiles_of(scene, tiling, progress, say) as store:
        workers = workers_for(store, tiling)
        threads = max(1, cores_of(tiling) // workers)
        say(f"{len(store.tiles):,} tiles of {store.count:,} Gaussians, {workers} at a time")
        with executor(workers, threads, tiling.scheduler) as runs:
            for budget in budgets:
                yield (
                    store,
                    simplify_tiles(
                        store,
                        budget.of(store.count, str(scene)),
                        executor=runs,
                        work=folder / "steps",
                        config=config,
                        views=_given(views, say),
                        beside=lambda sample: _found(scene, sample, say) if views is None else None,
                        blind=blind,
                        up=up,
                        seed=seed,
                        progress=progress,
                        say=say,
                    ),
                )


def workers_for(store: TileStore, tiling: Tiling, times: float = 1.0) -> int:
    """As many workers as memory and cores allow, where a tile takes so many times what merging it takes.

    Raises:
        InputError: not even one tile fits.
    """
    memory = _memory_of(tiling)
    largest = max(store.tiles, key=lambda tile: tile.rows + tile.halo)
    rows, most = largest.rows + largest.halo, store.settings.get("tile_rows") or largest.rows
    made_here = tiling.folder is not None and store.folder.parent == tiling.folder
    tiles = TileMemory(store.count, store.row_bytes, times, None if made_here else store.folder)
    need = tiles.of(rows)
    fit = memory // need
    if fit > 1:  # several are processes beside this one
        fit = max(1, (memory - TASK_BYTES) // need)
    if fit < 1:
        raise InputError(
            f"a tile of {largest.rows:,} Gaussians and {largest.halo:,} around it takes about "
            f"{amount(need, up=True)}, {amount(TASK_BYTES)} of it the program, more than {_allowed(tiling)}; "
            f"{tiles.advice(memory, most, _foretold(store.folder))}"
        )
    if tiling.workers is not None and tiling.scheduler is None and tiling.workers > fit:
        raise InputError(
            f"--workers {tiling.workers} take about {amount(tiling.workers * need, up=True)}, more than "
            f"{_allowed(tiling)}; --workers {fit} fit"
        )
    return tiling.workers or max(1, min(fit, cores_of(tiling)))


def _foretold(scene: Path) -> Callable[[int], int]:
    """Rows of the largest tile, halo included, of any `--tile-rows`."""
    from g2ard.io.stream import open_stream
    from g2ard.tiles.pour import foretold

    stream = open_stream(scene)
    return foretold(stream.positions(_READ_ROWS), stream.count)


def _memory_of(tiling: Tiling) -> int:
    """Bytes that all workers together may take."""
    return tiling.memory or int(0.8 * _physical_memory())


def _allowed(tiling: Tiling) -> str:
    """That in words, and who says so."""
    size = amount(_memory_of(tiling))
    return f"--memory {size}" if tiling.memory else f"the {size} that are taken of the machine's memory"


def _given(views: Views | None, say: Say) -> Cameras | None:
    from g2ard.policy.inputs import load_views
    from g2ard.policy.views import is_made

    return None if views is None or is_made(views) else load_views(views, "train", None, say)


def _found(scene: Path, sample: Splats, say: Say) -> Cameras | None:
    """Cameras that lie beside the scene and see the sample of it."""
    from g2ard.policy.found import as_pool, found_views
    from g2ard.policy.inputs import load_views

    found = found_views(scene, sample, ["train"], say)
    return as_pool(load_views(found, "train", None, say)) if found else None


def cores_of(tiling: Tiling) -> int:
    """Cores that workers share."""
    if tiling.cores:
        return tiling.cores
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _physical_memory() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 8_000_000_000


def forget(tiling: Tiling) -> None:
    """Remove the folder of a command that has succeeded, unless it is to be kept."""
    if tiling.folder is not None and not tiling.keep:
        shutil.rmtree(tiling.folder, ignore_errors=True)
