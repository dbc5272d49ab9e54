"""Streaming a scene of any size into tiles, in memory that does not grow with it."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.errors import InputError, OutputError
from g2ard.io.clean import plural
from g2ard.io.stream import SceneStream, open_stream
from g2ard.io.types import Note
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.tiles.cells import Cell, Points, Sampler, cut_cells, margin_of
from g2ard.tiles.journal import JOURNAL, Journal
from g2ard.tiles.store import MANIFEST, VERSION, TileStore, row_width, tile_name

__all__ = ["TILE_ROWS", "ingest"]

TILE_ROWS = 5_000_000
"""Rows of a tile at the most, unless told otherwise."""

_SAMPLE = 1 << 20
"""Positions that tiles are cut by: 12 MB."""

_BLOCK_BYTES = 1 << 24
"""Bytes of rows in memory at a time; some five copies of them are made on the way."""

_OURS = re.compile(r"(tile|halo)-\d{5,}\.f32|\.?(tiles|journal)\.json(\.new)?")


def ingest(
    source: str | Path | Sequence[str | Path],
    folder: str | Path,
    *,
    tile_rows: int = TILE_ROWS,
    block_rows: int | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> TileStore:
    """Write a scene as tiles of at most `tile_rows` Gaussians, each with a halo of its neighbours.

    A kd tree cuts at medians of a sample of positions, along the longest side. A halo holds the Gaussians of
    other tiles that lie in the tile's cell once its sides are moved outwards by 3 % of the median over tiles
    of √(ab), a and b a tile's two longer sides. Which tile a Gaussian comes to depends neither on the order
    of the rows nor on `block_rows`; within a tile the rows keep their order.

    Where it was interrupted the same call goes on from the last block, and where all is done it returns.

    Args:
        source: a scene, or several as one, as `g2ard.io.stream.open_stream` takes them.
        folder: where the tiles go; absent, empty, or holding these tiles in part or whole.
        tile_rows: Gaussians of a tile at the most; only Gaussians of one position are never parted.
        block_rows: rows in memory at a time; None takes 16 MiB of them.
        overwrite: whether tiles of another scene, or of other settings, may be replaced.
        progress: told of rows done.
        say: told what was noticed.

    Raises:
        InputError: the scene cannot be read, or `tile_rows` is less than 1.
        OutputError: the folder holds something else, or the disk has too little room.
    """
    folder = Path(folder)
    if tile_rows < 1 or (block_rows is not None and block_rows < 1):
        raise InputError(f"tile_rows and block_rows: expected at least 1, got {tile_rows}, {block_rows}")
    stream = open_stream(source)
    settings = {"tile_rows": tile_rows}
    key = _key(stream, settings)
    if (folder / MANIFEST).is_file():
        store = TileStore.open(folder) if not overwrite else _opened(folder)
        if store is not None and store.key == key:
            say(f"{folder}: holds these {plural(store.count, 'Gaussian')} already; skipped")
            return store
    _check_folder(folder, key, overwrite)
    row_bytes = 4 * row_width(stream.sh_degree)
    rows = block_rows or max(1, _BLOCK_BYTES // row_bytes)
    journal = _resumed(folder, key, row_bytes, say)
    if journal is None:
        journal = _started(folder, key, stream, tile_rows, rows, progress)
    try:
        while True:
            _pour(journal, stream, rows, progress)
            notes = list(stream.all_notes())
            parts = _overfull(journal, tile_rows)
            if not parts:
                break
            say(f"{plural(len(parts), 'tile')} hold more than {tile_rows:,} Gaussians; cut once more")
            journal = _again(journal, journal.cells.refined(parts), stream, rows, progress)
    except InputError:
        _clear(folder)
        raise
    over = sum(count > tile_rows for count in journal.tiles.rows)
    if over:
        text = f"{plural(over, 'tile')} of more than {tile_rows:,} Gaussians: many share one position"
        notes.append(Note("overfull_tiles", over, text))
    manifest = {
        "sh_degree": stream.sh_degree,
        "offset": stream.offset.tolist(),
        "source": [str(stream.path)],
        "settings": settings,
        "notes": [asdict(note) for note in notes],
    }
    journal.finish(manifest)
    return TileStore.open(folder)


def _key(stream: SceneStream, settings: dict[str, Any]) -> str:
    decisive = {"version": VERSION, "source": stream.identity(), **settings}
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()


def _opened(folder: Path) -> TileStore | None:
    try:
        return TileStore.open(folder)
    except InputError:
        return None


def _check_folder(folder: Path, key: str, overwrite: bool) -> None:
    """Make the folder; refuse one that holds anything but the beginnings of these very tiles."""
    if folder.is_file():
        raise OutputError(f"{folder}: is a file; a folder is to be written there")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise OutputError(f"{folder}: cannot write there: {error.strerror}") from error
    foreign = sorted(name for name in names if not _OURS.fullmatch(name))
    if foreign:
        raise OutputError(f"{folder}: holds {foreign[0]}, which is no part of tiles; name another folder")
    if overwrite and (MANIFEST in names or _begun(folder) != key):
        _clear(folder)
    elif MANIFEST in names or (JOURNAL in names and _begun(folder) != key):
        raise OutputError(
            f"{folder}: exists: tiles of another scene or of other settings; overwrite=True replaces them"
        )
    elif JOURNAL not in names:
        _clear(folder)


def _begun(folder: Path) -> str | None:
    """The key in the journal, if there is one that can be read."""
    try:
        journal = Journal.open(folder, 1)
    except InputError:
        return None
    return journal.key if journal else None


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if _OURS.fullmatch(path.name):
            path.unlink()


def _resumed(folder: Path, key: str, row_bytes: int, say: Say) -> Journal | None:
    journal = Journal.open(folder, row_bytes)
    if journal is not None:
        journal.cut()
        say(f"{folder}: goes on after row {journal.next_row:,}")
    return journal


def _started(
    folder: Path, key: str, stream: SceneStream, tile_rows: int, rows: int, progress: Progress
) -> Journal:
    """Cut the tiles, and see to it that there is room for them."""
    cells, points, each = Cell(), np.empty((0, 3), np.float32), 1.0
    if stream.count > tile_rows:
        points, each = _sampled(stream, rows, progress)
        cells = cut_cells(points, each, tile_rows)
    journal = Journal(folder, key, cells, margin_of(cells, points), 4 * row_width(stream.sh_degree))
    _check_room(journal, stream, points, each)
    journal.cut()
    journal.save()
    return journal


def _sampled(stream: SceneStream, rows: int, progress: Progress) -> tuple[Points, float]:
    sampler, done = Sampler(stream.count, _SAMPLE), 0
    for points in stream.positions(rows):
        sampler.add(points)
        done += len(points)
        progress("sample", done, stream.count)
    return sampler.result()


def _check_room(journal: Journal, stream: SceneStream, points: Points, each: float) -> None:
    around = sum(len(halo) for _, halo in journal.cells.route(points, journal.margin))
    needed = int((stream.count + each * around) * journal.row_bytes)
    free = shutil.disk_usage(journal.folder).free
    if needed > free:
        raise OutputError(
            f"{journal.folder}: the tiles need {needed / 1e9:,.1f} GB, the disk has {free / 1e9:,.1f} GB free"
        )


def _pour(journal: Journal, stream: SceneStream, rows: int, progress: Progress) -> None:
    """All rows that are not in their tiles yet."""
    stream.tally = journal.tally
    for splats in stream.blocks(rows, journal.next_row):
        journal.add(splats)
        journal.next_row = stream.tally.rows
        journal.save()
        progress("tiles", journal.next_row, stream.count)


def _overfull(journal: Journal, tile_rows: int) -> dict[int, Cell]:
    """How tiles are to be cut that came to hold more rows than the sample foretold."""
    parts = {}
    for index, count in enumerate(journal.tiles.rows):
        if count > tile_rows:
            width = journal.row_bytes // 4
            path = journal.folder / tile_name(index)
            means = np.array(np.memmap(path, "<f4", "r", shape=(count, width))[:, :3])
            cells = cut_cells(means, 1.0, tile_rows)
            if cells.leaves > 1:
                parts[index] = cells
    return parts


def _again(journal: Journal, cells: Cell, stream: SceneStream, rows: int, progress: Progress) -> Journal:
    """A journal of the same scene with other cells, of which nothing is written yet."""
    points, _ = _sampled(stream, rows, progress)
    _clear(journal.folder)
    fresh = Journal(journal.folder, journal.key, cells, margin_of(cells, points), journal.row_bytes)
    fresh.cut()
    fresh.save()
    return fresh
