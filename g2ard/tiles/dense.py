"""A dense scene in tiles: what a run asks of it (`g2ard.pipeline.dense`), computed tile by tile."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float32, Mask, Values
from g2ard.config.choices import BLACK, Colour
from g2ard.io.stream import PartsStream
from g2ard.io.tile_store import TileStore
from g2ard.pipeline.dense import InMemory, load_whole
from g2ard.progress import Progress, silent
from g2ard.rendering.boxes import front_to_back
from g2ard.rendering.recolour import seen_by, shifted
from g2ard.rendering.renderer import RasterSettings, Renderer, settings_for
from g2ard.rendering.targets import CACHE_BYTES, Cached, Targets, unrounded
from g2ard.rendering.visibility import LONGEST, usual_and_others
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.scene.transform import stand_as
from g2ard.stages.clean import Cleaning, extent_of
from g2ard.stages.simplify import Default, SimplifyConfig
from g2ard.stages.simplify.gaps import let_through, some_views
from g2ard.stages.simplify.pairs import MANY
from g2ard.system.cached import cached_property
from g2ard.system.keys import key_of
from g2ard.tiles.clutter import clutter
from g2ard.tiles.executor import Workers
from g2ard.tiles.images import draw, wide
from g2ard.tiles.ingest import ingest
from g2ard.tiles.merging import Merged, scene_in_tiles, simplify_tiles
from g2ard.tiles.sights import boxes_of, levels_of, written
from g2ard.tiles.simplify import TiledRun
from g2ard.tiles.tasks import load

_VIEWS_PER_TASK = 32
"""Views that a task draws together, so that a tile is read once for them."""

_KEPT_BYTES = 500_000_000
"""Default of `TileRenders.limit`."""

_DRAWING = threading.Lock()
"""Held while views are drawn: workers first remove temporary files, which another thread may be writing."""


@dataclass(eq=False)
class InTiles:
    """A dense scene in tiles.

    Args:
        workers: what computes, and the folder of its files.
        config: of its merges.
        most_rows: a scene that is merged to at most so many Gaussians is in memory.
        folder: for tiles of scenes that are derived from this one.
    """

    store: TileStore
    workers: Workers
    config: SimplifyConfig
    most_rows: int
    folder: Path

    @property
    def total(self) -> int:
        """Number of Gaussians."""
        return self.store.count

    @cached_property
    def sample(self) -> Splats:
        """A sample of the Gaussians, from all tiles."""
        return stand_as(self._run.sample(), self.store)

    @cached_property
    def _run(self) -> TiledRun:
        return TiledRun(self.store, self.workers, self.config)

    @cached_property
    def settings(self) -> RasterSettings:
        """Conventions of its images."""
        return settings_for(self.sample.means, antialiased=self.sample.antialiased)

    @cached_property
    def wide(self) -> list[Path]:
        """Files of the Gaussians of each tile that reach far, see `g2ard.tiles.images`."""
        return self._run.each(wide, "wide", [{}] * len(self._run.sizes))

    def identity(self) -> list[str]:
        """Return the key of the tiles."""
        return [self.store.key]

    def merge(
        self,
        count: int,
        views: Cameras | None,
        config: SimplifyConfig,
        *,
        protected: Mask | None = None,
        final_budget: int | None = None,
        gaps: bool = False,
        progress: Progress = silent,
    ) -> Merged:
        """Merge the scene, see `Dense`; finished steps are in the folder of the workers.

        Flags of `protected` are those of a round before, of which a scene in tiles has none. Colours are
        fitted, and gaps measured, only if the result is in memory.
        """
        merged = simplify_tiles(self._run, count, views, final_budget)
        if count > self.most_rows:
            return merged
        small = load_whole(merged.splats)
        report = merged.report
        if views is None or count == self.total:
            return replace(merged, splats=small)
        usual = usual_and_others(views)[0].resized(LONGEST)
        if isinstance(config, Default) and self.total >= MANY * count:
            small = self._recoloured(small, usual, progress)
        if gaps:
            report = replace(report, opacity_lost=self.opacity_lost(small, usual))
        return replace(merged, splats=small, report=report)

    def _recoloured(self, small: Splats, views: Cameras, progress: Progress) -> Splats:
        chosen = seen_by(views)
        drawn = TileRenders(self, chosen, opacity=True)

        def shown(view: int) -> tuple[Float32, Float32]:
            image = drawn[view]
            return image[..., :3], image[..., 3]

        drawn.fill(progress)
        return shifted(small, chosen, shown, self.settings, progress)

    def images(
        self, views: Cameras, background: Colour = BLACK, limit: int = CACHE_BYTES
    ) -> Targets:
        """Return the scene's images in some views."""
        return TileRenders(self, views, background, min(limit, _KEPT_BYTES))

    def opacity_lost(self, result: Splats, views: Cameras) -> float:
        """Return the share of light that a result lets through."""
        some = some_views(views)
        drawn = TileRenders(self, some, opacity=True)
        renderer = Renderer(result, settings=self.settings)
        pairs = [
            let_through(drawn[view][..., 3], renderer.render(camera).alpha)
            for view, camera in enumerate(some)
        ]
        lost, opaque = np.sum(pairs, axis=0)
        return float(lost / opaque) if opaque else 0.0

    def without_clutter(self, views: Cameras) -> tuple[InMemory | InTiles, Cleaning, float]:
        """Return the scene without the clutter that views show, what that is, and its share of the light."""
        coarse = self._run.coarse
        boxes = boxes_of(coarse)
        common = {
            "coarse": coarse,
            "cameras": written(self.workers.folder, views),
            "extent": extent_of(self.sample),
        }
        given = ({**common, "levels": levels_of(boxes, tile)} for tile in range(len(boxes)))
        files = self._run.each(clutter, "clutter", given)
        found = [Cleaning(load(path, "kind")[0]) for path in files]
        light, gone = np.sum([load(path, "light")[0] for path in files], axis=0)

        def cleaned(tile: int) -> Splats:
            return self.store.read(tile).take(found[tile].keep)

        counts = [int(np.count_nonzero(one.keep)) for one in found]
        scene = scene_in_tiles(self.store, counts, cleaned, key_of(files), self.store.sh_degree)
        kinds = Cleaning(np.concatenate([one.kind for one in found]))
        return self.derive(scene, "cleaned"), kinds, float(gone / max(light, 1e-30))

    def derive(self, scene: Splats | PartsStream, name: str) -> InMemory | InTiles:
        """Return a scene that was derived from this one: in memory, or in tiles of its own if it is large."""
        if isinstance(scene, Splats):
            return InMemory(scene)
        folder = self.folder / f"{name}-{scene.identity()[0]}"
        store = ingest(scene, folder, tile_rows=self.most_rows)
        return InTiles(store, self.workers, self.config, self.most_rows, self.folder)


