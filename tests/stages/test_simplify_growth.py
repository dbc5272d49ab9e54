"""The growth of merged Gaussians: surfaces stay closed, layers stay sharp."""

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
from g2ard.stages.simplify.growth import GROWTHS, best_growth, outside_views, widened
from helpers.scenes import assert_same_bits
from helpers.threads import on_threads


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
    points *= (1 - 0.25 * rng.random((count, 1)) ** 2) / np.linalg.norm(points, axis=1, keepdims=True)
    return Splats.create(
        points,
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-3, 0.5, (count, 3))),
        logit_opacities=rng.normal(1, 2, count),
        sh0=np.sin(points @ rng.normal(size=(3, 3)) * 5)[:, None],
    )


def around(scene: Splats, count: int = 8) -> Cameras:
    """Return views of a scene from both sides, at other angles than those that growth is measured in."""
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
    return float(np.mean([psnr(after.clipped(view), before.clipped(view)) for view in around(dense)]))


def reduced(scene: Splats, ratio: float, *, seen: bool, method: str = "default", **how: Any) -> Any:
    source = visibility_source(around(scene, 6)) if seen else None
    return simplify(scene, round(len(scene) / ratio), method=method, visibility=source, **how)


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("method", ["default", "fast"])
@pytest.mark.parametrize(("ratio", "most"), [(5, 0.03), (10, 0.06), (24, 0.11), (50, 0.2)])
def test_a_surface_of_one_layer_stays_closed(ratio: float, most: float, method: str, seen: bool) -> None:
    scene = plane(ratio)
    out = reduced(scene, ratio, seen=seen, method=method, compare=True)
    through = lost(scene, out.splats)
    assert through < most
    assert out.report.opacity_lost == pytest.approx(through, abs=0.4 * most)
    usual = lost(scene, reduced(scene, ratio, seen=seen, method=method).splats)
    assert through < 0.7 * usual if usual > 0.03 else through <= usual


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("kind", [plane, stack, ball])
def test_no_scene_gets_worse(kind: Callable[[int], Splats], seen: bool) -> None:
    scene = kind(1)
    chosen, usual = (reduced(scene, 12, seen=seen, compare=compare) for compare in (True, False))
    assert chosen.report.clamped_opacities > 0.3 * len(chosen.splats)
    assert likeness(scene, chosen.splats) > likeness(scene, usual.splats) - 0.1


@pytest.mark.parametrize("seen", [True, False])
def test_nothing_changes_where_opacity_holds_the_mass(seen: bool) -> None:
    scene = plane(2)
    faint = replace(scene, logit_opacities=scene.logit_opacities - 4)
    out = reduced(faint, 10, seen=seen, compare=True)
    assert out.report.growth == GROWTHS[0]
    assert_same_bits(out.splats, reduced(faint, 10, seen=seen).splats)


def test_a_given_growth_is_kept_and_paper_has_none() -> None:
    scene = plane(0, 2000)
    given = reduced(scene, 10, seen=False, compare=True, config=SimplifyConfig(max_growth=1.1))
    assert given.report.growth == 1.1
    assert given.report.opacity_lost > 0.02
    paper = reduced(scene, 10, seen=False, method="paper", compare=True)
    assert (paper.report.growth, paper.report.opacity_lost) == (None, None)


def test_the_number_of_threads_and_the_order_of_rows_do_not_matter() -> None:
    scene = plane(3, 3000)
    first, *others = on_threads(lambda: reduced(scene, 24, seen=False, compare=True))
    assert first.report.growth > GROWTHS[0]
    for other in others:
        assert_same_bits(first.splats, other.splats)
    shuffled = scene.take(np.random.default_rng(0).permutation(len(scene)))
    assert_same_bits(first.splats, reduced(shuffled, 24, seen=False, compare=True).splats)


@pytest.mark.parametrize(
    ("spread", "scale", "views"), [(0, 0.5, 6), (1e-30, 1e-20, 0), (1e6, 0.5, 6), (1e13, 0.5, 0)]
)
def test_any_extent_is_seen_from_outside_or_not_at_all(spread: float, scale: float, views: int) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * spread
    scene = Splats.create(points, scales=np.full((50, 3), scale), offset=[5e6, 4e5, 0])
    assert len(outside_views(scene)) == views
    assert len(simplify(scene, 5, compare=True).splats) == 5


def test_rows_widen_along_the_surface_to_what_they_need() -> None:
    scene = Splats.create(np.zeros((3, 3)), scales=[[1, 4, 4], [4, 1, 4], [4, 4, 1]])
    out = widened(scene, np.array([1.0, 2.0, 9.0], np.float32), 3.2)
    area = out.scales.prod(axis=1) / scene.scales.prod(axis=1)
    np.testing.assert_allclose(area, [1, 2 / 1.25, 3.2 / 1.25], rtol=1e-6)
    assert (out.scales.min(axis=1) == 1).all()
    assert_same_bits(widened(scene, np.array([1.0, 2.0, 9.0], np.float32), GROWTHS[0]), scene)


def test_the_first_growth_wins_ties() -> None:
    assert best_growth(lambda growth: 0.0) == GROWTHS[0]
    assert best_growth(lambda growth: -growth) == GROWTHS[-1]
