"""Simplification of one tile, step by step: each function reads files and returns arrays
(`g2ard.tiles.tasks`).

Between steps the tiles agree on a common frame for costs and on how many Gaussians each keeps
(`g2ard.tiles.merging`). What is given to all or most of them:

- `store`, the folder of the tiled scene; `tile`, the number of the tile; `config`, the fields of `Default` or
  `Fast`; `frame`, the values of the common `_core.TileFrame`.
- `own`, the output of `coarse` for this tile (not for `coarse` itself); `coarse`, the same for every tile;
  `levels`, per tile the coarse scene ("near", "far") that represents it around this one, None for this tile.
- `cameras`, in world coordinates; `visibility`, the output of `visibility` for this tile, absent without
  views.

N counts the tile's rows with finite values; "ordered rows" are these in Morton order.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float32, Values
from g2ard.io.tile_store import TileStore
from g2ard.rendering.renderer import RasterSettings, view_of
from g2ard.rendering.visibility import NEAR, SampledVisibility, add_until_converged
from g2ard.scene.cameras import Cameras
from g2ard.scene.prepared import PreparedScene, as_prepared, finite_rows_of
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.simplify import Pairs, SimplifyConfig, simplify
from g2ard.stages.simplify.pairs import emphasised, splats_of
from g2ard.tiles.executor import Workers
from g2ard.tiles.tasks import (
    Arrays,
    Given,
    arrays_of,
    cameras_of,
    cropped,
    load,
    scene_of,
    tell_share,
    telling,
    tile_of,
    with_surroundings,
)

COARSE = (32, 512)
"""Reduction of a tile's coarse Gaussians for use near the rendered tile, and far from it."""

_COARSE_STRIDE = 8
"""Every n-th row in Morton order becomes a coarse Gaussian, widened to represent the rest."""

_SAMPLE = 250_000, COARSE[0]
"""Least number of rows on which views are planned, more than without tiles; and the most Gaussians that a row
of a larger scene stands for."""

GONE = np.uint32(0xFFFFFFFF)
"""Cluster number of a dropped row."""

_FRAME_SAMPLE = 1_000_000
"""Largest sample of Gaussians that determines a scene's frame."""


