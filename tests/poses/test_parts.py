"""Parts of the pose planners: even sequences, fair orders, the occupancy grid, the ground."""

from __future__ import annotations

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.poses import plan_pool
from g2ard.poses.matter import Grid, Matter
from g2ard.poses.sight import Glance
from g2ard.poses.site import Site, Terrain
from g2ard.scene.reproducible import halton, strata
from g2ard.scene.splats import Splats
from helpers.scenes import views_at
from helpers.threads import on_threads
from reference import poses as naive


def test_strata_take_one_of_each_neighbourhood() -> None:
    x = np.random.default_rng(0).permutation(60)
    order = strata(x[:, None].astype(float), 8, seed=1)
    assert sorted(order) == list(range(60))
    for start in range(0, 56, 8):
        assert np.ptp(x[order[start : start + 8]]) == 7


def test_halton_goes_on_where_it_stopped() -> None:
    np.testing.assert_array_equal(halton(0, 30, 6, 3)[10:], halton(10, 30, 6, 3))


def test_grid_equals_its_naive_twin(monkeypatch) -> None:
    monkeypatch.setattr("g2ard.poses.matter._CELLS", (2000, 2000))
    grid = Grid.of(np.full(3, -0.5), np.full(3, 0.5), Matter.of(naive.statue()), np.eye(3))
    opaque = grid.opaque == 0
    assert 0.02 < opaque.mean() < 0.9
    np.testing.assert_array_equal(grid.opaque, naive.king_steps(opaque, 12))
    np.testing.assert_array_equal(grid.murky, naive.king_steps(grid.murky == 0, 12))
    rng = np.random.default_rng(0)
    eyes = rng.uniform(-1, 1, (60, 3))
    ways = rng.uniform(-0.5, 0.5, (60, 3)) - eyes  # most of them through the box
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    got = grid.cast(eyes, ways)
    want = np.array(
        [
            naive.first_hit(opaque, grid.low, grid.cell, e, w)
            for e, w in zip(eyes, ways, strict=True)
        ]
    )
    assert 10 < np.isfinite(want).sum() < 60
    hit = np.isfinite(want) & np.isfinite(got)
    assert (np.isfinite(want) != np.isfinite(got)).sum() <= 2  # corners cut between two steps
    assert (np.abs(got[hit] - want[hit]) < 0.7 * grid.cell).mean() > 0.9
    assert (got[hit] > want[hit] - 0.02 * grid.cell).all()


