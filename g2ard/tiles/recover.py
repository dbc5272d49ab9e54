"""Recovery of a scene in tiles: each tile learns where it stands, its surroundings frozen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g2ard.config.paths import changed, values_of
from g2ard.rendering.renderer import RasterSettings, Renderer, settings_for
from g2ard.scene.cameras import Cameras
from g2ard.scene.prepared import PreparedScene
from g2ard.scene.splats import SH_C0, Splats
from g2ard.scene.targets import TeacherRenders
from g2ard.scene.transform import join
from g2ard.stages.recover import RecoverConfig
from g2ard.stages.recover.anchors import Anchors
from g2ard.tiles.executor import Workers
from g2ard.tiles.merging import TiledScene, finished, key_of
from g2ard.tiles.sights import Surroundings, in_sight, light_of, written
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
    far_around,
    load,
    scene_of,
    tile_of,
)

if TYPE_CHECKING:
    from g2ard.policy.views import RunViews

_MARGIN = 16
"""Pixels around a tile that its images show too: SSIM's windows reach over its edge."""

_OWN = 0.5
"""Share of a pixel's alpha that is a tile's where the pixel counts for it; an empty one counts for all."""

_FEWEST = 256
"""Pixels that count in a view, at least: fewer teach nothing."""


@dataclass(frozen=True)
class TileScore:
    """A tile's part of `TiledScores`.

    Args:
        tile: its number.
        count: its Gaussians.
        simplified, recovered, pixels, steps: as there; PSNR means nothing without pixels.
    """

    tile: int
    count: int
    simplified: float
    recovered: float
    pixels: int
    steps: int


@dataclass(frozen=True)
class TiledScores:
    """Held-out views, over all pixels that tiles own in them.

    Args:
        simplified: PSNR, dB, before recovery.
        recovered: and after it.
        pixels: that it is taken over.
        steps: of all tiles together.
        tiles: each one's part.
    """

    simplified: float
    recovered: float
    pixels: int
    steps: int
    tiles: tuple[TileScore, ...]


class TileTargets(TeacherRenders):
    """The dense scene's renders, of which the pixels count that no other tile gives most of."""

    def __init__(
        self, teacher: Splats, own: int, cameras: Cameras, background: tuple[float, float, float]
    ) -> None:
        masks = _masks(teacher, own, cameras)
        shown = [view for view, mask in enumerate(masks) if mask.sum() >= _FEWEST]
        self._masks = [masks[view] for view in shown]
        super().__init__(teacher, cameras.take(shown), background=background, lazy=True)

    def mask(self, view: int) -> NDArray[np.bool_]:
        """(H, W), where a pixel counts."""
        return self._masks[view]


def _masks(scene: Splats, own: int, cameras: Cameras) -> list[NDArray[np.bool_]]:
    """(H, W) of each view, where the first `own` Gaussians give most of the alpha."""
    white = np.full((len(scene), 1, 3), -0.5 / SH_C0, np.float32)
    white[:own] = 0.5 / SH_C0
    renderer = Renderer(replace(scene, sh0=white, shN=np.zeros((len(scene), 0, 3), np.float32)))
    drawn = (renderer.render(camera) for camera in cameras)
    return [image.image[..., 0] >= _OWN * image.alpha for image in drawn]


