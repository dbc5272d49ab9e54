"""Writing rows of scenes and point clouds to tile files."""

import json
import re
import shutil
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import atomic_output, drop_temporaries
from g2ard.io.detect import MANIFEST, POINTS
from g2ard.io.jsonfile import read_json
from g2ard.io.sanitize import Tally
from g2ard.io.stream import PointStream, SceneStream
from g2ard.io.tile_store import FORMAT, VERSION, TileStore, halo_name, packed, row_width, tile_name
from g2ard.io.types import Note, Notes
from g2ard.progress import Progress, Say, plural
from g2ard.scene.kdtree import KdTree, Points, Sampler, cut_tree, margin_of, parts_of
from g2ard.stages.lift import LiftConfig, lift_rows
from g2ard.tiles.executor import Executor, Workers
from g2ard.tiles.tasks import Arguments, Arrays, Inputs, Places, Task, load, telling

_TREE_SAMPLE = 1 << 20
"""Size of the sample of positions that determines the tiles (12 MB)."""

_POINT_DTYPE = np.dtype([("near", "<f4", 3), ("rgb", "<f4", 3), ("far", "<f8", 3)])
"""A point: float32 position relative to the offset (determines the tile), stored colour, world position."""

_ROWS_AT_ONCE = 1 << 16
"""Rows of a lifted tile written at a time."""
_TILE_FILE = re.compile(r"(tile|halo)-\d{5,}\.f32|tiles\.json|\.tiles\.[0-9a-f]{12}\.json|\.points")


def is_tile_file(name: str) -> bool:
    """Return whether a file or folder of this name belongs to tiles, complete or partial."""
    return _TILE_FILE.fullmatch(name) is not None


def expected_tiles(count: int, tile_rows: int) -> int:
    """Return into how many tiles of at most `tile_rows` a scene is cut, unless positions coincide."""
    points = min(count, _TREE_SAMPLE)
    return parts_of(points, count / points, tile_rows)


def clear(folder: Path, key: str | None = None) -> None:
    """Remove all files that belong to tiles, the manifest first, but keep the points of those with a key."""
    drop_temporaries(folder, MANIFEST)
    for path in sorted(folder.iterdir(), key=lambda path: path.name != MANIFEST):
        if path.is_dir() and path.name == POINTS:
            if key is None or not is_poured(path, key):
                shutil.rmtree(path)
        elif is_tile_file(path.name):
            path.unlink()


def row_bytes(stream: SceneStream | PointStream) -> int:
    """Return the bytes of a Gaussian or of a point to be lifted, which begin with its float32 position."""
    return 4 * row_width(stream.sh_degree) if isinstance(stream, SceneStream) else _POINT_DTYPE.itemsize


def _rows(stream: SceneStream | PointStream, rows: int) -> Iterator[tuple[NDArray[Any], Points]]:
    """Yield the rows to keep with their positions, reading `rows` at a time."""
    if isinstance(stream, SceneStream):
        yield from ((packed(splats), splats.means) for splats in stream.blocks(rows))
        return
    for far, colors in stream.blocks(rows):
        block = np.empty(len(far), _POINT_DTYPE)
        block["near"], block["rgb"], block["far"] = stream.near(far), colors, far
        yield block, np.ascontiguousarray(block["near"])