def test_samples_say_how_many_gaussians_a_row_stands_for() -> None:
    scene = naive.statue()
    whole = Matter.of(scene, represents=2.0)
    some = Matter.of(scene, limit=len(whole.points) // 4, represents=2.0)
    assert whole.represents == 2.0
    visible = np.count_nonzero(scene.opacities > 1 / 255)
    assert some.represents == pytest.approx(2.0 * visible / (len(whole.points) // 4))


def test_cast_equals_its_naive_twin_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    shape, low, cell = (13, 7, 9), np.array([-0.3, 0.7, 1e3]), 0.07
    steps = naive.king_steps(rng.random(shape) < 0.02, 12).astype(np.int8)
    at, towards = rng.uniform(-1, 2, (4000, 3)), rng.uniform(0, 1, (4000, 3))
    eyes, ways = low + cell * np.array(shape) * at, cell * np.array(shape) * (towards - at)
    ways[:500] = np.eye(3)[rng.integers(3, size=500)] * rng.choice([-1.0, 1.0], (500, 1))
    # along edges, from corners
    eyes[:100] = low + cell * np.array(shape) * rng.integers(0, 2, (100, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    want = naive.cast_rays(steps, low, cell, eyes, ways)
    assert 300 < np.isfinite(want).sum() < 3500
    grid = (steps.ravel(), list(steps.shape), low.tolist(), cell, eyes, ways)
    for found in on_threads(lambda: _core.cast_rays(*grid), (1, 2)):
        np.testing.assert_array_equal(found, want)


def test_distance_is_never_too_long() -> None:
    site = Site.of(naive.statue())
    cells = np.argwhere(site.grid.murky == 0)
    points = np.random.default_rng(0).uniform(site.grid.low - 0.3, -site.grid.low + 0.3, (40, 3))
    low = site.grid.low + cells * site.grid.cell
    for point, found in zip(points, site.grid.distance(points), strict=True):
        gap = np.maximum(0, np.maximum(low - point, point - low - site.grid.cell))
        assert found <= np.linalg.norm(gap, axis=1).min() + 1e-9


def test_terrain_follows_slopes_and_goes_under_roofs() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 24, (60_000, 2))
    z = 0.2 * xy[:, 0]
    roof = (np.abs(xy - 12.5) < 1).all(axis=1)
    z[roof] += 5
    points = np.concatenate([xy, z[:, None]], axis=1)
    terrain = Terrain.of(points, np.ones(len(points)), np.array([[0, 0, 0], [24, 24, 10.0]]))
    at = rng.uniform(3, 21, (200, 3))
    np.testing.assert_allclose(terrain.height(at), 0.2 * at[:, 0], atol=0.3)
    np.testing.assert_allclose(terrain.height(np.array([[12.5, 12.5, 0]])), 2.5, atol=0.4)


def test_terrain_is_bilinear_between_blocks_and_flat_beyond_the_edge() -> None:
    rng = np.random.default_rng(1)
    heights = rng.normal(size=(5, 4))
    terrain = Terrain(np.array([2.0, -1.0]), 0.5, heights)
    x, y = rng.uniform(1.5, 5.0, 300), rng.uniform(-1.5, 1.5, 300)
    found = terrain.height(np.stack([x, y, rng.normal(size=300)], axis=1))
    middles = [
        terrain.low[k] + (np.arange(heights.shape[k]) + 0.5) * terrain.block for k in range(2)
    ]
    for at in range(300):
        along_y = [np.interp(y[at], middles[1], row) for row in heights]
        assert found[at] == pytest.approx(np.interp(x[at], middles[0], along_y), abs=1e-12)


def test_the_ground_fixes_the_up_direction_wherever_it_lies() -> None:
    """Most matter of this scene is in the ball, so that the ground lies far below its middle."""
    scene = naive.joined(naive.statue(), naive.sphere((0, 0, 1.3), 1.0, 0.03))
    for seed in range(3):
        turn = naive.rotation(seed)
        up = plan_pool(naive.moved(scene, turn), 1, kind="orbit").up
        assert np.linalg.norm(up - turn[:, 2]) < np.radians(0.1)


@pytest.mark.parametrize("count", [40, 160])
def test_each_spot_of_the_ground_lies_in_about_five_nadir_frames(count: int) -> None:
    ground = naive.rectangle((0, 0, 0), (90, 0, 0), (0, 30, 0), 0.5, (0, 0, 1))
    huts = [naive.box((10.0 * i, 5, 0), (3, 3, 2), 0.4, floor=False) for i in range(3)]
    cameras = plan_pool(naive.joined(ground, *huts), count, kind="aerial", up=(0, 0, 1)).cameras
    nadir = cameras.positions[cameras.forwards[:, 2] < -0.999]
    heights = nadir[:, 2]
    side = 2 * np.tan(np.radians(25))
    frames = (side * heights * 0.75 * side * heights).sum() / (90 * 30)
    assert 3.5 < frames < 8
    assert (np.ptp(nadir[:, :2], axis=0) > (45, 15)).all()


def test_glances_tell_fine_matter_by_its_angle() -> None:
    """Rows of balls whose images do not touch, each at a distance that gives its angle."""
    angles = np.array([0.01, 0.02, 0.028, 0.032, 0.045, 0.08])
    across = np.linspace(-0.5, 0.5, len(angles))
    far = np.where(np.arange(len(angles)) % 2, 2.0, 3.0)
    points = far[:, None] * np.stack([across, np.zeros(len(angles)), np.ones(len(angles))], axis=1)
    away = np.linalg.norm(points, axis=1)
    scene = Splats.create(points, scales=np.repeat((angles * away)[:, None], 3, axis=1))
    views = views_at([np.eye(4)], (96, 72), 80.0)
    single = np.array(
        [Glance(scene.take(slice(i, i + 1))).of(views)[0, 0] for i in range(len(angles))]
    )
    mean, fine, coarse = Glance(scene).of(views)[:, 0]
    assert mean == pytest.approx(single.sum(), rel=0.05)
    assert fine == pytest.approx(single[:3].sum(), rel=0.05)
    assert coarse == pytest.approx(0.08)
    mean, fine, coarse = Glance(scene).of(views, reach=np.array([2.6]))[:, 0]
    assert mean == pytest.approx(single.sum(), rel=0.05)
    assert fine == pytest.approx(single[1:3:2].sum(), rel=0.05)


def test_a_wide_disc_fills_the_cells_around_its_centre(monkeypatch) -> None:
    monkeypatch.setattr("g2ard.poses.matter._CELLS", (64_000, 64_000))  # forty along a side
    disc = Splats.create([[0.0, 0, 0]], scales=[[0.3, 0.2, 1e-3]], logit_opacities=[3.0])
    matter = Matter.of(disc)
    half = 5 * matter.scales[0, 2]
    grid = Grid.of(np.full(3, -half), np.full(3, half), matter, np.eye(3))
    filled = np.argwhere(grid.opaque == 0)
    centres = grid.low + (filled + 0.5) * grid.cell
    reach = np.abs(centres).max(axis=0) / matter.scales[0, 2]
    np.testing.assert_allclose(
        centres[:, :2].min(axis=0), -centres[:, :2].max(axis=0), atol=grid.cell
    )
    np.testing.assert_allclose(reach[:2], [1.4, 0.9], atol=0.2)


def test_the_reason_of_the_up_direction_says_what_decides_its_sign() -> None:
    z = np.linspace(0, 9, 4000) ** 2 / 9  # denser at its foot
    turns = np.arange(4000) * 2.4
    round_ = np.stack([np.cos(turns), np.sin(turns), np.zeros(4000)], axis=1)
    pole = naive.discs(0.3 * round_ + np.outer(z, [0, 0, 1]), round_, 0.05)
    found = plan_pool(pole, 1, kind="orbit")
    assert found.up @ (0, 0, 1) > 0.99
    assert "heavier end is down" in found.why
    assert "lies above it" in plan_pool(naive.statue(), 1, kind="orbit").why
