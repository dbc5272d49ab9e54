"""Policies of view selection that only studies have."""

import numpy as np
import pytest

from benchmarks.policies import POLICIES, order_views
from g2ard.scene.cameras import look_at
from g2ard.stages.select import CoverageOptions, surface, visible_cells
from helpers.scenes import around, checkered_ball, views_at
from reference import select as naive

BALL = checkered_ball(800)
OPTIONS = CoverageOptions(cells=300)


@pytest.mark.parametrize("policy", POLICIES)
def test_every_view_that_sees_the_scene_comes_once(policy: str) -> None:
    pool = around(8)
    away = look_at([30.0, 0, 0], [60, 0, 0])
    mixed = views_at([*pool.viewmats[:3], away, *pool.viewmats[3:]])
    order = order_views(BALL, mixed, policy, options=OPTIONS)
    assert sorted(order.tolist()) == [0, 1, 2, 4, 5, 6, 7, 8]
    same = views_at([pool.viewmats[0]] * 4)
    assert sorted(order_views(BALL, same, policy, options=OPTIONS).tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize("policy", [p for p in POLICIES if p != "random"])
def test_duplicate_poses_come_last(policy: str) -> None:
    first = np.array([0, 0, 0, 1, 1, 2, 3, 4, 4, 4])
    pool = views_at([around(5).viewmats[i] for i in first])
    order = order_views(BALL, pool, policy, options=OPTIONS)
    assert len(set(first[order[:5]])) == 5


def test_random_depends_on_its_seed_alone() -> None:
    orders = [order_views(BALL, around(12), "random", seed=seed).tolist() for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]


def test_pose_diverse_leaves_the_crowd() -> None:
    """Nine tenths of the pool crowd into one spot: nearly all of 10 chosen views lie elsewhere."""
    crowd = [look_at([4, 0.001 * i, 0], [0, 0, 0]) for i in range(90)]
    angles = np.linspace(0.5, 2 * np.pi - 0.5, 10)
    ring = [look_at([4 * np.cos(angle), 4 * np.sin(angle), 0], [0, 0, 0]) for angle in angles]
    order = order_views(BALL, views_at([*crowd, *ring]), "pose-diverse")
    assert (order[:10] >= 90).sum() >= 8


def test_coverage_is_greedy_over_visible_cells() -> None:
    cells, pool = surface(BALL, OPTIONS.cells), around(8)
    starts, rows = visible_cells(BALL, cells, pool)
    seen = [rows[starts[i] : starts[i + 1]] for i in range(len(pool))]
    positions = pool.recentred(cells.origin).positions
    want, _ = naive.greedy(4, cells, seen, positions, directional=False, alpha=OPTIONS.alpha)
    assert order_views(BALL, pool, "coverage", options=OPTIONS)[:4].tolist() == want