class TileRenders(Cached):
    """Renders of a scene in tiles, drawn by its workers; see `TeacherRenders`.

    Args:
        limit: bytes kept in memory; other images are read from their file again on each access.
        opacity: whether images are (H, W, 4), with alpha, and not limited to 1.
    """

    _spills = False  # all images are in files of tasks

    def __init__(
        self,
        scene: InTiles,
        cameras: Cameras,
        background: Colour = BLACK,
        limit: int = _KEPT_BYTES,
        *,
        opacity: bool = False,
    ) -> None:
        super().__init__(cameras, limit)
        self._scene = scene
        self._background = tuple(background)
        self._opacity = opacity
        self._files: dict[int, Path] = {}

    def _given(self) -> Sequence[Any]:
        return [*self._scene.identity(), self._background, self._opacity]

    def against(self, view: int) -> str:
        """Return the kind, see `against_of`."""
        return "teacher"

    def fill(self, progress: Progress, views: Sequence[int] | None = None) -> None:
        """Draw the views, all by default, that are not drawn yet."""
        views = range(len(self.cameras)) if views is None else views
        with _DRAWING:
            if missing := [int(view) for view in views if view not in self._files]:
                self._draw(missing)

    def _draw(self, missing: Sequence[int]) -> None:
        store = self._scene.store
        workers = self._scene.workers
        positions = self.cameras.positions - store.offset
        alike = sorted(missing, key=lambda view: front_to_back(store.tree, positions[view]))
        common = {
            "content": store.key,
            "cameras": written(workers.folder, self.cameras),
            "wide": self._scene.wide,
            "near": self._scene.settings.near_of(0),
            "background": self._background,
            "opacity": self._opacity,
        }
        parts = np.array_split(alike, math.ceil(len(alike) / _VIEWS_PER_TASK))
        chunks = [part.tolist() for part in parts]
        calls = [({**common, "views": chunk}, len(chunk)) for chunk in chunks]
        files = workers.map(draw, "targets", calls, {"store": store.folder})
        for chunk, path in zip(chunks, files, strict=True):
            self._files |= dict.fromkeys(chunk, path)

    def _make(self, view: int) -> Values:
        if view not in self._files:
            self.fill(self._scene.workers.progress)
        (image,) = load(self._files[view], str(view))
        return image

    def __getitem__(self, view: int) -> Float32:
        image = self._stored(view)
        return image if self._opacity else unrounded(image)
