"""Photos registered against ever smaller maps: what each matcher makes of each start."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import rows as table
from benchmarks.simplify import scene_label
from g2ard import io
from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register import RegisterConfig, register
from g2ard.stages.register.pose import rotation_of
from g2ard.stages.register.report import Accuracy, summarize
from g2ard.stages.simplify import simplify

__all__ = ["STARTS", "Cell", "bench_register", "displaced"]

STARTS: dict[str, tuple[float, float] | None] = {
    "A": (0.01, 0.4),
    "B": (0.05, 5.0),
    "C": (0.15, 15.0),
    "D": None,
}
"""How far off a start is: share of the view's median depth, and degrees. D: only a pool of other views."""
_NEAR, _NEARER = 1, 0
"""Of `score.RECALLS`: 10 cm/5° and 5 cm/5°."""


@dataclass(frozen=True)
class Cell:
    """One map, one matcher, one kind of start.

    Args:
        scene: its name.
        ratio: of the scene's count to the map's.
        count: Gaussians of the map.
        bytes: of the map as a 3DGS .ply.
        matcher: see `RegisterConfig`.
        start: of `STARTS`.
        seed: of the starts.
        photos: all of them.
        registered, uncertain: of them.
        start_position, start_rotation: medians of the starts' errors: cm, or scene units where metres are not
            known; degrees.
        position, rotation: the same of those registered; None where none is.
        worst: largest error of position of those registered.
        start_10, start_5: shares of all photos that start within 10 cm/5° and 5 cm/5°; None without metres.
        found_10, found_5: the same of what is registered.
        seconds: for a photo, on the mean.
    """

    scene: str
    ratio: float
    count: int
    bytes: int
    matcher: str
    start: str
    seed: int
    photos: int
    registered: int
    uncertain: int
    start_position: float | None
    start_rotation: float | None
    position: float | None
    rotation: float | None
    worst: float | None
    start_10: float | None
    start_5: float | None
    found_10: float | None
    found_5: float | None
    seconds: float


def bench_register(
    scenes: Sequence[Path],
    photos: Cameras,
    csv_path: Path,
    *,
    pool: Cameras | None = None,
    ratios: Sequence[float] = (1, 10),
    matchers: Sequence[str] = ("auto", "direct"),
    starts: Sequence[str] = ("A", "B"),
    seeds: int = 1,
    metres_per_unit: float | None = None,
    config: RegisterConfig | None = None,
    progress: Progress = silent,
) -> list[Cell]:
    """Register the photos against each scene, reduced by each ratio, with each matcher and from each start.

    Args:
        scenes: maps, as `g2ard.io.read_scene` reads them; one recovered at a ratio is a scene of its own.
        photos: C views with photos and true poses.
        csv_path: where the rows go; it is written anew.
        pool: views without those photos: for starts D, and what reduction looks from.
        ratios: 1 is the scene as it is; others are merged to, without recovery.
        matchers: see `RegisterConfig`.
        starts: of `STARTS`.
        seeds: how many draws of each start.
        metres_per_unit: of the scenes, for centimetres and recalls.
        config: of all registrations, but for its matcher.
        progress: told after each cell.

    Raises:
        InputError: a scene cannot be read, an unknown start, D without a pool, or a ratio below 1.
    """
    if unknown := [name for name in starts if name not in STARTS]:
        raise InputError(f"starts: expected some of {', '.join(STARTS)}, got {unknown[0]}")
    if not ratios or min(ratios) < 1:
        raise InputError(f"ratios: expected 1 or more, got {', '.join(f'{r:g}' for r in ratios)}")
    if pool is None and "D" in starts:
        raise InputError("starts: D looks for photos in a pool, and there are no views but the photos'")
    cells: list[Cell] = []
    draws = [(name, seed) for name in starts for seed in range(1 if STARTS[name] is None else seeds)]
    total = len(scenes) * len(ratios) * len(matchers) * len(draws)
    for path in scenes:
        splats = io.read_splats(path)
        for ratio in ratios:
            small = _reduced(splats, ratio, photos if pool is None else pool)
            for matcher in matchers:
                one = replace(config or RegisterConfig(), matcher=matcher)
                for name, seed in draws:
                    cell = _measured(small, photos, pool, name, seed, one, metres_per_unit)
                    cells.append(replace(cell, scene=scene_label(path), ratio=ratio))
                    table.rewrite(csv_path, cells, Cell)
                    progress("bench register", len(cells), total, {})
    return cells


