"""Widths of merged Gaussians: surfaces of one layer stay closed, layers on each other stay sharp."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.lift import lift
from g2ard.stages.simplify import SimplifyConfig, simplify
from g2ard.stages.simplify.gaps import opacity_lost
from helpers.scenes import assert_same_bits
from helpers.threads import on_threads
from reference import simplify as naive

ALL_MASS = {"surface_depth": math.inf}
"""Settings with which `max_growth` alone limits how far rows widen."""


def plane(seed: int, count: int = 6000) -> Splats:
    """Lift points of a textured plane, in any direction and unit, of one layer."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0]
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    colors = 0.5 + 0.3 * np.sin(points @ rng.normal(size=(3, 3)) * 4)
    return lift(points @ turn * 10.0 ** rng.integers(-2, 3), colors)


def stack(seed: int, count: int = 1000, layers: int = 6) -> Splats:
    """Return a slab of many opaque layers, as training leaves it: behind a gap is the same colour."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count * layers, 3)) * [1, 1, 0]
    points[:, 2] = np.repeat(np.linspace(0, 0.1, layers), count)
    return Splats.create(
        points,
        scales=np.tile([0.06, 0.06, 0.006], (len(points), 1)),
        logit_opacities=np.full(len(points), 4.0),
        sh0=np.sin(points @ rng.normal(size=(3, 3)) * 6)[:, None],
    )


def ball(seed: int, count: int = 6000) -> Splats:
    """Return a ball of Gaussians of all opacities, dense at its surface."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= (1 - 0.25 * rng.random((count, 1)) ** 2) / np.linalg.norm(
        points, axis=1, keepdims=True
    )
    return Splats.create(
        points,
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-3, 0.5, (count, 3))),
        logit_opacities=rng.normal(1, 2, count),
        sh0=np.sin(points @ rng.normal(size=(3, 3)) * 5)[:, None],
    )


def around(scene: Splats, count: int = 8) -> Cameras:
    """Return views of a scene from both sides."""
    middle, size = scene.means.mean(axis=0), np.ptp(scene.means, axis=0).max()
    directions = np.random.default_rng(7).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Cameras.of(
        Camera.facing(middle + 1.6 * size * d, middle, width=120, height=120, name=f"{i}")
        for i, d in enumerate(directions)
    )


def lost(dense: Splats, small: Splats) -> float:
    """Return the mean opacity lost in pixels where the dense scene is opaque."""
    before, after = Renderer(dense), Renderer(small)
    gone, there = 0.0, 0
    for view in around(dense):
        a, b = before.render(view).alpha, after.render(view).alpha
        opaque = a > 0.9
        gone, there = gone + float(np.maximum(a - b, 0)[opaque].sum()), there + int(opaque.sum())
    return gone / there


def likeness(dense: Splats, small: Splats) -> float:
    """Return the mean PSNR of a result."""
    before, after = Renderer(dense), Renderer(small)
    return float(
        np.mean([psnr(after.clipped(view), before.clipped(view)) for view in around(dense)])
    )


def reduced(scene: Splats, ratio: float, *, seen: bool, method: str = "default", **how: Any) -> Any:
    source = visibility_source(around(scene, 6)) if seen else None
    return simplify(scene, round(len(scene) / ratio), method=method, visibility=source, **how)


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("method", ["default", "fast"])
@pytest.mark.parametrize(("ratio", "most"), [(5, 0.03), (10, 0.06), (24, 0.11), (50, 0.2)])
def test_a_surface_of_one_layer_stays_closed(
    ratio: float, most: float, method: str, seen: bool
) -> None:
    scene = plane(ratio)
    through = lost(scene, reduced(scene, ratio, seen=seen, method=method).splats)
    assert through < most
    little = SimplifyConfig(max_growth=1.25, **ALL_MASS)
    usual = lost(scene, reduced(scene, ratio, seen=seen, method=method, config=little).splats)
    assert through < 0.7 * usual if usual > 0.03 else through <= usual


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("kind", [plane, stack, ball])
def test_every_scene_is_better_than_without_growth(
    kind: Callable[[int], Splats], seen: bool
) -> None:
    scene = kind(1)
    fixed = reduced(scene, 12, seen=seen, config=SimplifyConfig(max_growth=1))
    assert fixed.report.clamped_opacities > 0.3 * len(fixed.splats)
    assert (
        likeness(scene, reduced(scene, 12, seen=seen).splats) > likeness(scene, fixed.splats) + 0.5
    )


