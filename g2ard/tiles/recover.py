"""Recovery of a tiled scene: each tile is trained amid its frozen surroundings."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.schema import changed, values_of
from g2ard.io.stream import PartsStream
from g2ard.io.tile_store import TileStore
from g2ard.pipeline.distill import RunViews
from g2ard.rendering.renderer import RasterSettings, Renderer, settings_for
from g2ard.rendering.targets import TeacherRenders
from g2ard.report.run import TiledScores, TileScore, by_kind
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.splats import SH_C0, Splats
from g2ard.scene.transform import join
from g2ard.stages.evaluate import ViewScore
from g2ard.stages.recover.anchors import Anchors
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.loop import checked_weights
from g2ard.stages.recover.optimize import recover
from g2ard.system.keys import key_of
from g2ard.tiles.executor import Workers
from g2ard.tiles.merging import finished, scene_in_tiles
from g2ard.tiles.sights import Sights, in_sight, light_of, written
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
    tell_share,
    tile_of,
)

_SSIM_MARGIN = 16
"""Margin in pixels around a tile in its images, because SSIM's windows reach over its edge."""

_OWNED_ALPHA = 0.5
"""Share of a pixel's alpha from which a tile owns the pixel; empty pixels belong to all tiles."""

_FEWEST_OWNED_PIXELS = 256
"""Fewest owned pixels for a view to be used."""


class TileTargets(TeacherRenders):
    """Renders of the dense scene, masked to the pixels that one tile owns.

    `shown` are the indices of the given cameras that are used, because the tile owns enough of them.
    """

    def __init__(
        self, teacher: Splats, own: int, cameras: Cameras, background: tuple[float, float, float]
    ) -> None:
        masks = _masks(teacher, own, cameras)
        self.shown = [view for view, mask in enumerate(masks) if mask.sum() >= _FEWEST_OWNED_PIXELS]
        self._masks = [masks[view] for view in self.shown]
        super().__init__(teacher, cameras.take(self.shown), background=background, lazy=True)

    def _given(self) -> Sequence[Any]:
        return [*super()._given(), self._masks]

    def mask(self, view: int) -> NDArray[np.bool_]:
        """Return the (H, W) mask of owned pixels."""
        return self._masks[view]


def _masks(scene: Splats, own: int, cameras: Cameras) -> list[NDArray[np.bool_]]:
    """Return the (H, W) mask per view where the first `own` Gaussians give at least half of the alpha."""
    white = np.full((len(scene), 1, 3), -0.5 / SH_C0, np.float32)
    white[:own] = 0.5 / SH_C0
    renderer = Renderer(replace(scene, sh0=white, shN=np.zeros((len(scene), 0, 3), np.float32)))
    drawn = (renderer.render(camera) for camera in cameras)
    return [image.image[..., 0] >= _OWNED_ALPHA * image.alpha for image in drawn]


def recover_tile(arguments: Arguments, inputs: Inputs, places: Places) -> Arrays:
    """Recover a tile and score it on held-out views.

    Args:
        arguments: `tile`; `levels`, see `g2ard.tiles.simplify`; `steps`, 0 to only score; `config`, constants
            of recovery by path; `train`, `test` and `apart`, the views of these inputs that see the tile;
            `weights`, the sampling weight of each view of `train`.
        inputs: `coarse`, the output of `coarse` for each tile; `own`, for this tile; `train`, `test` and
            `apart`, cameras in world coordinates.
        places: `store`, the folder of the dense tiles; `student`, of the tiles to recover, in the same boxes.

    Returns:
        `scene` (`scene_of`), the tile's Gaussians; `errors`, (2, C, 2) before and after, per held-out view:
        squared error and number of values summed; `steps` taken.
    """
    store = TileStore.open(places["store"])
    core, far = tile_of(arguments, inputs, places), far_around(store, arguments, inputs)
    # The tile's own Gaussians come first in teacher and student: masks and `frozen` rely on it.
    teacher = join([part for part in (core, store.read_halo(arguments["tile"]), *far) if len(part)])
    smaller = TileStore.open(places["student"])
    small, beside = smaller.read(arguments["tile"]), smaller.read_halo(arguments["tile"])
    student = join([part for part in (small, beside, *far) if len(part)])
    frozen = np.arange(len(student)) >= len(small)
    config = changed(RecoverConfig(), arguments["config"])
    background, settings = config.background, settings_for(core.means, RasterSettings())

    def targets(name: str) -> TileTargets | None:
        cameras = cameras_of(inputs[name]).take(arguments[name]).recentred(store.offset)
        # Means are relative to the store's offset, target cameras are in world coordinates.
        cameras = cropped(cameras, core, settings, _SSIM_MARGIN).recentred(-store.offset)
        tile_targets = TileTargets(teacher, len(core), cameras, background)
        return tile_targets if len(tile_targets.cameras) else None

    held_out, idle = targets("test"), not len(small) or not arguments["steps"]
    names = cameras_of(inputs["test"]).names
    before = _errors(student, held_out, names, background)
    train, apart = (None, None) if idle else (targets("train"), targets("apart"))
    if train is None:
        return {**arrays_of(small, "scene"), "errors": np.array([before, before]), "steps": np.array(0)}
    steps = arguments["steps"]
    done = recover(
        student,
        train,
        replace(config, steps=steps),
        weights=np.array(arguments["weights"])[train.shown],
        anchors=Anchors.of(student, config.regularizers.in_plane),
        validation=apart,
        frozen=frozen,
        watch=lambda step, seconds, splats: tell_share(step / steps),
    )
    result = done.splats.take(slice(len(small)))
    after = _errors(join([result, student.take(frozen)]), held_out, names, background)
    return {
        **arrays_of(result, "scene"),
        "errors": np.array([before, after]),
        "steps": np.array(done.report.steps),
    }


