"""Study of drawing a scene box by box: its time, its error, and what boxes in the dark save."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchmarks.rows import Row
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import Workspace
from g2ard.rendering.boxes import FAINT, Canvas, front_to_back, reaching
from g2ard.rendering.renderer import Renderer, settings_for
from g2ard.scene.cameras import Camera
from g2ard.scene.kdtree import KdTree, cut_tree
from g2ard.scene.samples import evenly_spaced

__all__ = ["Boxes"]

_LEAST_LIGHT = {"nothing": -1.0, "stopped": 0.0, "faint": FAINT}
"""Most light in front of a box that is skipped."""


@dataclass(frozen=True)
class Boxes(Study):
    """A study of images composed of the boxes of a kd tree, against those of the whole scene.

    Args:
        methods: what is skipped: "nothing", boxes that are "stopped" in every pixel, or also "faint" ones,
            with less than 1/255 of the light in front.
        boxes: numbers of boxes.
        views: most views, evenly spaced.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {name: name for name in _LEAST_LIGHT}

    boxes: tuple[int, ...] = key((8, 64), least=2, axis=True)
    views: int = key(24, least=1)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per number of boxes and kind of boxes that are skipped."""
        place = Workspace(work, self, scene)
        for boxes in self.boxes:
            for name in self.methods:
                names = {"boxes": boxes, "method": name}
                yield Cell(names, partial(self._measured, place, boxes, _LEAST_LIGHT[name]))

    def _measured(self, place: Workspace, boxes: int, least: float) -> list[Row]:
        splats = place.splats.narrowed()
        settings = settings_for(splats.means, antialiased=splats.antialiased)
        cameras = place.train_cameras
        cameras = cameras.take(evenly_spaced(len(cameras), self.views))
        tree = cut_tree(splats.means, 1.0, -(-len(splats) // boxes))
        world = tree.boxes() + splats.offset
        rows = [np.flatnonzero(reaching(splats, cameras, box)) for box in world]
        parts = [Renderer(splats.take(some), settings=settings) for some in rows]
        whole = Renderer(splats, settings=settings)
        totals = {"whole_ms": 0.0, "boxes_ms": 0.0, "drawn": 0.0, "largest_error": 0.0}
        for view in cameras:
            begun = time.perf_counter()
            image = whole.image(view)
            between = time.perf_counter()
            canvas, drawn = _composed(view, tree, world, parts, splats.offset, least)
            totals["boxes_ms"] += 1e3 * (time.perf_counter() - between)
            totals["whole_ms"] += 1e3 * (between - begun)
            totals["drawn"] += drawn
            totals["largest_error"] = max(
                totals["largest_error"], float(np.abs(canvas.color - image).max())
            )
        count = len(cameras)
        return [
            {
                "count": len(splats),
                "rows_per_gaussian": sum(map(len, rows)) / len(splats),
                "drawn_share": totals["drawn"] / (count * tree.leaves),
                "whole_ms": totals["whole_ms"] / count,
                "boxes_ms": totals["boxes_ms"] / count,
                "largest_error": totals["largest_error"],
            }
        ]


def _composed(
    view: Camera,
    tree: KdTree,
    world: np.ndarray[Any, Any],
    parts: list[Renderer],
    offset: np.ndarray[Any, Any],
    least: float,
) -> tuple[Canvas, int]:
    """Draw a view's boxes with more than `least` light in front; return how many."""
    canvas, drawn = Canvas.blank(view), 0
    for leaf in front_to_back(tree, view.position - offset):
        if least < 0 or canvas.light_on(world[leaf]) > least:
            canvas.draw(parts[leaf], world[leaf])
            drawn += 1
    return canvas, drawn
