"""Visibility of tiles: the views that see each tile, and each Gaussian's contribution to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Rows
from g2ard.rendering.visibility import LONGEST, MOST_VIEWS, NEAR, usual_and_others, weight_of_others
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced, weighted_quantile
from g2ard.system.keys import key_of
from g2ard.tiles.simplify import COARSE, TiledRun, light, merged_visibility, visibility
from g2ard.tiles.tasks import is_whole, load, save, scene_of

_LEAST_LIGHT_SHARE = 0.01
"""Share of a view's light from which it sees a tile."""

_MOST_NEAR_GAUSSIANS = 200_000
"""Most coarse Gaussians for which the `near` level decides which views see a tile."""

_VIEWS_PER_TASK = 64
"""Views per task of `light`."""

_BOX_PERCENTILES = 1, 99
"""Percentiles of its Gaussians that bound a tile's box, to ignore floaters."""


class Sights:
    """Visibility of a run's tiles in some views, and the frame of costs that follows from it."""

    def __init__(self, run: TiledRun, cameras: Cameras, frame: tuple[float, ...]):
        usual, others = usual_and_others(cameras)
        self.run = run
        self.usual = len(usual)
        self.others = len(others)
        self.cameras = Cameras.of([*usual, *others]).resized(LONGEST)
        self.common = {"coarse": run.coarse, "cameras": written(run.workers.folder, self.cameras)}
        boxes = boxes_of(run.coarse)
        lit = self._light(boxes)
        shrunk = float((self.cameras.widths[: self.usual] / usual.widths).mean())
        self.given = [
            {
                **self.common,
                **self._chosen(lit, tile),
                "frame": frame,
                "levels": levels_of(boxes, tile),
                "shrunk": shrunk,
            }
            for tile in range(len(boxes))
        ]
        self.visibility = run.each(visibility, "visibility", self.given)
        pixels = np.array([float(load(path, "pixel")[0]) for path in self.visibility])
        sums = np.array([load(path, "sums")[0] for path in self.visibility]).sum(axis=0)
        self.frame = frame
        if np.isfinite(pixels).any():
            known = np.isfinite(pixels)
            pixel = weighted_quantile(pixels[known], np.array(run.sizes)[known], 0.5)
            self.frame = tuple(
                _core.TileFrame(*frame).with_views(pixel, *map(float, sums)).values()
            )

    def again(self, merged: list[Path]) -> list[Path]:
        """Measure what the same views see of the merged tiles."""
        inputs = (
            {**given, "merged": path, "visibility": seen}
            for given, path, seen in zip(self.given, merged, self.visibility, strict=True)
        )
        return self.run.each(merged_visibility, "merged visibility", inputs)

    def _light(self, boxes: Float) -> Float:
        """Return (V, T) Σ αT² of each tile's coarse Gaussians in each view."""
        store = self.run.store
        here = self.cameras.recentred(store.offset)
        usual = here.positions[: self.usual, None]
        away = np.linalg.norm(usual - boxes.mean(axis=1), axis=2).min(axis=1)
        level = "near" if store.count // COARSE[0] <= _MOST_NEAR_GAUSSIANS else "far"
        given = {**self.common, "level": level, "near": NEAR * float(np.median(away)) or None}
        every = range(len(here))
        parts = [list(every[first : first + _VIEWS_PER_TASK]) for first in every[::_VIEWS_PER_TASK]]
        calls = [({**given, "views": views}, len(views)) for views in parts]
        files = self.run.workers.map(light, "light", calls, {})
        return np.concatenate([load(path, "weights")[0] for path in files])

    def _chosen(self, light: Float, tile: int) -> dict[str, Any]:
        """Choose the views of a tile, evenly spaced among those that see it."""
        usual = light[: self.usual]
        others = light[self.usual :]
        sight = in_sight(usual, tile)
        some = sight[evenly_spaced(len(sight), MOST_VIEWS)]
        return {
            "views": some.tolist(),
            "light": usual[some, tile].tolist(),
            "all_light": float(usual[:, tile].sum()) or 1.0,
            "others": (self.usual + in_sight(others, tile)).tolist(),
            "others_weight": weight_of_others(self.usual, self.others),
        }


def levels_of(boxes: Float, tile: int) -> list[str | None]:
    """Return the coarse level of every tile in views of `tile`, None for itself."""
    low = boxes[:, 0]
    high = boxes[:, 1]
    gaps = np.maximum(0.0, np.maximum(low - high[tile], low[tile] - high))
    near = np.linalg.norm(gaps, axis=1) <= np.linalg.norm(high[tile] - low[tile])
    levels: list[str | None] = ["near" if is_near else "far" for is_near in near]
    levels[tile] = None
    return levels


def boxes_of(coarse: Sequence[Path]) -> Float:
    """Return the (T, 2, 3) low and high corners of tiles."""
    return np.array(
        [np.percentile(scene_of(path, "near").means, _BOX_PERCENTILES, axis=0) for path in coarse]
    )


def in_sight(light: Float, tile: int) -> Rows:
    """Return the views that see a tile; if they are few, include the best of the others."""
    own = light[:, tile]
    sight = np.flatnonzero(own > _LEAST_LIGHT_SHARE * light.sum(axis=1))
    if len(sight) < MOST_VIEWS:
        best = np.argsort(-own, kind="stable")[:MOST_VIEWS]
        sight = np.sort(best[own[best] > 0])
    return sight


def written(work: Path, cameras: Cameras) -> Path:
    """Write cameras to a file named by their content, as input of tasks."""
    arrays = {name: getattr(cameras, name) for name in ("viewmats", "Ks", "widths", "heights")}
    path = work / f"views-{key_of(arrays)}.npz"
    if not is_whole(path):
        save(path, arrays)
    return path
