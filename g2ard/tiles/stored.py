"""A scene in tiles as rows that are read where they are asked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from g2ard.scene.splats import Splats
from g2ard.tiles.store import TileStore, unpacked

__all__ = ["StoredScene"]


class StoredScene:
    """All tiles' own rows, tile after tile, of which `take` reads some; `positions` checks the contents.

    Args:
        store: the scene in tiles.
    """

    def __init__(self, store: TileStore) -> None:
        self.store, self.offset = store, store.offset
        self._starts = np.cumsum([0, *(tile.rows for tile in store.tiles)])

    def __len__(self) -> int:
        return self.store.count

    def positions(self) -> Iterator[NDArray[np.float32]]:
        """(n, 3) means of each tile in order, views of its file.

        Raises:
            InputError: a file's contents changed.
        """
        for tile in self.store.tiles:
            self.store.check(tile.index)
            yield self.store.rows(tile.index)[:, :3]

    def take(self, index: NDArray[np.integer]) -> Splats:
        """The rows of these numbers, in their order."""
        index = np.asarray(index)
        tiles = np.searchsorted(self._starts, index, "right") - 1
        rows = np.empty((len(index), self.store.row_bytes // 4), "<f4")
        for tile in np.unique(tiles):
            here = tiles == tile
            rows[here] = self.store.rows(tile)[index[here] - self._starts[tile]]
        return unpacked(rows, self.offset)
