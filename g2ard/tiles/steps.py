"""Simplification of one tile, step by step: each function reads files and makes arrays.

Between the steps tiles agree on a frame that costs are measured in, and on what each of them keeps
(`g2ard.tiles.simplify`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.cameras import Cameras
from g2ard.prepared import PreparedScene, as_prepared, finite_rows_of
from g2ard.splats import Splats
from g2ard.stages.render import RasterSettings, view_of
from g2ard.stages.simplify import SimplifyConfig, schedule, simplify
from g2ard.stages.simplify.pairs import emphasised, fit_opacities
from g2ard.tiles.store import TileStore
from g2ard.tiles.task import Arrays, load
from g2ard.visibility import CONVERGED, NEAR, ROUND, spread

__all__ = [
    "COARSE",
    "arrays_of",
    "coarse",
    "cropped",
    "far_around",
    "glance",
    "joined",
    "look",
    "look_again",
    "merge",
    "pair_plan",
    "run_costs",
    "scene_of",
    "small_scene",
    "tile_of",
    "within_halo",
]

COARSE = (32, 512)
"""How many times fewer Gaussians stand for a tile near the one that is looked at, and for one far."""

_DEEPER = 0.6
"""Share of the Gaussians that a tile is expected to keep down to which its merges are planned."""

_OUTLINE, _BESIDE = 20_000, 8
"""Gaussians of a tile by whose means its images are cropped, and pixels left around them."""

_THINNED = 8
"""Of so many rows in Morton order one is merged to coarse Gaussians, widened to stand for all."""

GONE = np.uint32(0xFFFFFFFF)
"""The cluster of a row that is dropped."""

Arguments = Mapping[str, Any]
Inputs = Mapping[str, Any]
Places = Mapping[str, Path]

_FIELDS = ("means", "quats", "scales", "logit_opacities", "sh0", "shN", "offset")


def coarse(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """A tile merged to a few Gaussians, near and far, and a fair sample of its rows."""
    scene = tile_of(arguments, places, check=True)
    config = replace(_config(arguments), keep_region=())  # for what other tiles see of this one
    some = _widened(scene.take(scene.core.order[::_THINNED]), _THINNED)
    near = simplify(some, max(1, len(scene) // COARSE[0]), method="fast", config=config).splats
    far = simplify(near, max(1, len(scene) // COARSE[1]), method="fast", config=config).splats
    rows = scene.core.order[:: COARSE[0]]
    return {**arrays_of(near, "near"), **arrays_of(far, "far"), **arrays_of(scene.take(rows), "sample")}


def glance(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """(V, T) Σ αT that some views get from each tile, of the tiles' coarse Gaussians."""
    parts = [scene_of(path, arguments["level"]) for path in inputs["coarse"]]
    tiles = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    scene = as_prepared(joined(parts))
    cameras = cameras_of(inputs["views"]).recentred(scene.offset)
    settings = RasterSettings(near=arguments["near"])
    weights = np.zeros((len(arguments["views"]), len(parts)))
    for row, view in enumerate(arguments["views"]):
        sums = _core.VisibilityAccumulator(scene.core)
        sums.add([view_of(cameras, view, settings)], settings, None)
        weights[row] = np.bincount(tiles, sums.by_row()[0], len(parts))
    return {"weights": weights}


