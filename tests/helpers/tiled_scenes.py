"""Scenes and views for tests of tiles."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.io import write_splats, write_views
from g2ard.io.tile_store import TileStore
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from g2ard.stages.simplify import SimplifyConfig
from g2ard.tiles.executor import Workers, executor
from g2ard.tiles.merging import simplify_tiles
from g2ard.tiles.simplify import TiledRun
from g2ard.tiles.tasks import Arrays, Given, tell_share


def town(count: int = 9000, seed: int = 0) -> Splats:
    """A textured ground with boxes on it."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform([-8, -4, 0], [8, 4, 0], (count, 3))
    high = rng.random(count) < 0.4
    ground[high, :2] = (
        rng.choice([-6.0, -2.0, 3.0, 7.0], (count, 1))[high]
        + rng.uniform(-0.5, 0.5, (count, 2))[high]
    )
    ground[high, 1] *= 0.3
    ground[high, 2] = rng.uniform(0, 1, count)[high]
    color = np.sin(ground @ rng.normal(size=(3, 3)) * 2)
    return Splats.create(
        ground,
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-2.6, 0.3, (count, 3))),
        logit_opacities=rng.normal(2, 2, count),
        sh0=color[:, None],
    )


def ring(count: int = 6) -> Cameras:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = np.stack([12 * np.cos(angles), 8 * np.sin(angles), np.full(count, 5.0)], 1)
    K = [[150, 0, 80], [0, 150, 60], [0, 0, 1]]
    return Cameras.from_lists(
        [look_at(eye, [0, 0, 0]) for eye in eyes],
        [K] * count,
        [(160, 120)] * count,
        [f"{i}" for i in range(count)],
    )


def town_in(folder: Path, count: int = 9000, views: int = 8) -> Path:
    """Write town.ply and views.json, of which the last two are test views, into a folder; return it."""
    write_splats(folder / "town.ply", town(count))
    write_views(folder / "views.json", ring(views), splits=["train"] * (views - 2) + ["test"] * 2)
    return folder


def reduced(
    store: TileStore,
    work: Path,
    budget: int = 900,
    views: Cameras | None = None,
    *,
    config: SimplifyConfig | None = None,
    progress: Progress = silent,
    **where: Any,
) -> Splats:
    """Simplify in tiles without poses of its own; `where` are arguments of `executor`."""
    with executor(**where) as runs:
        run = TiledRun(store, Workers(runs, work, progress), config or SimplifyConfig())
        return simplify_tiles(run, budget, views).splats.whole()


def half_told(given: Given) -> Arrays:
    """Tell that half is done, long enough for the process that waits."""
    tell_share(0.5)
    time.sleep(1.0)
    return {}
