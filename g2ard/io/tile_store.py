"""A folder of tiles: fixed-size rows of float32, and a manifest.

`tiles.json` describes the tiles; `tile-00007.f32` has the rows of a tile, `halo-00007.f32` rows of its
neighbours around it. A row is little-endian float32: mean (3, relative to the offset), quaternion wxyz (4),
scales (3, linear), logit of opacity (1), sh0 (3), shN (K × 3, the channels of a coefficient adjacent).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from g2ard.arrays import Float, Float32, Values
from g2ard.config.choices import Axes, RenderModel
from g2ard.errors import InputError
from g2ard.io.detect import MANIFEST
from g2ard.io.jsonfile import Number, Place, Vector, Whole, checked, read_own
from g2ard.io.paths import about
from g2ard.io.sanitize import Raw
from g2ard.io.stream import PartsStream
from g2ard.io.types import Notes
from g2ard.scene.kdtree import KdTree
from g2ard.scene.splats import Splats

FORMAT = "g2ard tiles"
VERSION = 1

_ROWS_AT_ONCE = 1 << 16  # rows read at a time


def tile_name(index: int) -> str:
    return f"tile-{index:05}.f32"


def halo_name(index: int) -> str:
    return f"halo-{index:05}.f32"


def row_width(sh_degree: int) -> int:
    """Return the numbers per row: 14 + 3K for K higher SH coefficients."""
    return 14 + 3 * ((sh_degree + 1) ** 2 - 1)


def packed(splats: Splats) -> Float32:
    """Return (N, 14 + 3K) rows as stored in tiles."""
    rows = np.empty((len(splats), row_width(splats.sh_degree)), "<f4")
    rows[:, 0:3] = splats.means
    rows[:, 3:7] = splats.quats
    rows[:, 7:10] = splats.scales
    rows[:, 10] = splats.logit_opacities
    rows[:, 11:14] = splats.sh0[:, 0]
    rows[:, 14:] = splats.shN.reshape(len(splats), rows.shape[1] - 14)
    return rows


class Tile(msgspec.Struct, frozen=True):
    """Manifest entry of a tile.

    Args:
        rows: number of Gaussians whose mean lies in its box.
        halo: number of Gaussians of other tiles within the margin around the box.
        low, high: corners of the box, clipped to the bounds of the scene's means, relative to the offset.
        checks: CRC-32 of both files.
        index: its number, by the order of the manifest.
    """

    rows: Whole
    halo: Whole
    low: Vector
    high: Vector
    checks: tuple[int, int] = msgspec.field(name="crc32")
    index: int = -1


class _Manifest(msgspec.Struct):
    tiles: list[Tile]
    count: int
    sh_degree: Annotated[int, msgspec.Meta(ge=0, le=3)]
    offset: Vector
    margin: Number
    cells: Any
    notes: Notes
    key: str
    settings: dict[str, Any]
    render_model: RenderModel = "classic"
    up: Vector | None = None
    axes: Axes = "RDF"
    system: str | None = None


@dataclass(frozen=True, eq=False)
class TileStore:
    """A scene as tiles in a folder; `open` reads the manifest, `read` a tile.

    Args:
        folder: folder of the tiles.
        tiles: tiles in the order of the kd-tree.
        count: number of Gaussians, excluding halos.
        sh_degree: 0–3.
        offset: (3,) float64, world = means + offset.
        margin: reach of halos beyond a box's sides, scene units.
        tree: the kd-tree.
        notes: notes from ingestion.
        key: SHA-256 of everything that determines the content: source and settings.
        settings: the settings of ingestion.
        render_model, up, axes: see `Splats`.
        system: map system of the point clouds that it was lifted from, if they state one.
    """

    folder: Path
    tiles: tuple[Tile, ...]
    count: int
    sh_degree: int
    offset: Float
    margin: float
    tree: KdTree
    notes: Notes
    key: str
    settings: Mapping[str, Any]
    render_model: RenderModel = "classic"
    up: Vector | None = None
    axes: Axes = "RDF"
    system: str | None = None

    @classmethod
    def open(cls, folder: str | Path, *, complete: bool = True) -> TileStore:
        """Open the store in a folder.

        Args:
            complete: check the size of every file; contents are checked when they are read.

        Raises:
            InputError: the manifest is missing, malformed or of another version, or a file is missing or has
                another size.
        """
        folder = Path(folder)
        path = folder / MANIFEST
        if not path.is_file():
            raise InputError(f"no finished tiles ({MANIFEST} is missing)", path=folder)
        place = Place(path)
        manifest = checked(read_own(path, FORMAT, VERSION), _Manifest, place)
        try:
            values = msgspec.structs.asdict(manifest)
            tree = KdTree.from_json(values.pop("cells"))
        except (TypeError, ValueError, RecursionError) as error:
            raise place.to("cells").error(f"is not a tree ({error})") from error
        if tree.leaves != len(manifest.tiles):
            text = f"has {tree.leaves} leaves for {len(manifest.tiles)} tiles"
            raise place.to("cells").error(text)
        if sum(tile.rows for tile in manifest.tiles) != manifest.count:
            text = f"is {manifest.count}, which is not the sum of the tiles' rows"
            raise place.to("count").error(text)
        with_index = msgspec.structs.replace
        tiles = [with_index(tile, index=i) for i, tile in enumerate(manifest.tiles)]
        values["tiles"] = tuple(tiles)
        values["offset"] = np.array(manifest.offset)
        store = cls(folder, tree=tree, **values)
        if complete:
            for tile in tiles:
                store._check_sizes(tile)
        return store

    def _check_sizes(self, tile: Tile) -> None:
        self._check_size(tile_name(tile.index), tile.rows)
        self._check_size(halo_name(tile.index), tile.halo)

    def _check_size(self, name: str, rows: int) -> None:
        path = self.folder / name
        expected = self.row_bytes * rows
        with about(path):
            size = path.stat().st_size
        if size != expected:
            raise InputError(f"{size:,} bytes, but the manifest says {expected:,}", path=path)

    @property
    def row_bytes(self) -> int:
        """Bytes per row."""
        return 4 * row_width(self.sh_degree)

    @property
    def nbytes(self) -> int:
        """Bytes of all tiles and halos."""
        return self.row_bytes * sum(tile.rows + tile.halo for tile in self.tiles)

    def read(self, index: int, *, sh: bool = True) -> Splats:
        """Read a tile's own rows, in the order of the source.

        Args:
            index: tile number.
            sh: read the higher SH bands too; otherwise the result has SH degree 0.

        Raises:
            InputError: the file is missing, has another size, or its contents changed.
        """
        tile = self.tiles[index]
        return self._read(tile_name(index), tile.rows, tile.checks[0], sh)

    def read_halo(self, index: int, *, sh: bool = True) -> Splats:
        """Read the rows of a tile's halo, in the order of the source; `sh` as for `read`.

        Raises:
            InputError: as for `read`.
        """
        tile = self.tiles[index]
        return self._read(halo_name(index), tile.halo, tile.checks[1], sh)

    def rows(self, index: int) -> Float32:
        """Return a (rows, 14 + 3K) memory map of a tile's own rows; `check` verifies its contents.

        Raises:
            InputError: the file is missing or has another size.
        """
        tile = self.tiles[index]
        shape = (tile.rows, row_width(self.sh_degree))
        if not tile.rows:
            return np.empty(shape, np.float32)
        self._check_size(tile_name(index), tile.rows)
        return np.memmap(self.folder / tile_name(index), "<f4", "r", shape=shape)

    def check(self, index: int) -> None:
        """Verify the checksum of a tile's own rows.

        Raises:
            InputError: as for `read`.
        """
        rows = self.rows(index)
        crc = 0
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            block = rows[start : start + _ROWS_AT_ONCE]
            crc = zlib.crc32(block.data, crc)
        self._check_contents(tile_name(index), crc, self.tiles[index].checks[0])

    def damaged(self, *, contents: bool) -> list[int]:
        """Return the tiles of which a file is missing or has another size, or other `contents`."""
        found = []
        for tile in self.tiles:
            try:
                self._check_sizes(tile)
                if contents:
                    self.check(tile.index)
                    self.read_halo(tile.index, sh=False)
            except InputError:
                found.append(tile.index)
        return found

    def _check_contents(self, name: str, crc: int, expected: int) -> None:
        if crc != expected:
            raise InputError(
                "its contents changed after writing; remove it and run "
                "the command that wrote the tiles again",
                path=self.folder / name,
            )

    def _read(
        self,
        name: str,
        count: int,
        check: int,
        sh: bool,
    ) -> Splats:
        self._check_size(name, count)
        crc = 0

        def blocks() -> Iterator[Float32]:
            nonlocal crc
            with (self.folder / name).open("rb") as file:
                for start in range(0, count, _ROWS_AT_ONCE):
                    rows = min(_ROWS_AT_ONCE, count - start)
                    data = file.read(self.row_bytes * rows)
                    crc = zlib.crc32(data, crc)
                    yield np.frombuffer(data, "<f4").reshape(-1, self.row_bytes // 4)

        scene = self.unpacked(count, blocks(), sh=sh)
        self._check_contents(name, crc, check)
        return scene

    def unpacked(
        self,
        count: int,
        blocks: Iterable[Float32],
        *,
        sh: bool = True,
    ) -> Splats:
        """Return the scene of `count` packed rows, given in blocks; `sh` as for `read`."""
        rest = 0
        if sh:
            rest = (self.sh_degree + 1) ** 2 - 1
        raw = Raw.empty(count, rest)
        start = 0
        for rows in blocks:
            part = raw.take(slice(start, start + len(rows)))
            start += len(rows)
            part.means[:] = rows[:, :3]
            part.quats[:] = rows[:, 3:7]
            part.log_scales[:] = rows[:, 7:10]
            part.logit_opacities[:] = rows[:, 10]
            part.sh0[:, 0] = rows[:, 11:14]
            part.shN[:] = rows[:, 14 : 14 + 3 * rest].reshape(part.shN.shape)
        splats = raw.activated(self.render_model, self.offset.copy(), self.up)
        return replace(splats, axes=self.axes)

    def __len__(self) -> int:
        return self.count

    def positions(self) -> Iterator[Float32]:
        """Yield the (n, 3) means of each tile in order, memory-mapped, after verifying its contents."""
        for tile in self.tiles:
            self.check(tile.index)
            yield self.rows(tile.index)[:, :3]

    def take(self, index: Values) -> Splats:
        """Return rows by number, counted tile after tile."""
        index = np.asarray(index)
        starts = np.cumsum([0, *(tile.rows for tile in self.tiles)])
        tiles = np.searchsorted(starts, index, "right") - 1
        rows = np.empty((len(index), self.row_bytes // 4), "<f4")
        for tile in np.unique(tiles):
            here = tiles == tile
            rows[here] = self.rows(tile)[index[here] - starts[tile]]
        return self.unpacked(len(index), [rows])


class Stream(PartsStream):
    """Tiles of a folder as a scene, read one at a time."""

    def __init__(self, path: Path) -> None:
        store = TileStore.open(path)
        super().__init__(
            path,
            [tile.rows for tile in store.tiles],
            store.read,
            store.sh_degree,
            store.offset,
            [store.key],
            store.notes,
            store.render_model,
        )
        self.store = store
        self.up = store.up
        self.axes = store.axes

    def absolute(self) -> Stream:
        return Stream(self.path.absolute())