def _errors(
    scene: Splats, targets: TileTargets | None, names: Sequence[str], background: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return the (C, 2) squared error summed over masked pixels and channels, and the number of values, of
    the views called `names`; zeros for those not among the targets."""
    sums = np.zeros((len(names), 2))
    if targets is None:
        return sums
    renderer = Renderer(scene, background=background)
    for view, camera in enumerate(targets.cameras):
        mask = targets.mask(view)
        lost = renderer.clipped(camera)[mask] - targets[view][mask]
        sums[names.index(camera.name)] = np.sum(np.square(lost, dtype=np.float64)), lost.size
    return sums


def recover_tiles(
    store: TileStore,
    student: TileStore,
    around: Sights,
    views: RunViews,
    config: RecoverConfig,
    steps: int,
    workers: Workers,
) -> tuple[PartsStream, TiledScores]:
    """Recover each tile against renders of the dense scene, as if all were recovered together.

    A tile's Gaussians are trained. Those of other tiles within the margin, and coarse Gaussians of all other
    tiles, are frozen around it, so that occlusion is right. Images are cropped to the tile and masked to the
    pixels it owns in the dense scene. A tile's share of `steps` is the share of views that see it, by weight.

    Args:
        student: the scene to recover, in the same boxes (`ingest(…, like=store)`).
        around: visibility of the dense tiles, from `simplify_tiles` with views.
        config: constants of recovery; its steps are ignored.
        steps: steps of a recovery of the whole scene; 0 only scores.
    """
    sight = {
        name: (written(workers.folder, cameras), _seen(store, around, cameras, workers))
        for name, cameras in (
            ("train", views.train.cameras),
            ("test", views.test),
            ("apart", views.apart or views.test.take([])),
        )
    }
    count = len(views.train.cameras)
    weights = checked_weights(views.train.weights, count)
    weights = np.ones(count) if weights is None else weights
    coarse, levels, tasks = around.run.coarse, around.levels(), []
    for tile in range(len(store.tiles)):
        seen = {name: by_tile[tile] for name, (_, by_tile) in sight.items()}
        seen["train"] = [view for view in seen["train"] if weights[view] > 0]
        drawn = weights[seen["train"]]
        arguments = {
            "store": store.key,
            "student": student.key,
            "tile": tile,
            **levels[tile],
            "steps": round(steps / max(1, count) * float(drawn.sum())),
            "weights": drawn.tolist(),
            "config": values_of(config),
            **seen,
        }
        inputs: dict[str, Path | list[Path]] = {"own": coarse[tile], "coarse": coarse}
        tasks.append(
            Task(
                "g2ard.tiles.recover:recover_tile",
                f"recover-{tile:05}",
                workers.folder,
                arguments,
                inputs | {name: path for name, (path, _) in sight.items()},
                {"store": store.folder, "student": student.folder},
                store.tiles[tile].rows,
            )
        )
    paths = workers.run(tasks, "recover" if steps else "score")
    errors = [load(path, "errors")[0] for path in paths]
    taken = [int(load(path, "steps")[0]) for path in paths]
    parts = tuple(
        TileScore(tile.index, tile.rows, *_psnr(lost.sum(axis=1)), int(lost[0, :, 1].sum()) // 3, steps)
        for tile, lost, steps in zip(student.tiles, errors, taken, strict=True)
    )
    lost = np.sum(errors, axis=0)
    shown = [(camera, *_psnr(lost[:, i])) for i, camera in enumerate(views.test) if lost[0, i, 1]]
    kinds = by_kind(
        [ViewScore(view.name, before, kind=view.kind) for view, before, _ in shown],
        [ViewScore(view.name, after, kind=view.kind) for view, _, after in shown],
        USUAL if views.pool is not None else "given",
    )
    pixels = int(lost[0, :, 1].sum()) // 3
    scores = TiledScores(*_psnr(lost.sum(axis=1)), pixels, kinds, sum(taken), parts)
    degree = student.sh_degree if config.sh_degree is None else config.sh_degree
    rows = [tile.rows for tile in student.tiles]

    def recovered(tile: int) -> Splats:
        return finished(scene_of(paths[tile], "scene"), degree)

    return scene_in_tiles(store, rows, recovered, key_of([paths, degree]), degree), scores


def _psnr(errors: NDArray[np.float64]) -> tuple[float, float]:
    """Return PSNR before and after from the (2, 2) `errors` of `recover_tile`."""
    before, after = (float(-10 * math.log10(max(e, 1e-12) / max(n, 1))) for e, n in errors)
    return before, after


def _seen(store: TileStore, around: Sights, cameras: Cameras, workers: Workers) -> list[list[int]]:
    """Return the views that see each tile."""
    if not len(cameras):
        return [[] for _ in store.tiles]
    light = light_of(store, around.run.coarse, cameras, workers)
    return [in_sight(light, tile).tolist() for tile in range(len(store.tiles))]
