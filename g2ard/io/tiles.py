"""Reader for folders of tiles (`g2ard ingest`) as scenes."""

from pathlib import Path

from g2ard.io.stream import PartsStream
from g2ard.io.tile_store import TileStore


class Stream(PartsStream):
    """Tiles, read one at a time."""

    def __init__(self, path: Path) -> None:
        store = TileStore.open(path)
        counts = [tile.rows for tile in store.tiles]
        parts = counts, store.read, store.sh_degree, store.offset
        super().__init__(path, *parts, [store.key], store.notes, store.render_model)
        self.up = store.up
