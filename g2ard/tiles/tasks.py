"""Tasks (pure functions from files to one file), and the scenes and cameras in those files."""

from __future__ import annotations

import math
import time
import zipfile
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Values
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.io.tile_store import TileStore
from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Cameras
from g2ard.scene.prepared import PreparedScene, as_prepared, finite_rows_of
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.system.keys import UNKEYED, key_of

Arrays = dict[str, Values]
"""Output of a task: arrays by name, stored as one .npz file."""

Given = Mapping[str, Any]
"""Parameter of a task's function: what is given to it, by name, see `Task`."""

_SCENE_ARRAYS = (
    "means",
    "quats",
    "scales",
    "logit_opacities",
    "sh0",
    "shN",
    "offset",
    "render_model",
)

_TELL: ContextVar[Callable[[float], None]] = ContextVar("tell", default=lambda share: None)
"""Takes the finished share of the task that runs."""
_TELL_SECONDS = 0.5
"""Least time between two shares in a task's file."""

_CROP_SAMPLE = 20_000
"""Number of means that outline a tile for cropping."""

_CROP_MARGIN = 8
"""Pixels kept around these means."""

_OUTPUT_VERSION = 5
"""Version of the functions' output; raise it when a change makes earlier files unusable."""

_CORRUPT_FILE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    ValueError,
    EOFError,
    LookupError,
    RuntimeError,
)
"""Exceptions that numpy and zipfile raise for corrupt files."""


@dataclass(frozen=True)
class Task:
    """A function call whose result is kept in a file.

    The file's name contains a hash of the function, what is given to it and the names of its input files,
    which contain hashes in turn. An existing file is therefore always up to date.

    Args:
        function: "module:name" of a function (given and places) → arrays.
        given: JSON values, and output files of other tasks, by name.
        places: files, folders and streams whose content `given` determines; they may be moved.
        cost: amount of work in any common unit, for progress.
    """

    function: str
    label: str = field(metadata=UNKEYED)
    folder: Path = field(metadata=UNKEYED)
    given: Given = field(default_factory=dict)
    places: Given = field(default_factory=dict, metadata=UNKEYED)
    cost: int = field(default=1, metadata=UNKEYED)

    def absolute(self) -> Task:
        """Return the task for a process that may run in another folder."""
        own = {name: _absolute(getattr(self, name)) for name in ("folder", "given", "places")}
        return replace(self, **own)

    @property
    def key(self) -> str:
        """16 hexadecimal digits that identify the task's output."""
        return key_of([_OUTPUT_VERSION, self])

    @property
    def output(self) -> Path:
        return self.folder / f"{self.label}-{self.key}.npz"

    @property
    def done(self) -> bool:
        """Return whether the output file exists and has its table of contents."""
        return is_whole(self.output)

    @property
    def share_file(self) -> Path:
        """File in which a worker keeps the finished share of the task while it runs."""
        return self.folder / f".{self.output.stem}.share"

    @property
    def share(self) -> float:
        """Finished share, from 0 to 1, as the worker last told it."""
        with suppress(OSError, ValueError):
            return float(self.share_file.read_text("ascii"))
        return 0.0