@dataclass
class TileWriter:
    """The tiles of a scene while they are written; the manifest comes last.

    Args:
        row_bytes: bytes per row.
    """

    folder: Path
    tree: KdTree
    margin: float
    row_bytes: int
    low: list[float] = field(default_factory=lambda: [np.inf] * 3)
    high: list[float] = field(default_factory=lambda: [-np.inf] * 3)

    def __post_init__(self) -> None:
        self.rows: dict[str, int] = {}  # file → rows written
        self.checks: dict[str, int] = {}
        for index in range(self.tree.leaves):
            for name in (tile_name(index), halo_name(index)):
                (self.folder / name).write_bytes(b"")
                self.rows[name] = self.checks[name] = 0

    @property
    def counts(self) -> list[int]:
        """Rows of each tile."""
        return [self.rows[tile_name(index)] for index in range(self.tree.leaves)]

    def positions(self, name: str, count: int) -> Points:
        """Return the (count, 3) float32 positions in a file, the first three numbers of each row."""
        rows = np.memmap(self.folder / name, "u1", "r", shape=(count, self.row_bytes))
        return np.ascontiguousarray(rows[:, :12]).view("<f4")

    def add(self, rows: NDArray[Any], means: Points) -> None:
        """Append rows to their tiles and to the halos of tiles nearby."""
        if not len(rows):
            return
        self.low = np.minimum(self.low, means.min(axis=0).astype(np.float64)).tolist()
        self.high = np.maximum(self.high, means.max(axis=0).astype(np.float64)).tolist()
        for index, (core, halo) in enumerate(self.tree.route(means, self.margin)):
            self._append(tile_name(index), rows, core)
            self._append(halo_name(index), rows, halo)

    def _append(self, name: str, rows: NDArray[Any], chosen: NDArray[np.intp]) -> None:
        if not len(chosen):
            return
        data = (rows if len(chosen) == len(rows) else rows[chosen]).view(np.uint8).data
        try:
            with (self.folder / name).open("ab") as file:
                file.write(data)
        except OSError as error:
            raise OutputError(f"cannot write: {error.strerror or error}", path=self.folder / name) from error
        self.rows[name] += len(chosen)
        self.checks[name] = zlib.crc32(data, self.checks[name])

    def finish(self, key: str, manifest: dict[str, Any]) -> None:
        """Write the manifest, which makes the folder a store."""
        low, high = np.array(self.low), np.array(self.high)
        tiles = [
            {
                "rows": self.rows[tile_name(i)],
                "halo": self.rows[halo_name(i)],
                "low": np.clip(box[0], low, high).tolist(),
                "high": np.clip(box[1], low, high).tolist(),
                "crc32": [self.checks[tile_name(i)], self.checks[halo_name(i)]],
            }
            for i, box in enumerate(self.tree.boxes())
        ]
        content = {
            "format": FORMAT,
            "version": VERSION,
            "key": key,
            "count": sum(self.counts),
            **manifest,
            "margin": self.margin,
            "cells": self.tree.to_json(),
            "tiles": tiles,
        }
        _write_json(self.folder / MANIFEST, content)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(content) + "\n", encoding="utf-8", newline="\n")


def pour(
    folder: Path,
    stream: SceneStream | PointStream,
    tile_rows: int,
    rows: int,
    progress: Progress,
    say: Say,
    like: TileStore | None = None,
) -> TileWriter:
    """Write all tiles and halos of a stream into an existing folder.

    Args:
        rows: rows in memory at a time.
        like: reuse the tree and margin of these tiles, ignoring `tile_rows`.
    """
    tree, margin = _planned(folder, stream, tile_rows, rows, progress, like)
    while True:
        writer = TileWriter(folder, tree, margin, row_bytes(stream))
        stream.tally = Tally(stream.tally.item)
        for block, positions in _rows(stream, rows):
            writer.add(block, positions)
            progress("tiles", stream.tally.rows, stream.count)
        stream.all_notes()
        parts = {} if like else _overfull(writer, tile_rows)
        if not parts:
            return writer
        say(f"{plural(len(parts), 'tile')} hold more than {tile_rows:,} rows; cutting again")
        tree = writer.tree.refined(parts)
        margin = margin_of(tree, _sampled(stream, rows, progress)[0])


def _planned(
    folder: Path,
    stream: SceneStream | PointStream,
    tile_rows: int,
    rows: int,
    progress: Progress,
    like: TileStore | None,
) -> tuple[KdTree, float]:
    """Return the tree of tiles and their margin; check that the disk has room."""
    tree, points, each = like.tree if like else KdTree(), np.empty((0, 3), np.float32), 1.0
    if like or stream.count > tile_rows:
        points, each = _sampled(stream, rows, progress)
    if not like:
        tree = cut_tree(points, each, tile_rows)
    margin = like.margin if like else margin_of(tree, points)
    around = each * sum(len(halo) for _, halo in tree.route(points, margin))
    discs = 0 if isinstance(stream, SceneStream) else 2 * 4 * row_width(0)
    room = row_bytes(stream) + discs  # of a row on the disk, including all copies
    needed, free = int((stream.count + around) * room), shutil.disk_usage(folder).free
    if needed > free:
        raise OutputError(
            f"the tiles need {needed / 1e9:,.1f} GB, the disk has {free / 1e9:,.1f} GB free", path=folder
        )
    return tree, margin


