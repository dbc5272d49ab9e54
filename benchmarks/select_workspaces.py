"""Workspaces of `python -m benchmarks select`: a prior, views with targets, and pools drawn from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.simplify import scene_label
from benchmarks.synth import CityConfig, city
from g2ard import io
from g2ard.config.choices import BLACK, Colour
from g2ard.io.atomic import atomic_output
from g2ard.poses import make_pool, plan_pool
from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.images import load_image
from g2ard.scene.splats import Splats
from g2ard.scene.splits import splits_of, states_splits
from g2ard.scene.targets import Targets
from g2ard.stages.lift import lift
from g2ard.stages.recover.anchors import PRESETS, Regularizers
from g2ard.stages.simplify import simplify

__all__ = ["KINDS", "Pool", "Size", "Workspace", "label", "pool_of", "workspace_of"]

KINDS = ("biased", "even")
_CROWD = 24
"""Views held out where a pool is crowded."""
Rows = NDArray[np.int64]
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Size:
    """How small a study is.

    Args:
        gaussians: of the student.
        pixels: longer side of the views.
        candidates: of a pool, where there are that many.
        tests: views in each set that is scored.
    """

    gaussians: int = 10_000
    pixels: int = 256
    candidates: int = 224
    tests: int = 24


@dataclass(frozen=True, eq=False)
class Workspace:
    """One scene, ready for trials.

    Args:
        prior: what views are selected from.
        student: what is recovered; the same for all policies.
        targets: of the universe, every view a pool or a test may take.
        tests: rows of the universe held out evenly over its extent.
        outside: targets of views out of the universe's distribution.
        regularizers: recovery's.
        sh_degree: recovery's.
        background: recovery's.
        candidates: of a pool.
    """

    prior: Splats
    student: Splats
    targets: Targets
    tests: Rows
    outside: Targets
    regularizers: Regularizers
    candidates: int
    sh_degree: int | None = None
    background: Colour = BLACK


@dataclass(frozen=True, eq=False)
class Pool:
    """Candidates, rows of the universe; and rows held out where the pool is crowded (none if it is even)."""

    rows: Rows
    crowd: Rows


class _Made(Targets):
    """Images made when first asked for, and kept in half precision, in `folder` if there is one."""

    def __init__(
        self, cameras: Cameras, make: Callable[[Cameras, int], Image], folder: Path | None = None
    ) -> None:
        self.cameras = cameras
        self._make, self._folder = make, folder
        self._kept: dict[int, NDArray[np.float16]] = {}

    def __getitem__(self, view: int) -> Image:
        if view not in self._kept:
            self._kept[view] = self._found(view)
        return self._kept[view].astype(np.float32)

    def _found(self, view: int) -> NDArray[np.float16]:
        path = self._folder / f"{self.cameras.names[view]}.npy" if self._folder else None
        if path is not None and path.exists():
            return np.asarray(np.load(path), np.float16)
        image = np.clip(self._make(self.cameras, view), 0, 1).astype(np.float16)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_output(path, overwrite=True) as temporary, temporary.open("wb") as file:
                np.save(file, image)
        return image


def workspace_of(
    scene: Path, size: Size, *, cache: Path | None = None, progress: Progress = silent
) -> Workspace:
    """Set a scene up.

    A trained scene teaches itself from a made pool; a COLMAP folder with photos is lifted from its points;
    `city` is the procedural one, with ray-cast photos. Made images are kept in `cache`, a folder for this
    scene and size alone, so that a study that goes on later does not make them again.
    """
    if scene.name == "city" and not scene.exists():
        return _city(size, cache)
    if scene.is_dir() and io.kind(scene) != "splats":
        return _photos(scene, size)
    return _trained(scene, size, cache, progress)


def label(scene: Path) -> str:
    """A scene's name in the CSV."""
    return scene_label(scene) if scene.exists() else scene.name


