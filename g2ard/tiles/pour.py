"""Writing rows of scenes and point clouds to tile files."""

import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import RenderModel
from g2ard.errors import OutputError
from g2ard.io.detect import POINTS
from g2ard.io.sanitize import PointTally
from g2ard.io.stream import PointStream, SceneStream
from g2ard.io.tile_store import TileStore, halo_name, packed, row_width, tile_name
from g2ard.progress import Progress, Say, plural
from g2ard.scene.kdtree import KdTree, Points, Sampler, cut_tree, margin_of
from g2ard.scene.splats import Splats
from g2ard.stages.lift import LiftConfig, lift_rows
from g2ard.tiles.journal import Journal, clear

_TREE_SAMPLE = 1 << 20
"""Size of the sample of positions that determines the tiles (12 MB)."""

_POINT_DTYPE = np.dtype([("near", "<f4", 3), ("rgb", "<f4", 3), ("far", "<f8", 3)])
"""A point: float32 position relative to the offset (determines the tile), stored colour, world position."""

_ROWS_AT_ONCE = 1 << 16
"""Rows of a lifted tile written at a time."""


class Feed(ABC):
    """Source of rows for tiles, as bytes, each with a position.

    Attributes:
        stream: the source.
        row_bytes: bytes per row; a row begins with its float32 position.
        room: bytes on disk per row in the end, including all copies.
        settings: settings stored in the journal; `ingest` sets them.
        render_model: see `Splats`.
    """

    stream: SceneStream | PointStream
    row_bytes: int
    room: int
    sh_degree = 0
    render_model: RenderModel = "classic"
    settings: dict[str, Any]

    @abstractmethod
    def rows(self, rows: int, start: int) -> Iterator[tuple[NDArray[Any], Points]]:
        """Yield the rows to keep from the source's row `start` on, with their positions."""


class SceneFeed(Feed):
    """Feed of a scene's Gaussians."""

    def __init__(self, stream: SceneStream) -> None:
        self.stream: SceneStream = stream
        self.row_bytes = self.room = 4 * row_width(stream.sh_degree)
        self.sh_degree, self.render_model = stream.sh_degree, stream.render_model

    def rows(self, rows: int, start: int) -> Iterator[tuple[NDArray[Any], Points]]:
        return ((packed(splats), splats.means) for splats in self.stream.blocks(rows, start))


class PointFeed(Feed):
    """Feed of a point cloud's points, for tiles to be lifted."""

    row_bytes = _POINT_DTYPE.itemsize
    room = _POINT_DTYPE.itemsize + 4 * row_width(0)

    def __init__(self, stream: PointStream, config: LiftConfig) -> None:
        self.stream: PointStream = stream
        self.config = config

    def rows(self, rows: int, start: int) -> Iterator[tuple[NDArray[Any], Points]]:
        for far, colors in self.stream.blocks(rows, start):
            block = np.empty(len(far), _POINT_DTYPE)
            block["near"], block["rgb"], block["far"] = self.stream.near(far), colors, far
            yield block, np.ascontiguousarray(block["near"])


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
    """Write all tiles and halos of a feed, resuming an interrupted call.

    Args:
        folder: an existing folder: empty, or with a journal of the same key.
        key: hash of everything that determines the content.
        rows: rows in memory at a time.
        like: reuse the tree and margin of these tiles, ignoring `tile_rows`.
    """
    stream: Any = feed.stream
    journal = Journal.open(folder, feed.row_bytes, type(feed.stream.tally))
    if journal is None:
        journal = _started(folder, key, feed, tile_rows, rows, progress, like)
    else:
        journal.cut()
        say(f"{folder}: resuming after row {journal.next_row:,}")
    while True:
        stream.tally = journal.tally
        for block, positions in feed.rows(rows, journal.next_row):
            journal.add(block, positions)
            journal.next_row = stream.tally.rows
            journal.save()
            progress("tiles", journal.next_row, stream.count)
        stream.all_notes()
        parts = {} if like else _overfull(journal, tile_rows)
        if not parts:
            return journal
        say(f"{plural(len(parts), 'tile')} hold more than {tile_rows:,} rows; cutting again")
        tree = journal.tree.refined(parts)
        points, _ = _sampled(feed, rows, progress)
        clear(folder)
        journal = _empty(folder, key, tree, margin_of(tree, points), feed)
        journal.cut()
        journal.save()


