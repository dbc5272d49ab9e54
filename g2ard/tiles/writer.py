"""Writing scenes and point clouds as tiles.

Parts of the rows are sampled, which gives the tree of tiles, and cut along it. Points are then lifted tile by
tile. Finally, the rows of each tile are gathered. Every step is a task, so that a killed call is continued.
"""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float32, Int, Values
from g2ard.config.choices import Named
from g2ard.errors import OutputError
from g2ard.io.atomic import atomic_output, drop_temporaries
from g2ard.io.detect import MANIFEST, PARTS
from g2ard.io.jsonfile import read_json
from g2ard.io.stream import PointStream, SceneStream
from g2ard.io.tile_store import FORMAT, VERSION, TileStore, halo_name, packed, row_width, tile_name
from g2ard.progress import Progress, Say, plural
from g2ard.scene.kdtree import KdTree, Sampler, cut_tree, margin_of, parts_of
from g2ard.stages.lift import LiftConfig, lift_rows
from g2ard.system.cached import cached_property
from g2ard.system.keys import key_of
from g2ard.tiles.executor import Executor, Workers, run_here
from g2ard.tiles.tasks import Arrays, Given, is_whole, load, save, telling

_TREE_SAMPLE = 1 << 20
"""Size of the sample of positions that determines the tiles (12 MB)."""

_POINT_DTYPE = np.dtype([("near", "<f4", 3), ("rgb", "<f4", 3), ("far", "<f8", 3)])
"""A point: float32 position relative to the offset (determines the tile), stored colour, world position."""

_PART_BYTES = 1 << 25
"""Bytes of rows of a part; a task makes about four copies of them."""

_SENT_BYTES = 1 << 22
"""Largest stream that is sent to workers, with each part: others are read by this process."""

_TILE_FILE = re.compile(r"(tile|halo)-\d{5,}\.f32|tiles\.json|\.tiles\.[0-9a-f]{12}\.json|\.parts")

Stream = SceneStream | PointStream


def is_tile_file(name: str) -> bool:
    """Return whether a file or folder of this name belongs to tiles, complete or partial."""
    return _TILE_FILE.fullmatch(name) is not None


def expected_tiles(count: int, tile_rows: int) -> int:
    """Return into how many tiles of at most `tile_rows` a scene is cut, unless positions coincide."""
    points = min(count, _TREE_SAMPLE)
    return parts_of(points, count / points, tile_rows)


def clear(folder: Path, key: str | None = None, *, complete: bool = False) -> None:
    """Remove all files of tiles, the manifest first, but of unfinished ones with a key only that.

    Args:
        complete: whether the folder has all tiles, so that only unfinished steps are removed.
    """
    drop_temporaries(folder, MANIFEST)
    if not complete:
        (folder / MANIFEST).unlink(missing_ok=True)
    parts = folder / PARTS
    if key is not None and _read_begun(parts).get("key") == key and any(parts.glob("*.npz")):
        return
    shutil.rmtree(parts, ignore_errors=True)
    for path in sorted(folder.iterdir()) if not complete else ():
        if is_tile_file(path.name):
            path.unlink()


def _read_begun(parts: Path) -> Named:
    """Return what is known of begun tiles: their key, and the file of their tree."""
    return dict(read_json(parts / MANIFEST)) if (parts / MANIFEST).is_file() else {}