def pool_of(workspace: Workspace, kind: str, seed: int) -> Pool:
    """Candidates out of the universe.

    even: drawn uniformly. biased: a quarter drawn uniformly, the others out of the sixth of the universe
    (a third of a small one) that is nearest to one of its views, as real trajectories crowd somewhere.
    """
    rng = np.random.default_rng([seed, 11])
    free = np.setdiff1d(np.arange(len(workspace.targets.cameras)), workspace.tests)
    count = min(workspace.candidates, len(free) * 4 // 5)
    if kind == "even":
        return Pool(np.sort(rng.choice(free, count, replace=False)), np.zeros(0, np.int64))
    positions = workspace.targets.cameras.positions
    near = free[np.argsort(np.linalg.norm(positions[free] - positions[rng.choice(free)], axis=1))]
    crowded = near[: len(near) // 6] if len(near) >= 6 * count else near[: len(near) // 3]
    crowded = rng.permutation(crowded)
    crowd, rest = crowded[: min(_CROWD, len(crowded) // 6)], crowded[len(crowded) // 6 :]
    many = rest[: min(len(rest), 3 * count // 4)]
    others = np.setdiff1d(free, crowded)
    few = rng.choice(others, min(len(many) // 3, len(others)), replace=False)
    return Pool(np.sort(np.concatenate([many, few])), np.sort(crowd))


def _trained(scene: Path, size: Size, cache: Path | None, progress: Progress) -> Workspace:
    prior = io.read_splats(scene)
    planned = plan_pool(prior, 7 * size.candidates, seed=1, progress=progress)
    universe = planned.cameras.resized(size.pixels)
    rows = np.arange(len(universe))  # every 8th of a planned pool is a fair sample of it
    if planned.kind == "orbit":
        outside = _nearer(prior, universe.take(_evenly(rows[4::8], size.tests)))
    else:
        outside = make_pool(prior, size.tests, kind="orbit", seed=2).resized(size.pixels)

    renderer = Renderer(prior)

    def image(cameras: Cameras, view: int) -> Image:
        return renderer.image(cameras[view])

    return Workspace(
        prior=prior,
        student=_reduced(prior, size),
        targets=_Made(universe, image, cache),
        tests=_evenly(rows[::8], size.tests),
        outside=_Made(outside, image),
        regularizers=PRESETS["trained"],
        candidates=size.candidates,
    )


def _nearer(prior: Splats, cameras: Cameras) -> Cameras:
    """The views moved 40 % of the way to the scene's middle, along their gaze."""
    middle = np.median(prior.means, axis=0) + prior.offset
    steps = 0.4 * np.einsum("ci,ci->c", middle - cameras.positions, cameras.forwards)
    viewmats = cameras.viewmats.copy()
    viewmats[:, 2, 3] -= steps
    return replace(cameras, viewmats=viewmats)


def _city(size: Size, cache: Path | None) -> Workspace:
    height = round(size.pixels * 3 / 4)
    config = CityConfig(points=120_000, views=2000, size=(size.pixels, height))
    town = city(config)
    scan = town.points()
    prior = lift(scan.positions, scan.colors)
    universe, outside = town.views["train"], town.views["ood"]
    rows = np.arange(len(universe))
    return Workspace(
        prior=prior,
        student=_reduced(prior, size),
        targets=_Made(universe, town.photo, cache),
        tests=_evenly(rows, size.tests),
        outside=_Made(outside.take(_evenly(np.arange(len(outside)), size.tests)), town.photo),
        regularizers=PRESETS["lift"],
        sh_degree=3,
        background=config.sky,
        candidates=max(420, size.candidates),
    )


def _photos(folder: Path, size: Size) -> Workspace:
    """Outside is the eighth of the photos at one end of the site; of the others those are tests that the
    folder states as such, else every 8th."""
    found = io.read_view_set(folder)
    stated, words = states_splits(folder, found.splits), splits_of(folder, found.cameras.names, found.splits)
    known = np.array([word in ("train", "test") for word in words])
    cameras, held_out = found.cameras.take(known).resized(size.pixels), np.array(words)[known] == "test"
    points = io.read_points(folder)
    prior = lift(points.positions, points.colors)
    centred = cameras.positions - cameras.positions.mean(0)
    along = np.argsort(centred @ np.linalg.svd(centred, full_matrices=False)[2][0])
    far, rest = along[: len(along) // 8], np.sort(along[len(along) // 8 :])
    return Workspace(
        prior=prior,
        student=_reduced(prior, size),
        targets=_Made(cameras.take(rest), load_image),
        tests=np.flatnonzero(held_out[rest]) if stated else np.arange(0, len(rest), 8),
        outside=_Made(cameras.take(far), load_image),
        regularizers=PRESETS["lift"],
        sh_degree=3,
        candidates=size.candidates,
    )


def _reduced(prior: Splats, size: Size) -> Splats:
    """Without views, so that no pool has a say in it."""
    return simplify(prior, min(size.gaussians, len(prior))).splats


def _evenly(rows: Rows, count: int) -> Rows:
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))]
