"""Streaming a scene, or a coloured cloud, of any size into tiles, in memory that does not grow with it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from g2ard.errors import InputError, OutputError
from g2ard.io import kind, open_point_stream, open_stream
from g2ard.io.lock import LOCK, locked
from g2ard.io.stream import SceneStream
from g2ard.io.types import Note
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.stages.lift import LiftConfig
from g2ard.tiles.journal import JOURNAL, POINTS, Journal, clear, is_ours
from g2ard.tiles.pour import PointFeed, SceneFeed, lift_tiles, pour
from g2ard.tiles.store import MANIFEST, VERSION, TileStore

TILE_ROWS = 5_000_000
"""Rows of a tile at the most, unless told otherwise."""

MOST_TILES = 10_000
"""Tiles of a scene, about: each is two files, and every step goes over all of them."""

_BLOCK_BYTES = 1 << 24
"""Bytes of rows in memory at a time; some five copies of them are made on the way."""


def ingest(
    source: str | Path | Sequence[str | Path] | SceneStream,
    folder: str | Path,
    *,
    tile_rows: int = TILE_ROWS,
    block_rows: int | None = None,
    lift: LiftConfig | None = None,
    like: TileStore | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> TileStore:
    """Write a scene as tiles of at most `tile_rows` Gaussians, each with a halo of its neighbours.

    A kd tree cuts at medians of a sample of positions, along the longest side. A halo holds the Gaussians of
    other tiles that lie in the tile's box once its sides are moved outwards by 3 % of the median over tiles
    of √(ab), a and b a tile's two longer sides. Which tile a Gaussian comes to depends neither on the order
    of the rows nor on `block_rows`; within a tile the rows keep their order.

    The points of a cloud come to tiles in the same way, and are lifted tile by tile, each with its halo
    around, so that a point at a border has its neighbours.

    Where it was interrupted the same call goes on from the last block, and where all is done it returns.

    Args:
        source: a scene, or several as one, as `g2ard.io.open_stream` takes them; or coloured clouds,
            as `g2ard.io.open_point_stream` does; or a stream of a scene.
        folder: where the tiles go; absent, empty, or holding these tiles in part or whole.
        tile_rows: Gaussians of a tile at the most; only Gaussians of one position are never parted.
        block_rows: rows in memory at a time; None takes 16 MiB of them.
        lift: how points are lifted; None is `LiftConfig()`.
        like: tiles whose tree and margin are taken, however many rows they come to hold.
        overwrite: whether tiles of another scene, or of other settings, may be replaced.
        progress: told of rows done.
        say: told what was noticed.

    Raises:
        InputError: the source cannot be read, or `tile_rows` is less than 1 or a 10,000th of its rows.
        OutputError: the folder holds something else, another process writes there, or the disk has too
            little room.

    >>> import tempfile
    >>> import numpy as np
    >>> from g2ard.io import write_splats
    >>> from g2ard.scene.splats import Splats
    >>> work = Path(tempfile.mkdtemp())
    >>> row = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], 1)
    >>> write_splats(work / "row.ply", Splats.create(row, scales=np.ones((100, 3))))
    >>> store = ingest(work / "row.ply", work / "tiles", tile_rows=50)
    >>> [(tile.rows, tile.halo, tile.low[0], tile.high[0]) for tile in store.tiles]
    [(50, 0, 0.0, 50.0), (50, 0, 50.0, 99.0)]
    """
    folder = Path(folder)
    if tile_rows < 1 or (block_rows is not None and block_rows < 1):
        raise InputError(f"tile_rows and block_rows: expected at least 1, got {tile_rows}, {block_rows}")
    feed, sources = _feed(source, lift or LiftConfig())
    fewest = -(-feed.stream.count // MOST_TILES)
    if like is None and tile_rows < fewest:
        raise InputError(
            f"{feed.stream.path} is {feed.stream.count:,} rows, too many for tiles of {tile_rows:,}; "
            f"at least {fewest:,} each are needed",
            parameter="tile_rows",
        )
    settings: dict[str, Any] = {"tile_rows": tile_rows} if like is None else {"like": like.key}
    if isinstance(feed, PointFeed):
        settings["lift"] = asdict(feed.config)
    feed.settings, key = settings, _key(feed.stream.identity(), settings)
    done = _done(folder, key, overwrite)
    if done is not None:
        say(f"{folder}: holds these {plural(done.count, 'Gaussian')} already; skipped")
        return done
    _check_foreign(folder)
    with locked(folder):
        if (done := _done(folder, key, overwrite)) is not None:
            return done  # by another process in the meantime
        _check_tiles(folder, key, settings, overwrite, say)
        rows = block_rows or max(1, _BLOCK_BYTES // feed.row_bytes)
        try:
            if isinstance(feed, PointFeed):
                journal = lift_tiles(folder, key, feed, tile_rows, rows, progress, say)
            else:
                journal = pour(folder, key, feed, tile_rows, rows, progress, say, like)
        except InputError:
            clear(folder)
            raise
        notes = [*feed.stream.all_notes(), *([] if like else _overfull_note(journal, tile_rows))]
        manifest = {
            "sh_degree": feed.sh_degree,
            "offset": feed.stream.offset.tolist(),
            "source": sources,
            "settings": settings,
            "notes": [asdict(note) for note in notes],
        }
        journal.finish(manifest)
    return TileStore.open(folder)


def _feed(
    source: str | Path | Sequence[str | Path] | SceneStream, config: LiftConfig
) -> tuple[SceneFeed | PointFeed, list[str]]:
    """What is poured, and the names of where it comes from."""
    if isinstance(source, SceneStream):
        return SceneFeed(source), [str(source.path)]
    sources: list[str | Path] = [source] if isinstance(source, str | Path) else list(source)
    names = [str(path) for path in sources]
    if sources and all(kind(path) == "points" for path in sources):
        return PointFeed(open_point_stream(sources), config), names
    return SceneFeed(open_stream(sources)), names


def _key(identity: list[Any], settings: dict[str, Any]) -> str:
    decisive = {"version": VERSION, "source": identity, **settings}
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()


def _done(folder: Path, key: str, overwrite: bool) -> TileStore | None:
    """The store, if it is this very one and whole; what is broken may be replaced if it was this one, or
    under `overwrite`."""
    if not (folder / MANIFEST).is_file():
        return None
    try:
        store = TileStore.open(folder)
    except InputError:
        if overwrite or _key_in(folder / MANIFEST) == key:
            return None
        raise
    return store if store.key == key else None


def _check_foreign(folder: Path) -> None:
    """Make the folder; refuse one that holds anything but tiles."""
    if folder.is_file():
        raise OutputError(f"{folder}: is a file; a folder is to be written there")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise OutputError(f"{folder}: cannot write there: {error.strerror}") from error
    foreign = sorted(name for name in names if not (is_ours(name) or name == LOCK))
    if foreign:
        raise OutputError(f"{folder}: holds {foreign[0]}, which is no part of tiles; name another folder")


def _check_tiles(folder: Path, key: str, settings: dict[str, Any], overwrite: bool, say: Say) -> None:
    """Refuse all but the beginnings of these very tiles, and clear away what is no use to go on from."""
    found = (folder / MANIFEST, folder / JOURNAL, folder / POINTS / JOURNAL)
    manifest, *begun = [_key_in(path) for path in found]
    known = {each for each in (manifest, *begun) if each is not None}
    if known - {key} and not overwrite:
        raise OutputError(
            f"holds tiles of another scene or of other settings{_differing(found, settings)}",
            path=folder,
            hint="{overwrite=True} replaces it",
        )
    if manifest == key:
        say(f"{folder}: its tiles are damaged; written anew")
    if manifest is not None or known != {key}:
        clear(folder)


def _differing(found: Sequence[Path], settings: dict[str, Any]) -> str:
    """Which settings of a manifest or journal are other ones, in brackets; nothing where none is."""
    for path in found:
        with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):
            theirs = dict(json.loads(path.read_text(encoding="utf-8"))["settings"])
            names = [name for name in {**theirs, **settings} if theirs.get(name) != settings.get(name)]
            told = [f"{name} {theirs.get(name)}, not {settings.get(name)}" for name in names]
            return f" ({'; '.join(told)})" if told else ""
    return ""


def _key_in(path: Path) -> str | None:
    """The key in a manifest or journal; "" where it cannot be read, None where there is none."""
    if not path.is_file():
        return None
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))["key"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""


def _overfull_note(journal: Journal, tile_rows: int) -> list[Note]:
    over = sum(count > tile_rows for count in journal.tiles.rows)
    text = f"{plural(over, 'tile')} of more than {tile_rows:,} Gaussians: many share one position"
    return [Note("overfull_tiles", over, text)] if over else []