@dataclass(eq=False)
class Pouring:
    """The tiles of a stream while they are written; the manifest comes last.

    Args:
        key: of the tiles.
        tile_rows: most rows of a tile.
        rows: rows of a part; None means 32 MiB of rows.
        runs: executor of the steps.
        mended: complete tiles, and those of them to write again; None writes all.
    """

    folder: Path
    stream: Stream
    key: str
    tile_rows: int
    rows: int | None
    runs: Executor
    mended: tuple[TileStore, list[int]] | None
    progress: Progress
    say: Say

    def __post_init__(self) -> None:
        self.parts = self.folder / PARTS
        self.parts.mkdir(exist_ok=True)
        self.workers = Workers(self.runs, self.parts, self.progress)
        here = self.runs is run_here or not _can_be_sent(self.stream)
        self.readers = replace(self.workers, executor=run_here) if here else self.workers
        if _read_begun(self.parts).get("key") != self.key:
            self._begin({"key": self.key})

    def _begin(self, known: Named) -> None:
        with atomic_output(self.parts / MANIFEST, overwrite=True) as temporary:
            temporary.write_text(json.dumps(known), encoding="ascii")

    def cut(self) -> tuple[Path, list[Path]]:
        """Cut the parts into tiles; return the files of the tree and of the parts."""
        known = _read_begun(self.parts).get("tree")
        tree = self.parts / known if known else None
        if tree is None or not is_whole(tree):
            tree = self._plan()
        while True:
            files = self._run_parts(cut, "tiles", {"only": self._near, "tree": tree})
            self._tell_counts(files)
            parts = self._cut_again(files)
            if not parts:
                return tree, files
            self.say(
                f"{plural(len(parts), 'tile')} hold more than {self.tile_rows:,} rows; cutting again"
            )
            refined = _load_tree(tree)[0].refined(parts)
            tree = self._save_tree(refined, margin_of(refined, self._sample()[0]))
            for path in files:
                path.unlink()

    def _run_parts(
        self, function: Callable[[Given], Arrays], stage: str, given: Given
    ) -> list[Path]:
        """Run a function that reads the stream on each part."""
        rows = self.rows or max(1, _PART_BYTES // row_bytes(self.stream))
        calls = [
            ({"key": self.key, "part": [rows, first, last], **given}, last - first)
            for first, last in self.stream.parts(rows)
        ]
        return self.readers.map(function, stage, calls, {"stream": self.stream})

    @cached_property
    def _near(self) -> list[int] | None:
        """The tiles to write, and those that have rows of their halos; None for all."""
        if self.mended is None:
            return None
        store, tiles = self.mended
        low, high = store.tree.boxes().swapaxes(0, 1)
        gaps = [np.maximum(low - high[tile], low[tile] - high).max(axis=1) for tile in tiles]
        return np.flatnonzero(np.min(gaps, axis=0) <= store.margin).tolist()

    def _plan(self) -> Path:
        """Plan the tiles; check that the disk has room."""
        if self.mended is not None:
            return self._save_tree(self.mended[0].tree, self.mended[0].margin)
        points = np.empty((0, 3), np.float32)
        each = 1.0
        if self.stream.count > self.tile_rows:
            points, each = self._sample()
        tree = cut_tree(points, each, self.tile_rows)
        margin = margin_of(tree, points)
        around = each * sum(len(halo) for _, halo in tree.route(points, margin))
        written = [row_bytes(self.stream)]  # in parts, as lifted, and in tiles
        written += [4 * row_width(0)] * 2 if isinstance(self.stream, PointStream) else written
        needed = int((self.stream.count + around) * sum(written))
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            raise OutputError(
                f"the tiles need {needed / 1e9:,.1f} GB, the disk has {free / 1e9:,.1f} GB free",
                path=self.folder,
            )
        return self._save_tree(tree, margin)

    def _sample(self) -> tuple[Float32, float]:
        """Return a sample of positions, and the rows that each stands for."""
        size = {"count": self.stream.count, "size": _TREE_SAMPLE}
        files = self._run_parts(sample, "sample", size)
        sampler = Sampler(**size)
        sampler.limit = min([sampler.limit, *(int(load(path, "limit")[0]) for path in files)])
        for path in files:
            sampler.add(load(path, "points")[0])
        return sampler.result()

    def _save_tree(self, tree: KdTree, margin: float) -> Path:
        """Write a tree for tasks, and remember it for calls that continue."""
        cells = json.dumps(tree.to_json())
        path = self.parts / f"tree-{key_of([cells, margin])}.npz"
        save(path, {"cells": np.array(cells), "margin": np.array(margin)})
        self._begin({"key": self.key, "tree": path.name})
        return path

    def _tell_counts(self, files: Sequence[Path]) -> None:
        """Count the rows of all parts in the stream, which raises an `InputError` if none is finite."""
        tallies = self.stream.tallies()
        for tally in tallies:
            tally.clear()
        for path in files:
            for tally, counts in zip(tallies, load(path, "tallies")[0], strict=True):
                tally.join(counts)
        self.stream.all_notes()

    def _cut_again(self, files: Sequence[Path]) -> dict[int, KdTree]:
        """Plan cuts of the tiles that exceed `tile_rows`."""
        parts = {}
        counts = _count_rows(files)[..., 0]
        for tile in np.flatnonzero(counts.sum(axis=0) > self.tile_rows).tolist():
            rows = _load_rows(_select(files, counts[:, tile]), tile_name(tile))
            tree = cut_tree(_get_positions(rows), 1.0, self.tile_rows)
            if tree.leaves > 1:
                parts[tile] = tree
        return parts

    def lift(self, tree: Path, files: Sequence[Path], config: LiftConfig) -> list[Path]:
        """Lift the points of each tile with its halo; return the files of the tiles."""
        given = {"config": asdict(config), "only": self._near, "tree": tree}
        return self._run_each(lifted, "lift", self._near, files, given)

    def _run_each(
        self,
        function: Callable[[Given], Arrays],
        stage: str,
        tiles: list[int] | None,
        files: Sequence[Path],
        given: Given,
    ) -> list[Path]:
        """Run a function for tiles, None for all; it gets the files that have rows of a tile or its halo."""
        counts = _count_rows(files)
        calls = [
            (
                {
                    "key": self.key,
                    "tile": tile,
                    "core": _select(files, counts[:, tile, 0]),
                    "halo": _select(files, counts[:, tile, 1]),
                    **given,
                },
                int(counts[:, tile, 0].sum()),
            )
            for tile in (range(counts.shape[1]) if tiles is None else tiles)
        ]
        return self.workers.map(function, stage, calls, {"folder": self.folder})

    def gather(self, tree: Path, files: Sequence[Path]) -> list[Named]:
        """Write the rows of each tile and of its halo; return the manifest's entries."""
        some = None if self.mended is None else self.mended[1]
        written = self._run_each(gathered, "write", some, files, {})
        bounds = np.array([load(path, "bounds")[0] for path in written])
        low = bounds[:, 0].min(axis=0)
        high = bounds[:, 1].max(axis=0)
        boxes = _load_tree(tree)[0].boxes()
        tiles = []
        for path, box in zip(written, boxes if some is None else boxes[some], strict=True):
            (rows, halo), checks = (array.tolist() for array in load(path, "rows", "checks"))
            corners = np.clip(box, low, high).tolist()
            tiles.append(
                {"rows": rows, "halo": halo, "low": corners[0], "high": corners[1], "crc32": checks}
            )
        return tiles

    def finish(self, tree: Path, tiles: list[Named], manifest: Named) -> None:
        """Write the manifest, which makes the folder a store, and drop the steps."""
        cells, margin = _load_tree(tree)
        content = {
            "format": FORMAT,
            "version": VERSION,
            "key": self.key,
            "count": sum(tile["rows"] for tile in tiles),
            **manifest,
            "margin": margin,
            "cells": cells.to_json(),
            "tiles": tiles,
        }
        if self.mended is not None:
            content = dict(read_json(self.folder / MANIFEST))
            for index, tile in zip(self.mended[1], tiles, strict=True):
                content["tiles"][index]["crc32"] = tile["crc32"]
        with atomic_output(self.folder / MANIFEST, overwrite=True) as temporary:
            temporary.write_text(json.dumps(content) + "\n", encoding="utf-8", newline="\n")
        shutil.rmtree(self.parts)


def row_bytes(stream: Stream) -> int:
    """Return the bytes of a Gaussian or of a point to be lifted, which begin with its float32 position."""
    return (
        4 * row_width(stream.sh_degree)
        if isinstance(stream, SceneStream)
        else _POINT_DTYPE.itemsize
    )


def _can_be_sent(stream: Stream) -> bool:
    """Return whether workers can read a stream: it is small, and can be read from any row."""
    try:
        pickle.dump(stream, _Small())
    except (TypeError, AttributeError, OverflowError, pickle.PicklingError):
        return False
    return True


class _Small:
    """A file that takes few bytes and keeps none."""

    size = 0

    def write(self, data: Any) -> None:
        self.size += memoryview(data).nbytes
        if self.size > _SENT_BYTES:
            raise OverflowError


def _load_tree(path: Path) -> tuple[KdTree, float]:
    cells, margin = load(path, "cells", "margin")
    return KdTree.from_json(json.loads(str(cells))), float(margin)


def _count_rows(files: Sequence[Path]) -> Int:
    """Return the (files, tiles, 2) numbers of rows of each tile, and of its halo, in each file."""
    return np.array([load(path, "counts")[0] for path in files])


def _select(files: Sequence[Path], counts: Int) -> list[Path]:
    return [path for path, count in zip(files, counts, strict=True) if count]


def _get_positions(rows: Values) -> Float32:
    """Return the (n, 3) float32 positions with which rows begin."""
    return np.ascontiguousarray(rows["near"] if rows.dtype.names else rows[:, :3])


def _load_rows(files: Sequence[Path], name: str) -> Values:
    return np.concatenate([load(path, name)[0] for path in files])


def sample(given: Given) -> Arrays:
    """Sample the positions of a part.

    Args:
        given: `stream`; `part`, see `Stream.part`; `count` and `size`, of the `Sampler`.

    Returns:
        `points`, (n, 3), and the `limit` of their hashes.
    """
    sampler = Sampler(given["count"], given["size"])
    for points in given["stream"].part("positions", *given["part"]):
        sampler.add(points)
    return {"points": sampler.result()[0], "limit": np.array(sampler.limit)}


def cut(given: Given) -> Arrays:
    """Cut a part into tiles.

    Args:
        given: `stream`; `part`, see `Stream.part`; `tree`; `only`, the tiles to cut, None for all.

    Returns:
        What `_route` returns; `tallies`, the counts of each source.
    """
    stream = given["stream"]
    blocks = list[Values]()
    for block in stream.part("blocks", *given["part"]):
        if isinstance(stream, PointStream):
            far, colors = block
            points = np.empty(len(far), _POINT_DTYPE)
            points["near"] = stream.near(far)
            points["rgb"] = colors
            points["far"] = far
            blocks.append(points)
        else:
            blocks.append(packed(block))
    rows = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
    tallies = np.array([tally.counts() for tally in stream.tallies()])
    return {**_route(rows, given), "tallies": tallies}


def _route(rows: Values, given: Given) -> Arrays:
    """Return the rows of each tile and of its halo, called by the names of its files, if there are any.

    `counts`, (tiles, 2), has their numbers.
    """
    tree, margin = _load_tree(given["tree"])
    only = given["only"]
    made = Arrays()
    counts = np.zeros((tree.leaves, 2), np.int64)
    for tile, chosen in enumerate(tree.route(_get_positions(rows), margin)):
        if only is not None and tile not in only:
            continue
        counts[tile] = [len(some) for some in chosen]
        for name, some in zip((tile_name(tile), halo_name(tile)), chosen, strict=True):
            if len(some):
                made[name] = rows if len(some) == len(rows) else rows[some]
    return {**made, "counts": counts}


def lifted(given: Given) -> Arrays:
    """Lift a tile's points with those of its halo as neighbours.

    Args:
        given: `tile`; `config`, the fields of `LiftConfig`; `tree`, `only`, see `cut`; `core`, `halo`, the
            files of `cut` that have points of the tile and of its halo.

    Returns:
        What `_route` returns of the discs.
    """
    if not given["core"]:
        return _route(np.empty((0, row_width(0)), "<f4"), given)
    core = _load_rows(given["core"], tile_name(given["tile"]))
    halo = [load(path, halo_name(given["tile"]))[0] for path in given["halo"]]
    both = np.concatenate([core, *halo])
    discs, rows = lift_rows(both["far"], both["rgb"], LiftConfig(**given["config"]), telling)
    rows = rows[rows < len(core)]
    means = np.ascontiguousarray(core["near"][rows])
    kept = replace(discs.take(slice(0, len(rows))), means=means)
    return _route(packed(kept), given)


def gathered(given: Given) -> Arrays:
    """Write the files of a tile.

    Args:
        given: `folder`, of the tiles; `tile`; `core`, `halo`, the files that have rows of the tile and of its
            halo, in their order.

    Returns:
        `rows` and `checks` (CRC-32) of both files; `bounds`, (2, 3) of the tile's positions.
    """
    tile = given["tile"]
    folder = given["folder"]
    counts = [0, 0]
    checks = [0, 0]
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for kind, (which, name) in enumerate((("core", tile_name(tile)), ("halo", halo_name(tile)))):
        with (
            atomic_output(folder / PARTS / name, overwrite=True) as temporary,
            temporary.open("wb") as file,
        ):
            for path in given[which]:
                (rows,) = load(path, name)
                file.write(data := np.ascontiguousarray(rows).view(np.uint8).data)
                checks[kind] = zlib.crc32(data, checks[kind])
                counts[kind] += len(rows)
                if which == "core":
                    means = _get_positions(rows).astype(np.float64)
                    low = np.minimum(low, means.min(axis=0))
                    high = np.maximum(high, means.max(axis=0))
        os.replace(folder / PARTS / name, folder / name)
    return {"rows": np.array(counts), "checks": np.array(checks), "bounds": np.stack([low, high])}
