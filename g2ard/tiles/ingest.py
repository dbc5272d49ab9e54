"""Ingestion: streaming a scene or coloured point cloud of any size into tiles, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from shutil import rmtree

from g2ard.config.checks import checks_arguments
from g2ard.config.choices import Named, RenderModel
from g2ard.errors import InputError, OutputError, require
from g2ard.io.atomic import drop_empty, drop_temporaries, parents_made
from g2ard.io.detect import MANIFEST, PARTS
from g2ard.io.jsonfile import Place, checked, read_json
from g2ard.io.lock import LOCK, check_unlocked, locked
from g2ard.io.source import Source, joined
from g2ard.io.stream import PointStream, SceneStream
from g2ard.io.tile_store import VERSION, TileStore
from g2ard.io.types import Note
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.stages.lift import LiftConfig, guessed_axes
from g2ard.system.keys import key_of
from g2ard.tiles.executor import Executor, run_here
from g2ard.tiles.writer import Pouring, Stream, clear, is_tile_file

Given = str | Path | Source | Sequence[str | Path] | SceneStream
"""One or more files of scenes or point clouds, or a scene."""

TILE_ROWS = 5_000_000
"""Default largest number of rows per tile."""

MOST_TILES = 10_000
"""Approximate largest number of tiles; each is two files, and every step visits all of them."""


@checks_arguments
def ingest(
    source: Given,
    folder: str | Path,
    *,
    tile_rows: int = TILE_ROWS,
    block_rows: int | None = None,
    lift: LiftConfig | None = None,
    render_model: RenderModel | None = None,
    overwrite: bool = False,
    runs: Executor = run_here,
    progress: Progress = silent,
    say: Say = unsaid,
) -> TileStore:
    """Write a scene as tiles of at most `tile_rows` Gaussians, each with a halo of its neighbours.

    A kd-tree cuts at medians of a sample of positions, along the longest side. The halo of a tile holds the
    Gaussians of other tiles within a margin around its box. The margin is 3 % of the median over tiles of
    √(ab), where a and b are a tile's two longer sides. The assignment to tiles depends neither on the order
    of the rows nor on `block_rows`; rows keep their order within a tile.

    Points of a point cloud are assigned in the same way and lifted tile by tile, together with the halo, so
    that points at a border have all their neighbours.

    If the tiles are complete, the call returns at once. A call that was interrupted or killed is continued.

    Args:
        source: one or more scenes as accepted by `g2ard.io.read_splats`, one or more coloured point clouds as
            accepted by `g2ard.io.read_points`, or a scene stream.
        folder: output folder: absent, empty, or with these tiles.
        tile_rows: maximum Gaussians per tile; exceeded only if more of them share one position.
        block_rows: rows of the parts that are read one at a time; None means 32 MiB of rows.
        lift: constants for lifting points; None means `LiftConfig()`.
        render_model: overrides what the files of scenes say.
        overwrite: replace tiles of another scene or of other settings, and damaged ones.
        runs: executor that reads parts and writes tiles; by default this process. It also reads sources that
            only one process can: formats that are read whole, and .e57.
        progress: called with the number of rows done.
        say: called with messages.

    Raises:
        InputError: the source cannot be read, or `tile_rows` is less than 1 or than a 10,000th of the rows.
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
    require("tile_rows", tile_rows, tile_rows >= 1, "at least 1")
    require("block_rows", block_rows, block_rows is None or block_rows >= 1, "at least 1")
    stream, sources = _opened(source, render_model)
    fewest = -(-stream.count // MOST_TILES)
    if tile_rows < fewest:
        raise InputError(
            f"{stream.count:,} rows are too many for tiles of {tile_rows:,}; "
            f"use at least {fewest:,} rows per tile",
            path=stream.path,
            parameter="tile_rows",
        )
    settings: Named = {"tile_rows": tile_rows}
    lift = lift or LiftConfig()
    if not isinstance(stream, SceneStream):
        settings["lift"] = asdict(lift)
    elif stream.render_model != "classic":
        settings["render_model"] = stream.render_model
    decisive = {"version": VERSION, "source": stream.identity(), **settings}
    key = key_of(decisive)
    store, damaged = _examine(folder, key, overwrite)
    if store is not None and not damaged:
        with suppress(OutputError):  # another call may be about to end
            check_unlocked(folder)  # removes the lock of a killed one
            drop_temporaries(folder, MANIFEST)
            rmtree(folder / PARTS, ignore_errors=True)
        say(f"{folder}: already holds these {plural(store.count, 'Gaussian')}; skipped")
        return store
    made = _made(folder)
    try:
        with locked(folder):
            if store is None:
                _check_tiles(folder, key, settings, overwrite, say)
                clear(folder, key)
            else:
                say(f"{folder}: {plural(len(damaged), 'tile')} damaged; writing again")
            try:
                pouring = Pouring(
                    *(folder, stream, key),
                    tile_rows=tile_rows,
                    rows=block_rows,
                    runs=runs,
                    mended=None if store is None else (store, damaged),
                    progress=progress,
                    say=say,
                )
                tree, files = pouring.cut()
                notes = [*stream.all_notes()]
                if not isinstance(stream, SceneStream):
                    files = pouring.lift(tree, files, lift)
                tiles = pouring.gather(tree, files)
                if over := sum(tile["rows"] > tile_rows for tile in tiles):
                    text = f"of more than {tile_rows:,} Gaussians: many share one position"
                    notes.append(Note("overfull_tiles", over, f"{plural(over, 'tile')} {text}"))
                pouring.finish(tree, tiles, _manifest(stream, sources, settings, notes, progress))
            except BaseException as error:
                kept = key if isinstance(error, KeyboardInterrupt) else None
                clear(folder, kept, complete=store is not None)
                raise
    finally:
        drop_empty(made)
    return TileStore.open(folder)


def _manifest(
    stream: Stream, sources: list[str], settings: Named, notes: list[Note], progress: Progress
) -> Named:
    """Describe what the tiles hold."""
    if isinstance(stream, PointStream):
        drawn: Named = {"sh_degree": 0, "render_model": "classic"}
        axes = stream.axes or guessed_axes(stream.sample, progress)
        stated: Named = {"axes": axes, "system": stream.system}
    else:
        drawn = {"sh_degree": stream.sh_degree, "render_model": stream.render_model}
        stated = {"axes": stream.axes, "up": stream.up}
    return {
        **drawn,
        "offset": stream.offset.tolist(),
        "source": sources,
        "settings": settings,
        "notes": [asdict(note) for note in notes],
        **{name: value for name, value in stated.items() if value is not None},
    }


def _opened(source: Given, render_model: RenderModel | None) -> tuple[Stream, list[str]]:
    """Open a source, and return the names of its files."""
    if isinstance(source, SceneStream):
        return source, [str(source.path)]
    several = [source] if isinstance(source, str | Path | Source) else source
    sources = [one if isinstance(one, Source) else Source(one, render_model) for one in several]
    return joined(sources), [str(one) for each in sources for one in (each, *each.others)]


def _examine(folder: Path, key: str, overwrite: bool) -> tuple[TileStore | None, list[int]]:
    """Return the store that has this key, if there is one, and its damaged tiles.

    `overwrite` checks contents. A broken manifest raises, unless it has this key or `overwrite` is set.
    """
    manifest = folder / MANIFEST
    if not manifest.is_file() or ((known := _key_in(manifest)) != key and overwrite):
        return None, []
    try:
        store = TileStore.open(folder, complete=known != key)
    except InputError:
        if known == key:
            return None, []
        raise
    return (store, store.damaged(contents=overwrite)) if known == key else (None, [])


def _made(folder: Path) -> list[Path]:
    """Create the folder, or reject one that holds anything but tiles; return the new folders."""
    if folder.is_file():
        raise OutputError("is a file; expected a folder", path=folder)
    try:
        made = parents_made(folder / MANIFEST)
        names = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise OutputError(f"cannot write: {error.strerror}", path=folder) from error
    foreign = sorted(name for name in names if not (is_tile_file(name) or name == LOCK))
    if foreign:
        raise OutputError(
            f"holds {foreign[0]}, which does not belong to tiles; choose another folder",
            path=folder,
        )
    return made


def _check_tiles(folder: Path, key: str, settings: Named, overwrite: bool, say: Say) -> None:
    """Reject tiles of another scene or other settings, unless they are replaced."""
    known = _key_in(folder / MANIFEST)
    if known not in (None, key) and not overwrite:
        raise OutputError(
            f"holds tiles of another scene or with other settings{_differing(folder / MANIFEST, settings)}",
            path=folder,
            hint="{overwrite=True} replaces it",
        )
    if known == key:
        say(f"{folder}: {MANIFEST} is damaged; writing all tiles again")


def _differing(manifest: Path, settings: Named) -> str:
    """Return the settings that differ from a manifest's, in brackets, or ""."""
    with suppress(InputError, LookupError):
        theirs = checked(read_json(manifest)["settings"], Named, Place(manifest))
        names = [name for name in {**theirs, **settings} if theirs.get(name) != settings.get(name)]
        differing = [f"{name} {theirs.get(name)} instead of {settings.get(name)}" for name in names]
        return f" ({'; '.join(differing)})" if differing else ""
    return ""


def _key_in(path: Path) -> str | None:
    """Return the key in a manifest: "" if unreadable, None if there is no file."""
    if not path.is_file():
        return None
    try:
        return str(read_json(path)["key"])
    except (InputError, KeyError):
        return ""