def displaced(
    viewmat: NDArray[np.float64], distance: float, degrees: float, seed: int
) -> NDArray[np.float64]:
    """(4, 4) pose whose centre lies `distance` away in a random direction, turned about a random axis."""
    v, w = np.random.default_rng(seed).normal(size=(2, 3))
    R = viewmat[:3, :3]
    centre = -R.T @ viewmat[:3, 3] + distance * v / np.linalg.norm(v)
    out = np.eye(4)
    out[:3, :3] = rotation_of(np.radians(degrees) * w / np.linalg.norm(w)) @ R
    out[:3, 3] = -out[:3, :3] @ centre
    return out


def _reduced(splats: Splats, ratio: float, views: Cameras) -> Splats:
    budget = max(1, round(len(splats) / ratio))
    if budget == len(splats):
        return splats
    return simplify(splats, budget, visibility=visibility_source(views)).splats


def _depths(splats: Splats, views: Cameras) -> list[float]:
    """Median depth of each view, where it is opaque enough; 1 where nothing is."""
    renderer, out = Renderer(splats), []
    for view in views.resized(250):
        depth = renderer.render(view, median=True).median
        assert depth is not None
        out.append(float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0)
    return out


def _measured(
    splats: Splats,
    photos: Cameras,
    pool: Cameras | None,
    name: str,
    seed: int,
    config: RegisterConfig,
    metres: float | None,
) -> Cell:
    truth = dict(zip(photos.names, photos.viewmats, strict=True))
    off = STARTS[name]
    starts = None
    if off is not None:
        far = zip(truth.items(), _depths(splats, photos), strict=True)
        starts = {
            photo: displaced(pose, off[0] * depth, off[1], 1000 * seed + i)
            for i, ((photo, pose), depth) in enumerate(far)
        }
    began = time.perf_counter()
    found = register(splats, photos, starts=starts, pool=None if starts else pool, truth=truth, config=config)
    seconds = (time.perf_counter() - began) / len(photos)
    summary = summarize(found.report.photos, true=len(truth), metres_per_unit=metres)
    assert summary.start is not None
    assert summary.found is not None
    scale = 1.0 if metres is None else 100 * metres
    at, turn, _, at_10, at_5 = _figures(summary.start, scale)
    position, rotation, worst, found_10, found_5 = _figures(summary.found, scale)
    size = len(splats) * 4 * (14 + 3 * ((splats.sh_degree + 1) ** 2 - 1))
    return Cell(
        scene="",
        ratio=1.0,
        count=len(splats),
        bytes=size,
        matcher=config.matcher,
        start=name,
        seed=seed,
        photos=len(photos),
        registered=summary.registered,
        uncertain=summary.uncertain,
        start_position=at,
        start_rotation=turn,
        position=position,
        rotation=rotation,
        worst=worst,
        start_10=at_10,
        start_5=at_5,
        found_10=found_10,
        found_5=found_5,
        seconds=seconds,
    )


def _figures(accuracy: Accuracy, scale: float) -> list[float | None]:
    """Median position and rotation, worst position, and shares within 10 cm and 5 cm."""
    shares: list[float | None] = [accuracy.recalls[i].share for i in (_NEAR, _NEARER) if accuracy.recalls]
    shares = shares or [None, None]
    if accuracy.median is None or accuracy.worst is None:
        return [None, None, None, *shares]
    median, worst = accuracy.median, accuracy.worst.position
    return [median.position * scale, median.rotation, worst * scale, *shares]
