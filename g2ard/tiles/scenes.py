"""What tasks read and make: a tile, what stands around it, scenes and cameras in files of other tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Cameras
from g2ard.scene.prepared import PreparedScene, as_prepared, finite_rows_of
from g2ard.scene.splats import Splats
from g2ard.stages.simplify.pairs import fit_opacities
from g2ard.tiles.store import TileStore
from g2ard.tiles.task import Arrays, load

__all__ = [
    "Arguments",
    "Inputs",
    "Places",
    "arrays_of",
    "cameras_of",
    "cropped",
    "far_around",
    "joined",
    "scene_of",
    "small_scene",
    "tile_of",
    "with_surroundings",
    "within_halo",
]

Arguments = Mapping[str, Any]
Inputs = Mapping[str, Any]
Places = Mapping[str, Path]

_FIELDS = ("means", "quats", "scales", "logit_opacities", "sh0", "shN", "offset")

_OUTLINE, _BESIDE = 20_000, 8
"""Gaussians of a tile by whose means its images are cropped, and pixels left around them."""


def small_scene(files: Mapping[str, Path], mean: float | None) -> Splats:
    """A tile's Gaussians from what `merge` made, with opacities fitted to what views see where they looked.

    Args:
        files: "merged", and with views "again" of `look_again`.
        mean: of what the views saw, over all tiles; None without views.
    """
    small = scene_of(files["merged"], "scene")
    if mean is None:
        return small
    members, wanted = load(files["merged"], "members", "wanted")
    return fit_opacities(small, members, wanted, load(files["again"], "weight")[0], mean)


def scene_of(path: Path, name: str) -> Splats:
    """A scene that a task made."""
    return Splats(*load(path, *(f"{name}_{field}" for field in _FIELDS)))


def joined(parts: Sequence[Splats]) -> Splats:
    """Scenes of one offset as one, of the highest SH degree among them."""
    degree = max(part.sh_degree for part in parts)
    parts = [part.with_sh_degree(degree) for part in parts]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS[:-1]}
    return Splats(**arrays, offset=parts[0].offset)


def cameras_of(path: Path) -> Cameras:
    """Cameras that `g2ard.tiles.simplify` wrote."""
    viewmats, Ks, widths, heights = load(path, "viewmats", "Ks", "widths", "heights")
    return Cameras(viewmats, Ks, widths, heights, tuple(str(i) for i in range(len(viewmats))))


def tile_of(arguments: Arguments, inputs: Inputs, places: Places, *, sh: bool = True) -> PreparedScene:
    """A tile's Gaussians, with all bands or band 0; the first step finds the order that all others take."""
    known = inputs.get("own")
    scene = TileStore.open(places["store"]).read(arguments["tile"], sh=sh)
    prepared = finite_rows_of(scene)[0]
    if known is not None:
        prepared.restore(*load(known, "order", "bounds"))
    return prepared


def with_surroundings(core: Splats, arguments: Arguments, inputs: Inputs, places: Places) -> PreparedScene:
    """A tile's Gaussians first, then its halo, then coarse ones of all other tiles outside of that."""
    store = TileStore.open(places["store"])
    halo = store.read_halo(arguments["tile"], sh=False)
    parts = [core, halo, *far_around(store, arguments, inputs)]
    return as_prepared(joined([part.with_sh_degree(0) for part in parts if len(part)]))


def far_around(store: TileStore, arguments: Arguments, inputs: Inputs) -> list[Splats]:
    """Coarse Gaussians of all other tiles outside of the reach of a tile's halo."""
    parts = []
    for path, level in zip(inputs["coarse"], arguments["levels"], strict=True):
        if level:
            other = scene_of(path, level)
            parts.append(other.take(~within_halo(store, arguments["tile"], other.means)))
    return parts


def within_halo(store: TileStore, tile: int, means: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) whether positions lie in a tile's cell or within the margin around it."""
    low = np.array(store.tiles[tile].low) - store.margin
    high = np.array(store.tiles[tile].high) + store.margin
    return np.asarray(((means >= low) & (means <= high)).all(axis=1))


def cropped(
    cameras: Cameras, core: PreparedScene, settings: RasterSettings, beside: int = _BESIDE
) -> Cameras:
    """The parts of the images that show a tile, and some pixels `beside`: the others need not be drawn."""
    points = core.means[core.core.order[:: max(1, len(core) // _OUTLINE)]].astype(np.float64)
    boxes = []
    for view, (viewmat, K) in enumerate(zip(cameras.viewmats, cameras.Ks, strict=True)):
        x, y, z = viewmat[:3, :3] @ points.T + viewmat[:3, 3:]
        ahead = z > settings.near_of(view)
        size = np.array([cameras.widths[view], cameras.heights[view]])
        if not ahead.any():
            boxes.append((0, 0, 1, 1))
            continue
        u, v = K[:2, :2] @ np.stack([x[ahead], y[ahead]]) / z[ahead] + K[:2, 2:]
        low = np.clip(np.floor([u.min(), v.min()]) - beside, 0, size - 1)
        high = np.clip(np.ceil([u.max(), v.max()]) + beside, low + 1, size)
        boxes.append((*low, *high))
    left, top, right, bottom = np.array(boxes, np.int64).reshape(-1, 4).T
    Ks = cameras.Ks.copy()
    Ks[:, 0, 2] -= left
    Ks[:, 1, 2] -= top
    return replace(cameras, Ks=Ks, widths=right - left, heights=bottom - top)


def arrays_of(scene: Splats, name: str) -> Arrays:
    return {f"{name}_{field}": getattr(scene, field) for field in _FIELDS}
