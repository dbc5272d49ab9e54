"""Reader for folders of tiles (`g2ard ingest`) as scenes."""

from __future__ import annotations

from pathlib import Path

from g2ard.io.stream import PartsStream


def stream(path: Path) -> PartsStream:
    """Open tiles for reading one at a time."""
    from g2ard.tiles.store import TileStore

    store = TileStore.open(path)
    counts = [tile.rows for tile in store.tiles]
    return PartsStream(
        path,
        counts,
        store.read,
        store.sh_degree,
        store.offset,
        [store.key],
        store.notes,
        store.render_model,
    )