def recover_tile(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """A tile's Gaussians after recovery, and what held-out views say of it.

    Args:
        arguments: `tile`; `levels`, see `g2ard.tiles.steps`; `steps` to take, 0 to be scored alone; `config`,
            recovery's constants by full name; `train`, `test` and `apart`: which views of these inputs have
            the tile in sight.
        inputs: `coarse`, what `coarse` made of each tile, `own`, of this one; `train`, `test` and `apart`,
            cameras in world coordinates.
        places: `store`, the folder of the dense scene in tiles; `student`, of the scene to recover in the
            same boxes.

    Returns:
        `scene` (`scene_of`), the tile's Gaussians; `errors`, (2, 2) before and after: the squared error in
        the held-out views and the number of values it sums; `steps` that were taken.
    """
    from g2ard.stages.recover import recover

    store = TileStore.open(places["store"])
    core, far = tile_of(arguments, inputs, places), far_around(store, arguments, inputs)
    # The tile's own Gaussians first, in teacher and student: masks and `frozen` count on it.
    teacher = join([part for part in (core, store.read_halo(arguments["tile"]), *far) if len(part)])
    smaller = TileStore.open(places["student"])
    small, beside = smaller.read(arguments["tile"]), smaller.read_halo(arguments["tile"])
    student = join([part for part in (small, beside, *far) if len(part)])
    frozen = np.arange(len(student)) >= len(small)
    config = changed(RecoverConfig(), arguments["config"])
    background = config.background

    def targets(name: str) -> TileTargets | None:
        cameras = _cropped(cameras_of(inputs[name]).take(arguments[name]), core, store.offset)
        found = TileTargets(teacher, len(core), cameras, background)
        return found if len(found.cameras) else None

    held_out, idle = targets("test"), not len(small) or not arguments["steps"]
    before = _errors(student, held_out, background)
    train, apart = (None, None) if idle else (targets("train"), targets("apart"))
    if train is None:
        return {**arrays_of(small, "scene"), "errors": np.array([before, before]), "steps": np.array(0)}
    done = recover(
        student,
        train,
        replace(config, steps=arguments["steps"]),
        anchors=Anchors.of(student, config.regularizers.in_plane),
        validation=apart,
        frozen=frozen,
    )
    result = done.splats.take(slice(len(small)))
    after = _errors(join([result, student.take(frozen)]), held_out, background)
    return {
        **arrays_of(result, "scene"),
        "errors": np.array([before, after]),
        "steps": np.array(done.report.steps),
    }


def _cropped(cameras: Cameras, core: PreparedScene, offset: NDArray[np.float64]) -> Cameras:
    """The parts of the images that show a tile."""
    settings = settings_for(core.means, RasterSettings())
    # Means lie in the store's coordinates, about `offset`; the cameras of targets in the world's.
    return cropped(cameras.recentred(offset), core, settings, _MARGIN).recentred(-offset)


def _errors(
    scene: Splats, targets: TileTargets | None, background: tuple[float, float, float]
) -> tuple[float, int]:
    """Squared error summed over the pixels that count and their channels, and how many values those are."""
    if targets is None:
        return 0.0, 0
    total, count, renderer = 0.0, 0, Renderer(scene, background=background)
    for view, camera in enumerate(targets.cameras):
        mask = targets.mask(view)
        lost = renderer.clipped(camera)[mask] - targets[view][mask]
        total += float(np.sum(np.square(lost, dtype=np.float64)))
        count += lost.size
    return total, count


def recover_tiles(
    store: TileStore,
    student: TileStore,
    around: Surroundings,
    views: RunViews,
    config: RecoverConfig,
    steps: int,
    workers: Workers,
) -> tuple[TiledScene, TiledScores]:
    """Recover each tile against the dense scene's renders, as if it were part of one recovery of all.

    A tile's Gaussians learn; those of others within its margin, and coarse ones of all else, stand frozen
    around them, so that what hides what is right. Only the pixels count that no other tile gives most of
    in the dense scene; images are cropped to the tile. A tile takes the share of `steps` that views
    which have it in sight are of all.

    Args:
        store: the dense scene.
        student: what is to be recovered, in the same boxes (`ingest(…, like=store)`).
        around: where the dense scene's tiles stand, as `simplify_tiles` with views tells.
        views: to learn from, to score on, and of another kind to judge by.
        config: of recovery; its steps are not read.
        steps: of a recovery of all; 0 only scores.
        workers: run the tasks.
    """
    sight = {
        name: (written(workers.folder, cameras), _seen(store, around, cameras, workers))
        for name, cameras in (
            ("train", views.train.cameras),
            ("test", views.test),
            ("apart", views.apart or views.test.take([])),
        )
    }
    tasks = [
        _task(
            store,
            student,
            around,
            tile,
            sight,
            steps / max(1, len(views.train.cameras)),
            config,
            workers.folder,
        )
        for tile in range(len(store.tiles))
    ]
    paths = workers.run(tasks, "recover" if steps else "score")
    errors = [load(path, "errors")[0] for path in paths]
    taken = [int(load(path, "steps")[0]) for path in paths]
    parts = tuple(
        TileScore(tile.index, tile.rows, *_psnr(lost), int(lost[0][1]) // 3, steps)
        for tile, lost, steps in zip(student.tiles, errors, taken, strict=True)
    )
    lost = np.sum(errors, axis=0)
    scores = TiledScores(*_psnr(lost), int(lost[0][1]) // 3, sum(taken), parts)
    degree = student.sh_degree if config.sh_degree is None else config.sh_degree
    scene = TiledScene(
        tuple(tile.rows for tile in student.tiles),
        lambda tile: finished(scene_of(paths[tile], "scene"), degree),
        degree,
        store.offset,
        key_of([paths, degree]),
        surroundings=around,
    )
    return scene, scores


def _psnr(errors: NDArray[np.float64]) -> tuple[float, float]:
    """Before and after, of the (2, 2) `errors` of `recover_tile`."""
    before, after = (float(-10 * math.log10(max(e, 1e-12) / max(n, 1))) for e, n in errors)
    return before, after


def _seen(store: TileStore, around: Surroundings, cameras: Cameras, workers: Workers) -> list[list[int]]:
    """For each tile the views that have it in sight."""
    if not len(cameras):
        return [[] for _ in store.tiles]
    light = light_of(store, around.coarse, cameras, workers)
    return [in_sight(light, tile).tolist() for tile in range(len(store.tiles))]


def _task(
    store: TileStore,
    student: TileStore,
    around: Surroundings,
    tile: int,
    sight: dict[str, tuple[Path, list[list[int]]]],
    steps_a_view: float,
    config: RecoverConfig,
    work: Path,
) -> Task:
    views = {name: seen[tile] for name, (_, seen) in sight.items()}
    return Task(
        "g2ard.tiles.recover:recover_tile",
        f"recover-{tile:05}",
        work,
        {
            "store": store.key,
            "student": student.key,
            "tile": tile,
            "levels": around.levels[tile],
            "steps": round(steps_a_view * len(views["train"])),
            "config": values_of(config),
            **views,
        },
        {
            "own": around.coarse[tile],
            "coarse": around.coarse,
            **{name: path for name, (path, _) in sight.items()},
        },
        {"store": store.folder, "student": student.folder},
        store.tiles[tile].rows,
    )