def look(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """What the views see of a tile's Gaussians, where it stands in the whole scene.

    The views that have it in sight look sixteen at a time until the next sixteen find few Gaussians that were
    not seen before; their sums are raised to stand for all that have it in sight.
    """
    own = tile_of(arguments, places, sh=False)
    cameras = cameras_of(inputs["views"]).recentred(own.offset)
    here = cameras.take(arguments["views"])
    distance = np.median(np.linalg.norm(here.positions - own.core.origin, axis=1)) if len(here) else 0.0
    settings = RasterSettings(near=NEAR * float(distance) or None)
    here = cropped(here, own, settings)
    sums = _core.VisibilityAccumulator(_with_surroundings(own, arguments, inputs, places).core)
    stride = max(1, math.ceil(len(here) / ROUND))
    light, used, seen = np.asarray(arguments["light"]), [], 0
    for first in spread(stride):
        some = range(first, len(here), stride)
        sums.add([view_of(here, i, settings) for i in some], settings, None)
        used += list(some)
        before, seen = seen, int(np.count_nonzero(sums.by_row()[0][: len(own)]))
        if len(used) > ROUND and seen - before < CONVERGED * len(own):
            break
    share = light[used].sum() / arguments["all_light"] if used else 1.0
    weight, pixel_size = (values[: len(own)] for values in sums.by_row())
    weight = weight / np.float32(share or 1.0)
    pixel_size = pixel_size * np.float32(arguments["shrunk"])  # of a full image
    finite = pixel_size[np.isfinite(pixel_size) & (pixel_size > 0)]
    pixel = float(np.partition(finite, len(finite) // 2)[len(finite) // 2]) if len(finite) else math.nan
    frame = _core.TileFrame(*arguments["frame"]).with_views(
        pixel if finite.size else 1.0, 1.0, 1.0
    )  # sums read no floor
    tile = _merging(own, _config(arguments), frame, weight, pixel_size)
    return {
        "weight": weight,
        "pixel_size": pixel_size,
        "pixel": np.array(pixel),
        "sums": np.array(tile.sums()),
        "used": np.array(arguments["views"], np.int64)[used],
        "share": np.array(share or 1.0),
        "near": np.array(settings.near_of(0)),
    }


def run_costs(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """What merging along Morton order costs, a value for each gap between rows."""
    scene = tile_of(arguments, places, sh=False)
    return {"costs": _seen_tile(scene, arguments, inputs).run_costs()}


def pair_plan(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """Merges down to `runs` along Morton order, then pairs of neighbours, farther than the budget asks for.

    `costs` never falls: what a merge waits for costs no less than it.
    """
    scene = tile_of(arguments, places)
    config = _config(arguments).resolved("default")
    runs, expected = arguments["runs"], arguments["expected"]
    last = max(1, min(runs, round(_DEEPER * expected)))
    counts = schedule(runs, last, config.retention_of("default"), config.fold)
    of, a, b, costs = _seen_tile(scene, arguments, inputs).plan(runs, counts)
    return {"of": of, "a": a, "b": b, "costs": np.maximum.accumulate(costs) if len(costs) else costs}


def merge(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """The tile's Gaussians after the first `merges` of its plan, and what the views saw of their members."""
    scene = tile_of(arguments, places)
    runs, merges = arguments["runs"], arguments["merges"]
    of, a, b = load(inputs["plan"], "of", "a", "b")
    into = np.arange(runs)
    into[b[:merges]] = a[:merges]
    while not np.array_equal(into, further := into[into]):
        into = further
    clusters, name = np.unique(into, return_inverse=True)
    dropped = of == GONE
    of = np.where(dropped, GONE, name[np.where(dropped, 0, of)]).astype(np.uint32)
    out = _seen_tile(scene, arguments, inputs).assemble(of, len(clusters))
    small = Splats(
        means=out["means"].astype(np.float32),
        quats=out["quats"],
        scales=out["scales"],
        logit_opacities=out["logit_opacities"],
        sh0=np.ascontiguousarray(out["sh"][:, :1]),
        shN=np.ascontiguousarray(out["sh"][:, 1:]),
        offset=scene.offset,
    )
    kept, made = ~dropped, arrays_of(small, "scene")
    made["members"] = np.bincount(of[kept], minlength=len(small))
    if "look" in inputs:
        (weight,) = load(inputs["look"], "weight")
        made["wanted"] = np.bincount(of[kept], weight[scene.core.order][kept], len(small))
        made["unseen"] = np.array(np.count_nonzero(weight[scene.core.order][kept] == 0))
    made["clamped"] = np.array(out["clamped_opacities"])
    return made


def look_again(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """What the same views see of a tile's merged Gaussians."""
    core = as_prepared(scene_of(inputs["merged"], "scene").with_sh_degree(0))
    used, share, near = load(inputs["look"], "used", "share", "near")
    cameras = cameras_of(inputs["views"]).recentred(core.offset).take(used)
    settings = RasterSettings(near=float(near))
    cameras = cropped(cameras, core, settings)
    sums = _core.VisibilityAccumulator(_with_surroundings(core, arguments, inputs, places).core)
    sums.add([view_of(cameras, i, settings) for i in range(len(cameras))], settings, None)
    return {"weight": sums.by_row()[0][: len(core)] / np.float32(share)}


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


def tile_of(arguments: Arguments, places: Places, *, sh: bool = True, check: bool = False) -> PreparedScene:
    """A tile's Gaussians, with all bands or band 0; the first step checks the contents for all others."""
    scene = TileStore.open(places["store"]).read(arguments["tile"], sh=sh, check=check)
    return finite_rows_of(scene)[0]


def _config(arguments: Arguments) -> SimplifyConfig:
    return SimplifyConfig(**arguments["config"])


def _merging(
    scene: PreparedScene,
    config: SimplifyConfig,
    frame: _core.TileFrame,
    weight: NDArray[np.float32] | None,
    pixel_size: NDArray[np.float32] | None,
) -> _core.TileMerging:
    config = config.resolved("default")
    if weight is not None and pixel_size is not None:
        weight, pixel_size = emphasised(scene, weight, pixel_size, config)
    return _core.TileMerging(
        scene.core,
        frame,
        weight=weight,
        pixel_size=pixel_size,
        min_opacity=config.min_opacity_of("default"),
        neighbors=config.neighbors,
        geometric_weight=config.geometric_weight,
        dilation=config.dilation,
        max_growth=config.max_growth,
    )


def _seen_tile(scene: PreparedScene, arguments: Arguments, inputs: Inputs) -> _core.TileMerging:
    weight = pixel_size = None
    if "look" in inputs:
        weight, pixel_size = load(inputs["look"], "weight", "pixel_size")
    frame = _core.TileFrame(*arguments["frame"])
    return _merging(scene, _config(arguments), frame, weight, pixel_size)


def _with_surroundings(core: Splats, arguments: Arguments, inputs: Inputs, places: Places) -> PreparedScene:
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


def _widened(scene: Splats, times: int) -> Splats:
    """Rows that each stand for so many: their two longer axes cover as much."""
    longer = np.arange(3) != np.argmin(scene.scales, axis=1)[:, None]
    factor = np.where(longer, np.float32(math.sqrt(times)), np.float32(1))
    return replace(scene, scales=scene.scales * factor)


def arrays_of(scene: Splats, name: str) -> Arrays:
    return {f"{name}_{field}": getattr(scene, field) for field in _FIELDS}
