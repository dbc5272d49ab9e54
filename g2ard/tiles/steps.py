"""Simplification of one tile, step by step: each function reads files and makes arrays (`g2ard.tiles.tasks`).

Between the steps tiles agree on a frame that costs are measured in, and on what each of them keeps
(`g2ard.tiles.merging`). What several steps take:

- arguments: `tile`, its number; `config`, the fields of a `SimplifyConfig`; `frame`, the values of the
  `_core.TileFrame` of all tiles; `levels`, for each tile by which of its coarse scenes ("near", "far") it
  stands beside this one, None for this one itself.
- inputs: `own`, what `coarse` made of this tile, for all steps but that one; `coarse`, the same of each tile;
  `views`, cameras in world coordinates; `look`, what `look` made of this tile, not there without views.
- places: `store`, the folder of the scene in tiles.

N rows are those of the tile with finite values, ordered rows the same in Morton order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from g2ard import _core
from g2ard.rendering.renderer import RasterSettings, view_of
from g2ard.rendering.visibility import CONVERGED, NEAR, ROUND, spread
from g2ard.scene.prepared import PreparedScene, as_prepared, finite_rows_of
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.simplify import SimplifyConfig, round_counts, simplify
from g2ard.stages.simplify.pairs import RowVisibility, emphasised
from g2ard.tiles.executor import Workers
from g2ard.tiles.store import TileStore
from g2ard.tiles.tasks import (
    Arguments,
    Arrays,
    Inputs,
    Places,
    Task,
    arrays_of,
    cameras_of,
    cropped,
    load,
    scene_of,
    tile_of,
    with_surroundings,
)

COARSE = (32, 512)
"""How many times fewer Gaussians stand for a tile near the one that is looked at, and for one far."""

_DEEPER = 0.6
"""Share of the Gaussians that a tile is expected to keep down to which its merges are planned."""

_THINNED = 8
"""Of so many rows in Morton order one is merged to coarse Gaussians, widened to stand for all."""

GONE = np.uint32(0xFFFFFFFF)
"""The cluster of a row that is dropped."""

_SAMPLED = 1_000_000
"""Gaussians of a scene by which its frame is found, at most."""


def coarse(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """A tile merged to a few Gaussians, near and far, and a fair sample of its rows.

    Args:
        arguments: `tile`, `config`.
        inputs: none.
        places: `store`.

    Returns:
        Three scenes (`scene_of`): `near`, `far`, `sample`; `order`, (N,) the tile's rows in Morton order, and
        `bounds` that it is found in.
    """
    scene = tile_of(arguments, inputs, places)
    config = replace(_config(arguments), keep_region=())  # for what other tiles see of this one
    some = _widened(scene.take(scene.core.order[::_THINNED]), _THINNED)
    near = simplify(some, max(1, len(scene) // COARSE[0]), method="fast", config=config).splats
    far = simplify(near, max(1, len(scene) // COARSE[1]), method="fast", config=config).splats
    rows = scene.core.order[:: COARSE[0]]
    return {
        **arrays_of(near, "near"),
        **arrays_of(far, "far"),
        **arrays_of(scene.take(rows), "sample"),
        "order": scene.core.order,
        "bounds": np.array(scene.core.bounds),
    }


def glance(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """What light some views get from each tile, of the tiles' coarse Gaussians.

    Args:
        arguments: `views`, numbers of V of the cameras; `level`, which of the coarse scenes, for all tiles;
            `near`, the near plane, None for the renderer's own.
        inputs: `coarse`, `views`.
        places: none.

    Returns:
        `weights`, (V, T) float64 Σ αT.
    """
    parts = [scene_of(path, arguments["level"]) for path in inputs["coarse"]]
    tiles = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    scene = as_prepared(join(parts))
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
    not seen before; their sums are raised to stand for all views.

    Args:
        arguments: `tile`, `config`, `frame`, `levels`; `views`, numbers of the V that have the tile in sight;
            `light`, (V,) Σ αT that each of them gets from it, in the same order (`glance`); `all_light`, the
            sum of that over all views; `shrunk`, the width of these images over that of the full ones.
        inputs: `coarse`, `views`.
        places: `store`.

    Returns:
        `weight`, (N,) float32 Σ αT over all views; `pixel_size`, (N,) float32 of a full image there, scene
        units, infinite where no view shows the row; `pixel`, the median of those that are known, NaN where
        none is; `sums`, (2,) `emphasised` weight and mass of what is kept, for the frame's floor; `used`,
        numbers of the views that looked; `share`, the part of `all_light` that they have, which `weight` was
        divided by; `near`, their near plane.
    """
    own = tile_of(arguments, inputs, places, sh=False)
    cameras = cameras_of(inputs["views"]).recentred(own.offset)
    here = cameras.take(arguments["views"])
    distance = np.median(np.linalg.norm(here.positions - own.core.origin, axis=1)) if len(here) else 0.0
    settings = RasterSettings(near=NEAR * float(distance) or None)
    here = cropped(here, own, settings)
    sums = _core.VisibilityAccumulator(with_surroundings(own, arguments, inputs, places).core)
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
    frame = _with_pixel_size(arguments["frame"], pixel if finite.size else 1.0)
    tile = _merging(own, _config(arguments), frame, RowVisibility(weight, pixel_size))
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
    """What merging along Morton order costs.

    Args:
        arguments: `tile`, `config`, `frame`.
        inputs: `look`.
        places: `store`.

    Returns:
        `costs`, (R − 1,) float32, one for each gap between the R ordered rows that a renderer draws.
    """
    scene = tile_of(arguments, inputs, places, sh=False)
    return {"costs": _seen_tile(scene, arguments, inputs).run_costs()}