def coarse(given: Given) -> Arrays:
    """Merge a tile to a few Gaussians, near and far, and sample its rows.

    Args:
        given: `sampled`, the rows of which one is in the sample.

    Returns:
        Three scenes (`scene_of`): `near`, `far`, `sample`; `order`, (N,) the tile's rows in Morton order, and
        the `bounds` of that order.
    """
    scene = tile_of(given)
    # Regions to keep do not matter for other tiles' views.
    config = replace(_config(given), keep_region=(), keep_times=Pairs.keep_times)
    some = _widened(scene.take(scene.core.order[::_COARSE_STRIDE]), _COARSE_STRIDE)
    near = simplify(
        some, max(1, len(scene) // COARSE[0]), method="fast", config=config, progress=telling
    ).splats
    far = simplify(near, max(1, len(scene) // COARSE[1]), method="fast", config=config).splats
    rows = scene.core.order[:: given["sampled"]]
    return {
        **arrays_of(near, "near"),
        **arrays_of(far, "far"),
        **arrays_of(scene.take(rows), "sample"),
        "order": scene.core.order,
        "bounds": np.array(scene.core.bounds),
    }


def light(given: Given) -> Arrays:
    """Measure the light that views get from each tile, from coarse Gaussians.

    Args:
        given: `views`, numbers of V cameras; `level`, the coarse scene used for all tiles; `near`, the near
            plane, None for the renderer's default.

    Returns:
        `weights`, (V, T) float64 Σ αT².
    """
    parts = [scene_of(path, given["level"]) for path in given["coarse"]]
    tiles = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    scene = as_prepared(join(parts))
    cameras = cameras_of(given["cameras"]).recentred(scene.offset)
    settings = RasterSettings(antialiased=scene.antialiased, near=given["near"])
    weights = np.zeros((len(given["views"]), len(parts)))
    for row, view in enumerate(given["views"]):
        sums = _core.VisibilityAccumulator(scene.core)
        sums.add([view_of(cameras, view, settings)], settings, None)
        weights[row] = np.bincount(tiles, sums.by_row()[0], len(parts))
    return {"weights": weights}


def visibility(given: Given) -> Arrays:
    """Measure what the views see of a tile's Gaussians amid the whole scene.

    Views are rendered in rounds of sixteen until a round finds few new Gaussians; the sums are scaled up to
    represent all views.

    Args:
        given: `views`, numbers of the V usual views that see the
            tile; `light`, (V,) Σ αT² that each gets from it (`light`); `all_light`, its sum over all usual
            views; `others`, numbers of views of other kinds; `others_weight`, that of each; `shrunk`, the
            ratio of these images' width to the full width.

    Returns:
        `weight`, (N,) float32 Σ αT² over all views; `pixel_size`, (N,) float32 size of a full-image pixel,
        scene units, infinite if no view shows the row; `pixel`, the median of the finite ones, NaN if there
        are none; `sums`, (3,) of the kept rows' `emphasised` weights, for the frame; `used`,
        numbers of the rendered views; `share`, their part of `all_light`, by which `weight` was divided;
        `near`, their near plane.
    """
    own = tile_of(given, sh=False)
    cameras = cameras_of(given["cameras"]).recentred(own.offset)
    here = cameras.take(given["views"])
    distance = (
        np.median(np.linalg.norm(here.positions - own.core.origin, axis=1)) if len(here) else 0.0
    )
    settings = RasterSettings(antialiased=own.antialiased, near=NEAR * float(distance) or None)
    here = cropped(here, own, settings)
    amid = with_surroundings(own, given)
    sums = _core.VisibilityAccumulator(amid.core)
    used = _add_until_converged(sums, here, settings, len(own))
    share = np.asarray(given["light"])[used].sum() / given["all_light"] if used else 1.0
    weight, pixel_size = (values[: len(own)] for values in sums.by_row())
    weight = weight / np.float32(share or 1.0) + _of_others(own, amid, cameras, settings, given)
    pixel_size = pixel_size * np.float32(given["shrunk"])  # in pixels of the full image
    pixel = _median(pixel_size[np.isfinite(pixel_size) & (pixel_size > 0)])
    unit, _, *others = given["frame"]  # with the tile's own pixel size
    frame = _core.TileFrame(unit, 1.0 if math.isnan(pixel) else pixel, *others)
    tile = _merging(own, _config(given), frame, SampledVisibility(weight, pixel_size))
    return {
        "weight": weight,
        "pixel_size": pixel_size,
        "pixel": np.array(pixel),
        "sums": np.array(tile.sums()),
        "used": np.array(given["views"], np.int64)[used],
        "share": np.array(share or 1.0),
        "near": np.array(settings.near_of(0)),
    }


def _add_until_converged(
    sums: _core.VisibilityAccumulator, cameras: Cameras, settings: RasterSettings, rows: int
) -> list[int]:
    """Add rounds of views until one finds few new of the first `rows` Gaussians; return the views."""

    def add(views: range) -> int:
        sums.add([view_of(cameras, i, settings) for i in views], settings, None)
        tell_share((views.start + 1) / views.step)
        return int(np.count_nonzero(sums.by_row()[0][:rows]))

    return [view for views in add_until_converged(add, len(cameras), rows) for view in views]


def _median(values: Float32) -> float:
    """Return the upper median, NaN without values."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else math.nan


def run_costs(given: Given) -> Arrays:
    """Compute the costs of merging along Morton order.

    Args:
        given: `mean_run`, the mean number of rows of a run, over all tiles.

    Returns:
        `costs`, (R − 1,) float32, one per gap between the R ordered rows that a renderer draws.
    """
    scene = tile_of(given, sh=False)
    return {"costs": _seen_tile(scene, given).run_costs(given["mean_run"])}


def pair_plan(given: Given) -> Arrays:
    """Plan merges to runs of Morton order, then of neighbouring pairs, beyond what the budget needs.

    Args:
        given: `runs`, the number of runs; `last`, the Gaussians that remain after all merges; `costs`, the
            output of `run_costs`.

    Returns:
        `of`, (N,) uint32 the run of each ordered row, or `GONE`; `a`, `b`, (M,) merges in order: run b joins
        run a; `costs`, (M,) float32, each at least that of the merge before, because merges must be done in
        order.
    """
    scene = tile_of(given)
    config = _config(given)
    runs = given["runs"]
    last = given["last"]
    counts = config.rounds(runs, last)
    tile = _seen_tile(scene, given)
    of, a, b, costs = tile.plan(runs, counts, load(given["costs"], "costs")[0])
    return {
        "of": of,
        "a": a,
        "b": b,
        "costs": np.maximum.accumulate(costs) if len(costs) else costs,
    }


def merge(given: Given) -> Arrays:
    """Apply the first merges of a tile's plan.

    Args:
        given: `runs`, as for `pair_plan`; `plan`, its output; `merges`, the number to apply; `faint`, the
            number of rows to keep that no renderer draws.

    Returns:
        `scene`, n = runs − merges + faint Gaussians (`scene_of`), opacities unfitted; `parents`, (N,) int32,
        the Gaussian of each row, −1 for dropped ones; `members`, (n,) rows merged into each; `clamped`, the
        number of clamped opacities; with views also `wanted`, (n,) Σ αT² of the members, and `unseen`, the
        number of rows that no view sees.
    """
    scene = tile_of(given)
    runs = given["runs"]
    merges = given["merges"]
    of, a, b = load(given["plan"], "of", "a", "b")
    into = np.arange(runs)
    into[b[:merges]] = a[:merges]
    while not np.array_equal(into, further := into[into]):
        into = further
    clusters, name = np.unique(into, return_inverse=True)
    dropped = of == GONE
    of = np.where(dropped, GONE, name[np.where(dropped, 0, of)]).astype(np.uint32)
    out = _seen_tile(scene, given).assemble(of, len(clusters))
    small = splats_of(scene, out)
    if faint := np.flatnonzero(dropped)[: given["faint"]].tolist():
        of[faint] = np.arange(len(small), len(small) + len(faint))
        dropped[faint] = False
        small = join([small, scene.take(scene.core.order[faint])])
    parents = np.empty(len(scene), np.int32)
    parents[scene.core.order] = of.view(np.int32)  # GONE is −1
    return _merged(scene, small, parents, out["clamped_opacities"], given)


def reduce(given: Given) -> Arrays:
    """Simplify a tile as a scene of its own, by a method that has steps which tiles do not share.

    Args:
        given: `method`, the fields of its config; `count`, the Gaussians to keep; `final`, those that further
            rounds keep.

    Returns:
        What `merge` returns; also `protected`, (n,) bool.
    """
    scene = tile_of(given)
    config = SimplifyConfig(**given["method"])
    seen = _visibility(given)
    final = given["final"]
    done = simplify(
        scene, given["count"], config=config, visibility=seen, final_budget=final, progress=telling
    )
    clamped = done.report.clamped_opacities
    made = _merged(scene, done.splats, done.parents.astype(np.int32), clamped, given)
    return made | {"protected": done.protected}


def _merged(
    scene: PreparedScene, small: Splats, parents: Values, clamped: int, given: Given
) -> Arrays:
    """Return what `merge` returns; sums do not depend on the order of the tile's rows."""
    of = parents[scene.core.order]
    kept = of >= 0
    made = {**arrays_of(small, "scene"), "parents": parents, "clamped": np.array(clamped)}
    made["members"] = np.bincount(of[kept], minlength=len(small))
    if (seen := _visibility(given)) is not None:
        weight = seen.weight[scene.core.order][kept]
        made["wanted"] = np.bincount(of[kept], weight, len(small))
        made["unseen"] = np.array(np.count_nonzero(weight == 0))
    return made


def merged_visibility(given: Given) -> Arrays:
    """Measure what the same views see of a tile's merged Gaussians.

    Args:
        given: `others`, `others_weight`, as for `visibility`; `merged`, the output of `merge`.

    Returns:
        `weight`, (n,) float32 Σ αT², scaled like those of `visibility`.
    """
    core = as_prepared(scene_of(given["merged"], "scene").with_sh_degree(0))
    used, share, near = load(given["visibility"], "used", "share", "near")
    cameras = cameras_of(given["cameras"]).recentred(core.offset)
    settings = RasterSettings(antialiased=core.antialiased, near=float(near))
    amid = with_surroundings(core, given)
    weight = _sum_of(core, amid, cameras.take(used), settings) / np.float32(share)
    return {"weight": weight + _of_others(core, amid, cameras, settings, given)}


def _of_others(
    own: PreparedScene,
    amid: PreparedScene,
    cameras: Cameras,
    settings: RasterSettings,
    given: Given,
) -> Float32:
    """Return the weighted Σ αT² of a tile's Gaussians over views of other kinds."""
    weight = np.float32(given["others_weight"])
    return weight * _sum_of(own, amid, cameras.take(given["others"]), settings)


def _sum_of(
    own: PreparedScene, amid: PreparedScene, cameras: Cameras, settings: RasterSettings
) -> Float32:
    """Return Σ αT² of a tile's Gaussians, the first ones of `amid`, over views."""
    if not len(cameras):
        return np.zeros(len(own), np.float32)
    cameras = cropped(cameras, own, settings)
    sums = _core.VisibilityAccumulator(amid.core)
    sums.add([view_of(cameras, i, settings) for i in range(len(cameras))], settings, None)
    return sums.by_row()[0][: len(own)]


def _config(given: Given) -> Pairs:
    config = SimplifyConfig(**given["config"])
    assert isinstance(config, Pairs)
    return config


def _merging(
    scene: PreparedScene,
    config: Pairs,
    frame: _core.TileFrame,
    visibility: SampledVisibility | None,
) -> _core.TileMerging:
    seen = None if visibility is None else emphasised(scene, visibility, config)
    return _core.TileMerging(scene.core, frame, config, seen)


def _seen_tile(scene: PreparedScene, given: Given) -> _core.TileMerging:
    frame = _core.TileFrame(*given["frame"])
    return _merging(scene, _config(given), frame, _visibility(given))


def _visibility(given: Given) -> SampledVisibility | None:
    if "visibility" not in given:
        return None
    return SampledVisibility(*load(given["visibility"], "weight", "pixel_size"))


def _widened(scene: Splats, times: int) -> Splats:
    """Widen the two longer axes of rows so that each covers the area of `times` rows."""
    longer = np.arange(3) != np.argmin(scene.scales, axis=1)[:, None]
    factor = np.where(longer, np.float32(math.sqrt(times)), np.float32(1))
    return replace(scene, scales=scene.scales * factor)


def sample_stride(count: int) -> int:
    """Return the number of rows of which one is in the sample of a scene."""
    rows, most = _SAMPLE
    return int(np.clip(count // rows, 1, most))


class TiledRun:
    """Steps of a tiled simplification, of which the first, `coarse`, runs at once.

    Attributes:
        method: settings of the method.
        merging: those of the method that tiles share costs by: `fast`, otherwise `default`.
    """

    def __init__(self, store: TileStore, workers: Workers, config: SimplifyConfig):
        self.store = store
        self.workers = workers
        workers.folder.mkdir(parents=True, exist_ok=True)
        self.method = config
        merging = config if isinstance(config, Pairs) else config.turned("default")
        assert isinstance(merging, Pairs)
        self.merging = merging
        self.config = asdict(merging.resolved(antialiased=store.render_model == "antialiased"))
        self.sizes = [tile.rows for tile in store.tiles]
        self._common: list[dict[str, Any]] = [
            {"content": store.key, "tile": tile, "config": self.config}
            for tile in range(len(self.sizes))
        ]
        sampled = {"sampled": sample_stride(store.count)}
        self.coarse = self.each(coarse, "coarse", [sampled] * len(self.sizes))
        for common, path in zip(self._common, self.coarse, strict=True):
            common["own"] = path

    def each(
        self, function: Callable[[Given], Arrays], stage: str, per_tile: Iterable[Given]
    ) -> list[Path]:
        """Run a function for each tile; `per_tile` is what it gets besides what belongs to the tile."""
        given = ({**common, **own} for common, own in zip(self._common, per_tile, strict=True))
        calls = zip(given, self.sizes, strict=True)
        return self.workers.map(function, stage, calls, {"store": self.store.folder})

    @property
    def has_own_steps(self) -> bool:
        """Whether tiles merge by themselves, because each step moves what the next one joins."""
        return self.config["method"] == "fast" or self.config["morton_premerge_steps"] > 1

    def pairs_per_row(self, budget: int) -> float:
        """Return the Gaussians per row of the result from which neighbouring pairs merge."""
        ratio = self.merging.resolved(ratio=self.store.count / budget).morton_premerge_ratio
        assert ratio is not None
        return ratio

    def sample(self) -> Splats:
        return join([scene_of(path, "sample") for path in self.coarse])

    def sampled_frame(self) -> tuple[float, ...]:
        """Return the frame of a sample of the scene, without views."""
        sample = self.sample().with_sh_degree(0)
        every = -(-len(sample) // _FRAME_SAMPLE)
        scene, _ = finite_rows_of(sample.take(slice(None, None, every)))
        return tuple(_core.TileFrame.of_sample(scene.core, SimplifyConfig(**self.config)).values())