@pytest.mark.parametrize("kind", [plane, stack, ball])
@pytest.mark.parametrize("method", ["default", "fast"])
def test_rows_widen_by_what_the_naive_twin_says(kind: Callable[[int], Splats], method: str) -> None:
    scene = kind(4).take(np.arange(1500))
    as_merged, small = (
        simplify(scene, 150, method=method, config=SimplifyConfig(max_growth=growth)).splats
        for growth in (1.0, math.inf)
    )
    every = simplify(scene, 150, method=method, config=SimplifyConfig(**ALL_MASS)).splats
    needed = every.scales.prod(axis=1, dtype=float) / as_merged.scales.prod(axis=1, dtype=float)
    limit = np.maximum(1.15, 3 / naive.surface_depths(as_merged))
    growth = small.scales.prod(axis=1, dtype=float) / as_merged.scales.prod(axis=1, dtype=float)
    np.testing.assert_allclose(growth, np.minimum(needed, limit), rtol=1e-4)
    shortest = np.argmin(as_merged.scales, axis=1)[:, None]
    np.testing.assert_array_equal(
        *(np.take_along_axis(s.scales, shortest, 1) for s in (small, as_merged))
    )


@pytest.mark.parametrize("seen", [True, False])
def test_nothing_changes_where_opacity_holds_the_mass(seen: bool) -> None:
    scene = plane(2)
    faint = replace(scene, logit_opacities=scene.logit_opacities - 4)
    fixed = reduced(faint, 10, seen=seen, config=SimplifyConfig(max_growth=1))
    assert_same_bits(reduced(faint, 10, seen=seen).splats, fixed.splats)


def test_gaps_are_measured_in_the_views_that_weigh_rows() -> None:
    scene = plane(0, 2000)
    little = SimplifyConfig(max_growth=1)
    out = reduced(scene, 24, seen=True, gaps=True, config=little)
    assert out.report.opacity_lost == pytest.approx(lost(scene, out.splats), rel=0.5)
    assert out.report.opacity_lost == opacity_lost(scene, out.splats, around(scene, 6))
    assert (
        reduced(scene, 24, seen=True, gaps=True).report.opacity_lost < 0.5 * out.report.opacity_lost
    )
    assert reduced(scene, 24, seen=True, config=little).report.opacity_lost is None
    assert reduced(scene, 24, seen=False, gaps=True).report.opacity_lost is None


def test_only_pixels_where_the_dense_scene_is_opaque_count_as_gaps() -> None:
    faint = replace(plane(5), logit_opacities=np.full(6000, -4.0, np.float32))
    assert opacity_lost(faint, faint.take(np.arange(0, 6000, 9)), around(faint)) == 0


def test_the_number_of_threads_and_the_order_of_rows_do_not_matter() -> None:
    scene = plane(3, 3000)
    first, *others = on_threads(lambda: reduced(scene, 24, seen=False))
    for other in others:
        assert_same_bits(first.splats, other.splats)
    shuffled = scene.take(np.random.default_rng(0).permutation(len(scene)))
    assert_same_bits(first.splats, reduced(shuffled, 24, seen=False).splats)


@pytest.mark.parametrize(("spread", "scale"), [(0, 0.5), (1e-30, 1e-20), (1e6, 0.5), (1e13, 0.5)])
def test_any_extent_stays_finite(spread: float, scale: float) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * spread
    scene = Splats.create(points, scales=np.full((50, 3), scale), offset=[5e6, 4e5, 0])
    small = simplify(scene, 5).splats
    assert len(small) == 5
    assert np.isfinite(small.scales).all()