def pair_plan(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """Merges down to runs of Morton order, then pairs of neighbours, farther than the budget asks for.

    Args:
        arguments: `tile`, `config`, `frame`; `runs`, down to how many; `expected`, how many Gaussians
            of it the budget is expected to leave.
        inputs: `look`; `costs`, what `run_costs` made.
        places: `store`.

    Returns:
        `of`, (N,) uint32 the run of each ordered row, or `GONE`; `a`, `b`, (M,) merges in their order: run b
        joins run a; `costs`, (M,) float32 of each, or of the dearest before it if that is more: no merge may
        be done without those before it.
    """
    scene = tile_of(arguments, inputs, places)
    config = _config(arguments).resolved("default")
    runs, expected = arguments["runs"], arguments["expected"]
    last = max(1, min(runs, round(_DEEPER * expected)))
    counts = round_counts(runs, last, config.retention_of("default"), config.fold)
    tile = _seen_tile(scene, arguments, inputs)
    of, a, b, costs = tile.plan(runs, counts, load(inputs["costs"], "costs")[0])
    return {"of": of, "a": a, "b": b, "costs": np.maximum.accumulate(costs) if len(costs) else costs}


def merge(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """The tile's Gaussians after the first merges of its plan, and what the views saw of their members.

    Args:
        arguments: `tile`, `config`, `frame`; `runs`, as for `pair_plan`; `merges`, how many of the plan's.
        inputs: `plan`, what `pair_plan` made; `look`.
        places: `store`.

    Returns:
        `scene`, n = runs − merges Gaussians (`scene_of`), opacities not fitted yet; `members`, (n,) rows that
        each stands for; with views `wanted`, (n,) Σ αT of those, and `unseen`, how many rows no view sees;
        `clamped`, how many opacities were.
    """
    scene = tile_of(arguments, inputs, places)
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
    """What the same views see of a tile's merged Gaussians.

    Args:
        arguments: `tile`, `levels`.
        inputs: `coarse`, `views`, `look`; `merged`, what `merge` made.
        places: `store`.

    Returns:
        `weight`, (n,) float32 Σ αT, raised as those of `look` were.
    """
    core = as_prepared(scene_of(inputs["merged"], "scene").with_sh_degree(0))
    used, share, near = load(inputs["look"], "used", "share", "near")
    cameras = cameras_of(inputs["views"]).recentred(core.offset).take(used)
    settings = RasterSettings(near=float(near))
    cameras = cropped(cameras, core, settings)
    sums = _core.VisibilityAccumulator(with_surroundings(core, arguments, inputs, places).core)
    sums.add([view_of(cameras, i, settings) for i in range(len(cameras))], settings, None)
    return {"weight": sums.by_row()[0][: len(core)] / np.float32(share)}


def _config(arguments: Arguments) -> SimplifyConfig:
    return SimplifyConfig(**arguments["config"])


def _merging(
    scene: PreparedScene,
    config: SimplifyConfig,
    frame: _core.TileFrame,
    visibility: RowVisibility | None,
) -> _core.TileMerging:
    config = config.resolved("default")
    seen = None if visibility is None else emphasised(scene, visibility, config)
    return _core.TileMerging(scene.core, frame, config, seen)


def _with_pixel_size(frame: Sequence[float], pixel_size: float) -> _core.TileFrame:
    """A frame with a tile's own size of a pixel where no view tells it."""
    unit, _, floor, exponent, usual = frame
    return _core.TileFrame(unit, pixel_size, floor, exponent, usual)


def _seen_tile(scene: PreparedScene, arguments: Arguments, inputs: Inputs) -> _core.TileMerging:
    seen = RowVisibility(*load(inputs["look"], "weight", "pixel_size")) if "look" in inputs else None
    return _merging(scene, _config(arguments), _core.TileFrame(*arguments["frame"]), seen)


def _widened(scene: Splats, times: int) -> Splats:
    """Rows that each stand for so many: their two longer axes cover as much."""
    longer = np.arange(3) != np.argmin(scene.scales, axis=1)[:, None]
    factor = np.where(longer, np.float32(math.sqrt(times)), np.float32(1))
    return replace(scene, scales=scene.scales * factor)


class TiledRun:
    """What all steps of a simplification in tiles share."""

    def __init__(self, store: TileStore, workers: Workers, config: SimplifyConfig):
        self.store, self.workers = store, workers
        workers.folder.mkdir(parents=True, exist_ok=True)
        self.config = asdict(config.resolved("default"))
        self.sizes = [tile.rows for tile in store.tiles]
        self.coarse: list[Path] = []

    def each(
        self,
        function: str,
        stage: str,
        *,
        frame: tuple[float, ...] | None = None,
        per_tile: list[dict[str, Any]] | None = None,
        inputs: list[dict[str, Any]] | None = None,
    ) -> list[Path]:
        """One task a tile, which reads what the first step made of it."""
        tasks = []
        for tile, rows in enumerate(self.sizes):
            own = {"own": self.coarse[tile]} if self.coarse else {}
            arguments: dict[str, Any] = {"store": self.store.key, "tile": tile, "config": self.config}
            if frame is not None:
                arguments["frame"] = list(frame)
            arguments |= per_tile[tile] if per_tile else {}
            tasks.append(
                Task(
                    f"{__name__}:{function}",
                    f"{stage}-{tile:05}",
                    self.workers.folder,
                    arguments,
                    {**own, **(inputs[tile] if inputs else {})},
                    {"store": self.store.folder},
                    rows,
                )
            )
        return self.workers.run(tasks, stage)

    def begin(self) -> list[Path]:
        """The first step: what `g2ard.tiles.steps.coarse` makes of each tile."""
        self.coarse = self.each("coarse", "coarse")
        return self.coarse

    def sampled_frame(self) -> tuple[float, ...]:
        """The frame of a fair sample of the scene, without views."""
        sample = join([scene_of(path, "sample").with_sh_degree(0) for path in self.coarse])
        every = -(-len(sample) // _SAMPLED)
        scene, _ = finite_rows_of(sample.take(slice(None, None, every)))
        return _core.TileFrame.of_sample(
            scene.core, SimplifyConfig(**self.config).resolved("default")
        ).values()
