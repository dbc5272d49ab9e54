"""Images of a scene in tiles: each view is drawn tile by tile, front to back, as the whole scene would be."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from g2ard.arrays import Float32, Values
from g2ard.io.tile_store import TileStore
from g2ard.rendering.boxes import FAINT, Canvas, front_to_back, reaching
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.rendering.targets import rounded
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.tiles.tasks import Arrays, Given, arrays_of, cameras_of, scene_of, tell_share

_WIDTHS = 5.0
"""Largest standard deviations from its middle at which a Gaussian has α ≥ 1/255: 3.33 in the image, and up to
half as much again where it is seen at an angle."""

_BLUR_PIXELS = 1.9
"""Pixels by which the renderer's blur widens that reach."""


def wide(given: Given) -> Arrays:
    """Select the Gaussians of a tile that may reach beyond half of the margin.

    Args:
        given: `tile`; `store`, as for all functions here.

    Returns:
        `scene` (`scene_of`).
    """
    store = TileStore.open(given["store"])
    scene = store.read(given["tile"])
    return arrays_of(
        scene.take(_WIDTHS * scene.scales.max(axis=1, initial=0) > store.margin / 2), "scene"
    )


def draw(given: Given) -> Arrays:
    """Draw views of the whole scene.

    Args:
        given: `cameras`, in world coordinates; `views`, numbers of those to draw; `near`, the near plane;
            `background`; `opacity`, whether to return that too; `wide`, the output of `wide` for each tile.

    Returns:
        One array per view, called by its number: (H, W, 3) uint16, see `rounded`, or with `opacity`
        (H, W, 4) float32, the image and its alpha.
    """
    store = TileStore.open(given["store"])
    numbers = given["views"]
    cameras = cameras_of(given["cameras"]).take(numbers)
    settings = RasterSettings(near=given["near"], antialiased=store.render_model == "antialiased")
    canvases = [Canvas.blank(camera) for camera in cameras]
    boxes = store.tree.boxes() + store.offset
    ways = [front_to_back(store.tree, position - store.offset) for position in cameras.positions]
    while heads := [way[0] for way in ways if way]:
        (tile, _), *_ = Counter(heads).most_common(1)
        here = [view for view, way in enumerate(ways) if way and way[0] == tile]
        lit = [view for view in here if canvases[view].light_on(boxes[tile]) >= FAINT]
        if lit:
            seen = cameras.take(lit)
            scene = reaching_into(store, tile, seen, given["wide"])
            renderer = Renderer(scene, settings=settings)
            for view in lit:
                canvases[view].draw(renderer, boxes[tile])
        for view in here:
            del ways[view][0]
        tell_share(1 - sum(map(len, ways)) / (len(ways) * len(boxes)))
    finished = (canvas.finished(given["background"]) for canvas in canvases)
    return {
        str(n): _stored(image, given["opacity"]) for n, image in zip(numbers, finished, strict=True)
    }


def _stored(drawn: Float32, opacity: bool) -> Values:
    return drawn if opacity else rounded(np.clip(drawn[..., :3], 0, 1))


def reaching_into(
    store: TileStore, tile: int, cameras: Cameras, wide_files: Sequence[Path]
) -> Splats:
    """Return a tile's Gaussians, and those of others that may have a pixel in its box in some view."""
    box = store.tree.boxes()[tile] + store.offset
    low, high = (np.array([getattr(one, end) for one in store.tiles]) for end in ("low", "high"))
    corners = np.stack([low[tile], high[tile]]) + store.offset
    farthest = np.abs(cameras.positions[:, None] - corners).max(axis=1)
    pixel = float((np.linalg.norm(farthest, axis=1) / cameras.Ks[:, 0, 0]).max())
    reach = store.margin / 2 + _BLUR_PIXELS * pixel
    parts = [store.read(tile)]
    known = {tile}
    if reach <= store.margin:
        parts.append(store.read_halo(tile))
    else:  # a pixel is wider than the margin, as in views from far away
        gaps = np.maximum(0.0, np.maximum(low - high[tile], low[tile] - high)).max(axis=1)
        known |= {int(other) for other in np.flatnonzero(gaps <= reach)}
        parts += [store.read(other) for other in sorted(known - {tile})]
    for other, path in enumerate(wide_files):
        if other in known:
            continue
        scene = scene_of(path, "scene")
        if reach <= store.margin:
            _, halo = list(store.tree.route(scene.means, store.margin))[tile]
            scene = scene.take(np.setdiff1d(np.arange(len(scene)), halo))
        parts.append(scene)
    own, *others = parts
    some = [part.take(reaching(part, cameras, box)) for part in others if len(part)]
    return join([own, *(part for part in some if len(part))])
