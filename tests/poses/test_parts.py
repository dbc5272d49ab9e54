"""Parts of the pose planners: even sequences, fair orders, the occupancy grid, the ground."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from g2ard.poses.matter import Grid, Matter
from g2ard.poses.numbers import halton, strata
from g2ard.poses.site import Site, Terrain
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
        [naive.first_hit(opaque, grid.low, grid.cell, e, w) for e, w in zip(eyes, ways, strict=True)]
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


_CAST = """
import sys
import numpy as np
from g2ard import _core
case = np.load(sys.argv[1])
steps = case["steps"]
found = _core.cast_rays(
    steps.ravel(), list(steps.shape), case["low"].tolist(), float(case["cell"]), case["eyes"], case["ways"]
)
np.save(sys.argv[2], found)
"""


@pytest.mark.parametrize("threads", [1, 2])
def test_cast_equals_its_naive_twin_bit_for_bit(threads, tmp_path: Path) -> None:
    rng = np.random.default_rng(threads)
    shape, low, cell = (13, 7, 9), np.array([-0.3, 0.7, 1e3]), 0.07
    steps = naive.king_steps(rng.random(shape) < 0.02, 12).astype(np.int8)
    at, towards = rng.uniform(-1, 2, (4000, 3)), rng.uniform(0, 1, (4000, 3))
    eyes, ways = low + cell * np.array(shape) * at, cell * np.array(shape) * (towards - at)
    ways[:500] = np.eye(3)[rng.integers(3, size=500)] * rng.choice([-1.0, 1.0], (500, 1))
    eyes[:100] = low + cell * np.array(shape) * rng.integers(0, 2, (100, 3))  # along edges, from corners
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    np.savez(tmp_path / "case.npz", steps=steps, low=low, cell=cell, eyes=eyes, ways=ways)
    program = [sys.executable, "-c", _CAST, str(tmp_path / "case.npz"), str(tmp_path / "found.npy")]
    subprocess.run(program, env={**os.environ, "RAYON_NUM_THREADS": str(threads)}, check=True)
    want = naive.cast_rays(steps, low, cell, eyes, ways)
    assert 300 < np.isfinite(want).sum() < 3500
    np.testing.assert_array_equal(np.load(tmp_path / "found.npy"), want)


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