def _absolute(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _absolute(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_absolute(one) for one in value]
    return value.absolute() if hasattr(value, "absolute") else value


def tell_share(share: float) -> None:
    """Tell how much of the running task is finished, from 0 to 1."""
    _TELL.get()(share)


def telling(stage: str, done: int, total: int, info: object = None) -> None:
    """Tell the progress of a function as the share of the running task."""
    if total:
        tell_share(done / total)


def run_task(task: Task, tell: Callable[[float], None] | None = None) -> Path:
    """Run a task unless it is done; the file is written atomically.

    Args:
        tell: called with the finished share; None writes it to the task's `share_file`.
    """
    if task.done:
        return task.output
    module, name = task.function.split(":")
    before = _TELL.set(tell or _share_writer(task.share_file))
    try:
        arrays: Arrays = getattr(import_module(module), name)({**task.given, **task.places})
    finally:
        _TELL.reset(before)
        task.share_file.unlink(missing_ok=True)
    save(task.output, arrays)
    return task.output


def save(path: Path, arrays: Arrays) -> None:
    """Write a task's file atomically."""
    with atomic_output(path, overwrite=True) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _share_writer(path: Path) -> Callable[[float], None]:
    told = -math.inf

    def tell(share: float) -> None:
        nonlocal told
        if (now := time.monotonic()) - told > _TELL_SECONDS:
            told = now
            path.write_text(f"{share:.3f}", encoding="ascii")

    return tell


def is_whole(path: Path) -> bool:
    """Return whether an .npz file exists and is complete: its table of contents is at the end."""
    try:
        with zipfile.ZipFile(path):
            return True
    except (OSError, ValueError, zipfile.BadZipFile):
        return False


def load(path: Path, *names: str) -> list[Values]:
    """Read arrays of a task's file."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return [arrays[name] for name in names]
    except _CORRUPT_FILE_ERRORS as error:
        raise InputError(
            "its contents changed after writing; remove it and run the same command again",
            path=path,
        ) from error


def scene_of(path: Path, name: str) -> Splats:
    """Read a scene from a task's file."""
    *arrays, model = load(path, *(f"{name}_{field}" for field in _SCENE_ARRAYS))
    means, quats, scales, logits, sh0, shN, offset = arrays
    return Splats(means, quats, scales, logits, sh0, shN, offset, model.item())


def cameras_of(path: Path) -> Cameras:
    """Read cameras written by `g2ard.tiles.sights.written`."""
    viewmats, Ks, widths, heights = load(path, "viewmats", "Ks", "widths", "heights")
    return Cameras(viewmats, Ks, widths, heights, tuple(str(i) for i in range(len(viewmats))))


def tile_of(given: Given, *, sh: bool = True) -> PreparedScene:
    """Read a tile's Gaussians with all SH bands or band 0, in the order that the first step stored."""
    scene = TileStore.open(given["store"]).read(given["tile"], sh=sh)
    prepared = finite_rows_of(scene)[0]
    if "own" in given:
        prepared.restore(*load(given["own"], "order", "bounds"))
    return prepared


def with_surroundings(core: Splats, given: Given) -> PreparedScene:
    """Join a tile's Gaussians with its halo and the coarse Gaussians of all other tiles beyond the halo."""
    store = TileStore.open(given["store"])
    around = [store.read_halo(given["tile"], sh=False), *far_around(store, given)]
    return as_prepared(join([part.with_sh_degree(0) for part in [core, *around] if len(part)]))


def far_around(store: TileStore, given: Given) -> list[Splats]:
    """Return coarse Gaussians of all other tiles beyond the reach of a tile's halo."""
    own = store.tiles[given["tile"]]
    parts = []
    low = np.array(own.low) - store.margin
    high = np.array(own.high) + store.margin
    for path, level in zip(given["coarse"], given["levels"], strict=True):
        if level:
            other = scene_of(path, level)
            within = ((other.means >= low) & (other.means <= high)).all(axis=1)
            parts.append(other.take(~within))
    return parts


def cropped(cameras: Cameras, core: PreparedScene, settings: RasterSettings) -> Cameras:
    """Crop the cameras' images to a tile, with a margin around it."""
    points = core.means[core.core.order[:: max(1, len(core) // _CROP_SAMPLE)]].astype(np.float64)
    boxes = []
    for view, (viewmat, K) in enumerate(zip(cameras.viewmats, cameras.Ks, strict=True)):
        x, y, z = viewmat[:3, :3] @ points.T + viewmat[:3, 3:]
        ahead = z > settings.near_of(view)
        size = np.array([cameras.widths[view], cameras.heights[view]])
        if not ahead.any():
            boxes.append((0, 0, 1, 1))
            continue
        u, v = K[:2, :2] @ np.stack([x[ahead], y[ahead]]) / z[ahead] + K[:2, 2:]
        low = np.clip(np.floor([u.min(), v.min()]) - _CROP_MARGIN, 0, size - 1)
        high = np.clip(np.ceil([u.max(), v.max()]) + _CROP_MARGIN, low + 1, size)
        boxes.append((*low, *high))
    corners = np.array(boxes, np.int64).reshape(-1, 2, 2)
    return cameras.cropped(corners[:, 0], corners[:, 1])


def arrays_of(scene: Splats, name: str) -> Arrays:
    return {f"{name}_{field}": np.asarray(getattr(scene, field)) for field in _SCENE_ARRAYS}
