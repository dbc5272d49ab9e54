"""Journal of partially written tiles; an interruption costs at most one block."""

from __future__ import annotations

import json
import os
import re
import shutil
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import hidden_name
from g2ard.io.detect import JOURNAL, MANIFEST, POINTS
from g2ard.io.jsonfile import Place, checked, read_json
from g2ard.io.tile_store import FORMAT, VERSION, halo_name, tile_name
from g2ard.scene.kdtree import KdTree, Points

_TILE_FILE = re.compile(r"(tile|halo)-\d{5,}\.f32|\.?(tiles|journal)\.json(\.new)?|\.points")


def is_tile_file(name: str) -> bool:
    """Return whether a file or folder of this name belongs to tiles, complete or partial."""
    return _TILE_FILE.fullmatch(name) is not None


def clear(folder: Path) -> None:
    """Remove all files that belong to tiles, the manifest first."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name != MANIFEST):
        if path.is_dir() and path.name == POINTS:
            shutil.rmtree(path)
        elif is_tile_file(path.name):
            path.unlink()


def _write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON atomically."""
    temporary = path.with_name(hidden_name(path.name, ".new"))
    temporary.write_text(json.dumps(content) + "\n", encoding="utf-8", newline="\n")
    os.replace(temporary, path)


@dataclass
class _Files:
    """Row counts and checksums of the written files of one kind."""

    rows: list[int]
    checks: list[int]


@dataclass
class _Saved:
    """Content of a journal.json."""

    key: str
    cells: Any
    margin: float
    next_row: int
    tally: dict[str, Any]
    low: list[float]
    high: list[float]
    tiles: _Files
    halos: _Files
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class Journal:
    """The tiles of a scene while they are written.

    `save` runs after the rows are written, so the journal never names more than the files hold. `cut` removes
    the excess after an interruption.

    Args:
        key: hash of everything that determines their content.
        tally: a dataclass of counts gathered while reading the source.
        settings: settings behind `key`, for error messages.
        next_row: first row of the source that is not in its tile yet.
    """

    folder: Path
    key: str
    tree: KdTree
    margin: float
    row_bytes: int
    tally: Any
    settings: dict[str, Any]
    next_row: int = 0
    low: list[float] = field(default_factory=lambda: [np.inf] * 3)
    high: list[float] = field(default_factory=lambda: [-np.inf] * 3)
    tiles: _Files = field(init=False)
    halos: _Files = field(init=False)

    def __post_init__(self) -> None:
        count = self.tree.leaves
        self.tiles, self.halos = (_Files([0] * count, [0] * count) for _ in range(2))

    @classmethod
    def open(cls, folder: Path, row_bytes: int, tally: type[Any]) -> Journal | None:
        """Read the journal of a folder, or return None without one."""
        path = folder / JOURNAL
        if not path.is_file():
            return None
        place = Place(path)
        saved = checked(read_json(path), _Saved, place)
        try:
            tree = KdTree.from_json(saved.cells)
        except (TypeError, ValueError, RecursionError) as error:
            raise place.to("cells").error(f"is not a tree ({error})") from error
        counts = checked(saved.tally, tally, place.to("tally"))
        journal = cls(
            folder, saved.key, tree, saved.margin, row_bytes, counts, saved.settings, saved.next_row
        )
        journal.low, journal.high, journal.tiles, journal.halos = (
            saved.low,
            saved.high,
            saved.tiles,
            saved.halos,
        )
        for name, files in (("tiles", saved.tiles), ("halos", saved.halos)):
            if not len(files.rows) == len(files.checks) == tree.leaves:
                raise place.to(name).error(f"has {len(files.rows)} of {tree.leaves}")
        return journal

    def cut(self) -> None:
        """Truncate files to the journal's row counts, and create missing empty ones."""
        for name, rows in self._named():
            path = self.folder / name
            with path.open("ab") as file:
                if file.tell() < rows * self.row_bytes:
                    raise InputError(f"{file.tell():,} bytes, fewer than the journal says", path=path)
                file.truncate(rows * self.row_bytes)

    def _named(self) -> list[tuple[str, int]]:
        names = [(tile_name(i), rows) for i, rows in enumerate(self.tiles.rows)]
        return names + [(halo_name(i), rows) for i, rows in enumerate(self.halos.rows)]

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
            self._append(self.tiles, index, tile_name(index), rows, core)
            self._append(self.halos, index, halo_name(index), rows, halo)

    def _append(
        self, files: _Files, index: int, name: str, rows: NDArray[Any], chosen: NDArray[np.intp]
    ) -> None:
        if not len(chosen):
            return
        data = (rows if len(chosen) == len(rows) else rows[chosen]).view(np.uint8).data
        try:
            with (self.folder / name).open("ab") as file:
                file.write(data)
        except OSError as error:
            raise OutputError(f"cannot write: {error.strerror or error}", path=self.folder / name) from error
        files.rows[index] += len(chosen)
        files.checks[index] = zlib.crc32(data, files.checks[index])

    def save(self) -> None:
        content = {
            "key": self.key,
            "settings": self.settings,
            "cells": self.tree.to_json(),
            "margin": self.margin,
            "next_row": self.next_row,
            "tally": asdict(self.tally),
            "low": self.low,
            "high": self.high,
            "tiles": asdict(self.tiles),
            "halos": asdict(self.halos),
        }
        _write_json(self.folder / JOURNAL, content)

    def finish(self, manifest: dict[str, Any]) -> None:
        """Write the manifest, which makes the folder a store, and remove the journal."""
        low, high = np.array(self.low), np.array(self.high)
        tiles = [
            {
                "rows": self.tiles.rows[i],
                "halo": self.halos.rows[i],
                "low": np.clip(box[0], low, high).tolist(),
                "high": np.clip(box[1], low, high).tolist(),
                "crc32": [self.tiles.checks[i], self.halos.checks[i]],
            }
            for i, box in enumerate(self.tree.boxes())
        ]
        content = {
            "format": FORMAT,
            "version": VERSION,
            "key": self.key,
            "count": sum(self.tiles.rows),
            **manifest,
            "margin": self.margin,
            "cells": self.tree.to_json(),
            "tiles": tiles,
        }
        _write_json(self.folder / MANIFEST, content)
        (self.folder / JOURNAL).unlink(missing_ok=True)
