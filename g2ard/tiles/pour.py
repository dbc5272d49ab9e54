"""Rows of any kind poured into the files of tiles: cells by a sample, then every row to where it belongs."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import OutputError
from g2ard.io.types import Note
from g2ard.progress import Progress, Say, plural
from g2ard.tiles.cells import Cell, Points, Sampler, cut_cells, margin_of
from g2ard.tiles.journal import Journal, clear
from g2ard.tiles.store import TileStore, tile_name

__all__ = ["Feed", "foretold", "pour"]

_SAMPLE = 1 << 20
"""Positions that tiles are cut by: 12 MB."""

_SIGMAS = 4.0
"""A tile with its halo may hold more than the sample foretells, by so many standard deviations."""


class Feed(Protocol):
    """What is poured: rows of bytes, each with a position.

    Attributes:
        path: names the source in messages.
        count: rows of the source.
        tally: a dataclass of what was counted while rows were read.
        row: the dtype of a row, whose positions are float32 (x, y, z) or float64 less `offset`.
        room: bytes on disk that a row takes in the end, all copies counted.
        settings: by which it is poured, beside what `pour` takes.
    """

    path: Path
    count: int
    tally: Any
    row_bytes: int
    room: int
    settings: dict[str, Any]

    def positions(self, rows: int) -> Iterator[Points]:
        """(n, 3) positions of all rows, in blocks."""
        ...

    def rows(self, rows: int, start: int) -> Iterator[tuple[NDArray[Any], Points]]:
        """The rows to be kept from the source's row `start` on, and their positions; counted in `tally`."""
        ...

    def all_notes(self) -> tuple[Note, ...]:
        """What was noticed, after the last row."""
        ...


def pour(
    folder: Path,
    key: str,
    feed: Feed,
    tile_rows: int,
    rows: int,
    progress: Progress,
    say: Say,
    like: TileStore | None = None,
) -> Journal:
    """Write all tiles and halos of a feed, going on where an earlier call was interrupted.

    Args:
        folder: there already; empty or with the journal of this very key.
        key: of the content.
        feed: the rows.
        tile_rows: rows of a tile at the most.
        rows: rows in memory at a time.
        progress: told of rows read.
        say: told what was decided.
        like: tiles whose cells and margin are taken, however many rows they come to hold.

    Raises:
        InputError: the source is broken, or has no row to be kept.
        OutputError: the disk has too little room.
    """
    journal = Journal.open(folder, feed.row_bytes, type(feed.tally))
    if journal is None:
        journal = _started(folder, key, feed, tile_rows, rows, progress, like)
    else:
        journal.cut()
        say(f"{folder}: goes on after row {journal.next_row:,}")
    while True:
        feed.tally = journal.tally
        for block, positions in feed.rows(rows, journal.next_row):
            journal.add(block, positions)
            journal.next_row = feed.tally.rows
            journal.save()
            progress("tiles", journal.next_row, feed.count)
        feed.all_notes()
        parts = {} if like else _overfull(journal, tile_rows)
        if not parts:
            return journal
        say(f"{plural(len(parts), 'tile')} hold more than {tile_rows:,} rows; cut once more")
        cells = journal.cells.refined(parts)
        points, _ = _sampled(feed, rows, progress)
        clear(folder)
        journal = _empty(folder, key, cells, margin_of(cells, points), feed)
        journal.cut()
        journal.save()


def _started(
    folder: Path,
    key: str,
    feed: Feed,
    tile_rows: int,
    rows: int,
    progress: Progress,
    like: TileStore | None,
) -> Journal:
    """Cut the tiles, and see to it that there is room for them."""
    cells, points, each = like.cells if like else Cell(), np.empty((0, 3), np.float32), 1.0
    if like or feed.count > tile_rows:
        points, each = _sampled(feed, rows, progress)
    if not like:
        cells = cut_cells(points, each, tile_rows)
    margin = like.margin if like else margin_of(cells, points)
    journal = _empty(folder, key, cells, margin, feed)
    around = each * sum(len(halo) for _, halo in cells.route(points, journal.margin))
    needed, free = int((feed.count + around) * feed.room), shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(
            f"{folder}: the tiles need {needed / 1e9:,.1f} GB, the disk has {free / 1e9:,.1f} GB free"
        )
    journal.cut()
    journal.save()
    return journal


def _empty(folder: Path, key: str, cells: Cell, margin: float, feed: Feed) -> Journal:
    return Journal(folder, key, cells, margin, feed.row_bytes, type(feed.tally)(), feed.settings)


def _sampled(feed: Feed, rows: int, progress: Progress) -> tuple[Points, float]:
    sampler, done = Sampler(feed.count, _SAMPLE), 0
    for points in feed.positions(rows):
        sampler.add(points)
        done += len(points)
        progress("sample", done, feed.count)
    return sampler.result()


def _overfull(journal: Journal, tile_rows: int) -> dict[int, Cell]:
    """How tiles are to be cut that came to hold more rows than the sample foretold."""
    parts = {}
    for index, count in enumerate(journal.tiles.rows):
        if count > tile_rows:
            cells = cut_cells(journal.positions(tile_name(index), count), 1.0, tile_rows)
            if cells.leaves > 1:
                parts[index] = cells
    return parts


def foretold(positions: Iterable[Points], count: int) -> Callable[[int], int]:
    """About how many rows the largest tile will hold, halo included, as a function of `tile_rows`.

    Args:
        positions: all of them, in blocks.
        count: how many there are.

    >>> line = np.stack([np.arange(100.0, dtype=np.float32)] * 3, 1)
    >>> rows = foretold([line], 100)
    >>> rows(100), rows(50), rows(25)
    (100, 52, 26)
    """
    sampler = Sampler(count, _SAMPLE)
    for points in positions:
        sampler.add(points)
    sample, each = sampler.result()

    def largest(tile_rows: int) -> int:
        cells = cut_cells(sample, each, tile_rows) if count > tile_rows else Cell()
        most = max(len(core) + len(halo) for core, halo in cells.route(sample, margin_of(cells, sample)))
        return math.ceil((most + (_SIGMAS * math.sqrt(most) if each > 1 else 0)) * each)

    return largest