def _sampled(stream: SceneStream | PointStream, rows: int, progress: Progress) -> tuple[Points, float]:
    sampler, done = Sampler(stream.count, _TREE_SAMPLE), 0
    for points in stream.positions(rows):
        sampler.add(points)
        done += len(points)
        progress("sample", done, stream.count)
    return sampler.result()


def _overfull(writer: TileWriter, tile_rows: int) -> dict[int, KdTree]:
    """Plan cuts of the tiles that exceed `tile_rows`."""
    parts = {}
    for index, count in enumerate(writer.counts):
        if count > tile_rows:
            tree = cut_tree(writer.positions(tile_name(index), count), 1.0, tile_rows)
            if tree.leaves > 1:
                parts[index] = tree
    return parts


def lift_tiles(
    folder: Path,
    cloud: PointStream,
    config: LiftConfig,
    key: str,
    tile_rows: int,
    rows: int,
    progress: Progress,
    say: Say,
    runs: Executor,
) -> tuple[TileWriter, Notes]:
    """Write points to tiles in a subfolder, then lift each tile with its halo and write the result.

    Points that are all in tiles, and tiles that are lifted, stay for the next call if this one ends before.

    Args:
        key: of the tiles.
        runs: lifts the tiles.

    Others are those of `pour`.

    Returns:
        The tiles, and notes on the cloud.
    """
    within = folder / POINTS
    within.mkdir(exist_ok=True)
    if not is_poured(within, key):
        points = pour(within, cloud, tile_rows, rows, progress, say)
        notes = [asdict(note) for note in cloud.all_notes()]
        tree = {"cells": points.tree.to_json(), "margin": points.margin, "counts": points.counts}
        _write_json(within / MANIFEST, {"key": key, "notes": notes, **tree})
    poured = read_json(within / MANIFEST)
    given = {"key": key, "config": asdict(config), "offset": cloud.offset.tolist()}
    tasks = [
        Task(
            f"{__name__}:lifted",
            f"lifted-{tile:05}",
            within,
            {**given, "tile": tile},
            places={"points": within},
            cost=count,
        )
        for tile, count in enumerate(poured["counts"])
    ]
    files = Workers(runs, within, progress).run(tasks, "lift")
    writer = TileWriter(folder, KdTree.from_json(poured["cells"]), poured["margin"], 4 * row_width(0))
    for path in files:
        (discs,) = load(path, "rows")
        for start in range(0, len(discs), _ROWS_AT_ONCE):
            part = discs[start : start + _ROWS_AT_ONCE]
            writer.add(part, np.ascontiguousarray(part[:, :3]))
    shutil.rmtree(within)
    return writer, tuple(Note(**note) for note in poured["notes"])


def is_poured(points: Path, key: str) -> bool:
    """Return whether a folder has all points of the tiles with this key."""
    with suppress(InputError, LookupError, TypeError):
        return bool(read_json(points / MANIFEST)["key"] == key)
    return False


def lifted(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """Lift a tile's points with those of its halo as neighbours.

    Args:
        arguments: `tile`; `config`, the fields of `LiftConfig`; `offset`, that of the tiles.
        places: `points`, the folder of their tiles.

    Returns:
        `rows`, as tiles have them.
    """
    names = tile_name(arguments["tile"]), halo_name(arguments["tile"])
    core, halo = (np.fromfile(places["points"] / name, _POINT_DTYPE) for name in names)
    if not len(core):
        return {"rows": np.empty((0, row_width(0)), "<f4")}
    both = np.concatenate([core, halo])
    discs, rows = lift_rows(both["far"], both["rgb"], LiftConfig(**arguments["config"]), telling)
    rows = rows[rows < len(core)]
    means = np.ascontiguousarray(core["near"][rows])
    return {"rows": packed(replace(discs.take(slice(0, len(rows))), means=means))}