def _started(
    folder: Path, key: str, feed: Feed, tile_rows: int, rows: int, progress: Progress, like: TileStore | None
) -> Journal:
    """Plan the tiles, check that the disk has room, and start a journal."""
    tree, points, each = like.tree if like else KdTree(), np.empty((0, 3), np.float32), 1.0
    if like or feed.stream.count > tile_rows:
        points, each = _sampled(feed, rows, progress)
    if not like:
        tree = cut_tree(points, each, tile_rows)
    margin = like.margin if like else margin_of(tree, points)
    journal = _empty(folder, key, tree, margin, feed)
    around = each * sum(len(halo) for _, halo in tree.route(points, journal.margin))
    needed, free = int((feed.stream.count + around) * feed.room), shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(
            f"the tiles need {needed / 1e9:,.1f} GB, the disk has {free / 1e9:,.1f} GB free", path=folder
        )
    journal.cut()
    journal.save()
    return journal


def _empty(folder: Path, key: str, tree: KdTree, margin: float, feed: Feed) -> Journal:
    return Journal(folder, key, tree, margin, feed.row_bytes, type(feed.stream.tally)(), feed.settings)


def _sampled(feed: Feed, rows: int, progress: Progress) -> tuple[Points, float]:
    sampler, done = Sampler(feed.stream.count, _TREE_SAMPLE), 0
    for points in feed.stream.positions(rows):
        sampler.add(points)
        done += len(points)
        progress("sample", done, feed.stream.count)
    return sampler.result()


def _overfull(journal: Journal, tile_rows: int) -> dict[int, KdTree]:
    """Plan cuts of the tiles that exceed `tile_rows`."""
    parts = {}
    for index, count in enumerate(journal.tiles.rows):
        if count > tile_rows:
            tree = cut_tree(journal.positions(tile_name(index), count), 1.0, tile_rows)
            if tree.leaves > 1:
                parts[index] = tree
    return parts


def lift_tiles(
    folder: Path, key: str, feed: PointFeed, tile_rows: int, rows: int, progress: Progress, say: Say
) -> Journal:
    """Write points to tiles in a subfolder, then lift each tile with its halo and write the result.

    Arguments are those of `pour`.
    """
    within, row_bytes = folder / POINTS, 4 * row_width(0)
    within.mkdir(exist_ok=True)
    points = pour(within, key, feed, tile_rows, rows, progress, say)
    feed.stream.tally = points.tally
    journal = Journal.open(folder, row_bytes, PointTally)
    if journal is None:
        journal = Journal(folder, key, points.tree, points.margin, row_bytes, points.tally, feed.settings)
        journal.save()
    else:
        say(f"{folder}: resuming after tile {journal.next_row:,}")
    journal.cut()
    total = sum(points.tiles.rows)
    for index in range(journal.next_row, points.tree.leaves):
        splats = _lifted(points, index, feed)
        for start in range(0, len(splats), _ROWS_AT_ONCE):
            part = splats.take(slice(start, start + _ROWS_AT_ONCE))
            journal.add(packed(part), part.means)
        journal.next_row = index + 1
        journal.save()
        progress("lift", sum(points.tiles.rows[: index + 1]), total)
    shutil.rmtree(within)
    return journal


def _lifted(points: Journal, index: int, feed: PointFeed) -> Splats:
    """Lift a tile's points with those of its halo as neighbours."""
    core = _read(points.folder / tile_name(index), points.tiles.rows[index])
    if not len(core):
        return Splats.create(np.empty((0, 3)), scales=np.empty((0, 3)))
    halo = _read(points.folder / halo_name(index), points.halos.rows[index])
    both = np.concatenate([core, halo])
    colors = np.clip(both["rgb"] / np.float32(feed.stream.divisor), 0, 1)
    discs, rows = lift_rows(both["far"], colors, feed.config)
    rows = rows[rows < len(core)]
    means = np.ascontiguousarray(core["near"][rows])
    return replace(discs.take(slice(0, len(rows))), means=means, offset=feed.stream.offset)


def _read(path: Path, count: int) -> NDArray[Any]:
    return np.fromfile(path, _POINT_DTYPE, count)
