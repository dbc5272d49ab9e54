"""View selection by surfaces: cells of the scene, their visibility in views, and the greedy order."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.arrays import Float, Int
from g2ard.config.checks import AtLeastOne, NotNegative, Positive, Within
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.progress import Progress, counter, silent
from g2ard.rendering.renderer import View, settings_for, view_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats, check_finite, unit_quats

_CORE = _core.defaults()["coverage"]


@dataclass(frozen=True)
class CoverageOptions(Settings):
    """Options of the policy `directional` (the paper, eq. `view_selection`; `tab:s_avs`).

    Args:
        cells: number M of surface cells (adaptive voxels).
        alpha: exponent of the fair utility u(x) = x^(1−α)/(1−α).
        offset: g(x) = u(offset + x); the paper's λ.
        epsilon: ε of the coverage ratio C_jk / (P_jk + ε).
        depth_tolerance: a cell is visible if its depth differs from the pixel's by at most this share, or by
            a cell's size.
        kappa: sharpness of the observation kernel and of the targets.
        anchors: directions on the sphere, at most 64, at which targets and observations are evaluated.
    """

    cells: AtLeastOne = 300_000
    alpha: NotNegative = _CORE["alpha"]
    offset: Positive = _CORE["offset"]
    epsilon: Positive = _CORE["epsilon"]
    depth_tolerance: NotNegative = 0.01
    kappa: Positive = _CORE["kappa"]
    anchors: Annotated[int, Within("[1, 64]")] = _CORE["anchors"]


@dataclass(frozen=True, eq=False)
class Surface:
    """M surface cells, in coordinates relative to `origin`.

    Args:
        centers: (M, 3) float64.
        normals: (M, 3) float64 unit, unoriented.
        confidence: (M,) float64 in [0, 1], planarity (λ₂ − λ₃)/λ₁.
        weights: (M,) float64, footprint areas capped at their 99th percentile, summing to 1.
        size: edge of a cell, scene units.
        origin: (3,) float64 world coordinates.
    """

    centers: Float
    normals: Float
    confidence: Float
    weights: Float
    size: float
    origin: Float

    @property
    def parts(self) -> tuple[Float, Float, Float, Float, float]:
        """Arrays in the form that `_core` takes."""
        return self.centers, self.normals, self.confidence, self.weights, self.size


def surface(splats: Splats, cells: int = 300_000) -> Surface:
    """Partition a scene into about `cells` surface cells.

    Raises:
        InputError: the scene is empty or not finite.
    """
    require("cells", cells, cells >= 1, "at least 1")
    scene, origin = core_scene(splats)
    return Surface(**_core.select_surface(scene, cells), origin=origin)


def visible_cells(
    splats: Splats,
    cells: Surface,
    cameras: Cameras,
    *,
    depth_tolerance: float = CoverageOptions.depth_tolerance,
    progress: Progress = silent,
) -> tuple[NDArray[np.uint64], NDArray[np.uint32]]:
    """Compute the visibility ν_jv of a scene's cells in C views, world coordinates, from its median depth.

    A cell is visible if its centre projects into the image and lies within max(cell size, depth_tolerance ·
    depth) of the pixel's median depth (gsplat's convention).

    Returns:
        (C + 1,) starts and the rows of cells: view v sees cells[starts[v]:starts[v + 1]], ascending.
    """
    scene, origin = core_scene(splats)
    return _core.select_visible(
        scene,
        cells.parts,
        core_views(cameras, origin, scene),
        tolerance=depth_tolerance,
        progress=counter(progress, "visibility"),
    )


def core_scene(splats: Splats) -> tuple[tuple[Any, ...], Float]:
    """Return the arrays that `_core` takes, and the world point they are relative to."""
    if not len(splats):
        raise InputError("the scene is empty")
    check_finite(splats, "splats")
    means = splats.means.astype(np.float64)
    middle = np.median(means, axis=0)
    arrays = (means - middle, unit_quats(splats.quats), splats.scales, splats.opacities)
    return tuple(np.ascontiguousarray(a) for a in arrays), middle + splats.offset


def core_views(cameras: Cameras, origin: Float, scene: tuple[Any, ...]) -> list[View]:
    """Convert cameras to the form that `_core` takes, relative to the origin of `core_scene`."""
    settings = settings_for(scene[0])
    local = cameras.recentred(origin)
    return [view_of(local, i, settings) for i in range(len(local))]


def greedy(
    splats: Splats,
    cameras: Cameras,
    options: CoverageOptions | None,
    progress: Progress,
    seconds: dict[str, float],
) -> tuple[Int, Float, int]:
    """Return the views that see a cell in greedy order, their gains, and the number of evaluations."""
    options = options or CoverageOptions()
    began = time.perf_counter()
    cells = surface(splats, options.cells)
    seconds["surface"] = time.perf_counter() - began
    began = time.perf_counter()
    starts, seen = visible_cells(
        splats, cells, cameras, depth_tolerance=options.depth_tolerance, progress=progress
    )
    seconds["visibility"] = time.perf_counter() - began
    usable = np.diff(starts.astype(np.int64)) > 0
    began = time.perf_counter()
    order, gains, evaluations = _core.select_greedy(
        cells.parts,
        (starts, seen, np.ascontiguousarray(cameras.recentred(cells.origin).positions)),
        len(cameras),
        config=options,
        progress=counter(progress, "select"),
    )
    seconds["greedy"] = time.perf_counter() - began
    keep = usable[order]
    return order.astype(np.int64)[keep], gains[keep], evaluations
