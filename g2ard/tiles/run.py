"""A step of every tile: one task each."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from g2ard import _core
from g2ard.progress import Progress
from g2ard.scene.prepared import finite_rows_of
from g2ard.stages.simplify import SimplifyConfig
from g2ard.tiles.executor import Executor
from g2ard.tiles.scenes import joined, scene_of
from g2ard.tiles.store import TileStore
from g2ard.tiles.task import Task

__all__ = ["TiledRun"]

_STEPS = "g2ard.tiles.steps"

_SAMPLED = 1_000_000
"""Gaussians of a scene by which its frame is found, at most."""


class TiledRun:
    """What all steps of a simplification in tiles share."""

    def __init__(
        self, store: TileStore, executor: Executor, work: Path, config: SimplifyConfig, progress: Progress
    ):
        self.store, self.executor, self.work, self.progress = store, executor, work, progress
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
                    f"{_STEPS}:{function}",
                    f"{stage}-{tile:05}",
                    self.work,
                    arguments,
                    {**own, **(inputs[tile] if inputs else {})},
                    {"store": self.store.folder},
                    rows,
                )
            )
        return self.executor.run(tasks, stage, self.progress)

    def begin(self) -> list[Path]:
        """The first step: what `g2ard.tiles.steps.coarse` makes of each tile."""
        self.coarse = self.each("coarse", "coarse")
        return self.coarse

    def sampled_frame(self) -> tuple[float, ...]:
        """The frame of a fair sample of the scene, without views."""
        sample = joined([scene_of(path, "sample").with_sh_degree(0) for path in self.coarse])
        every = -(-len(sample) // _SAMPLED)
        scene, _ = finite_rows_of(sample.take(slice(None, None, every)))
        return _core.TileFrame.of_sample(scene.core, self.config["pixel_scale"]).values()
