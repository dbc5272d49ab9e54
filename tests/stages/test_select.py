"""View selection: depths and greedy choices against naive twins; every policy on pools of all shapes."""

from dataclasses import replace

import numpy as np
import pytest

import g2ard._core as _core
from benchmarks.synth import city
from g2ard.config.choices import POLICIES
from g2ard.errors import InputError
from g2ard.io import read_splats
from g2ard.poses import make_pool
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import Splats
from g2ard.stages.lift import lift
from g2ard.stages.select import (
    CoverageOptions,
    Surface,
    poses,
    select,
    surface,
    surfaces,
    visible_cells,
)
from helpers.realdata import real
from helpers.scenes import in_units, views_at
from helpers.threads import on_threads
from reference import rays
from reference import select as naive

SIZE = (96, 72)
FOCAL = 80.0
K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])


def ball(count=1500, seed=0, offset=(0.0, 0.0, 0.0)) -> Splats:
    """An opaque sphere of discs with a pillar beside it."""
    rng = np.random.default_rng(seed)
    n = rng.standard_normal((count, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    quats = np.column_stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(count)])  # z onto n
    pillar = rng.uniform(-0.2, 0.2, (count // 5, 3)) * [1, 1, 8] + [1.8, 0, 0]
    return Splats.create(
        np.concatenate([n, pillar]),
        quats=np.concatenate([quats, np.tile([1.0, 0, 0, 0], (len(pillar), 1))]),
        scales=np.concatenate(
            [np.tile([0.08, 0.08, 0.01], (count, 1)), np.full((len(pillar), 3), 0.06)]
        ),
        logit_opacities=rng.uniform(0, 5, count + len(pillar)),
        offset=offset,
    )


def views(positions, targets=None) -> Cameras:
    positions = np.asarray(positions, float)
    targets = np.zeros_like(positions) if targets is None else targets
    return views_at([look_at(p, t) for p, t in zip(positions, targets, strict=True)], SIZE, FOCAL)


def around(count, seed=0, radius=4.0) -> Cameras:
    rng = np.random.default_rng(seed)
    d = rng.standard_normal((count, 3))
    return views(radius * d / np.linalg.norm(d, axis=1)[:, None])


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (4.4e5, 4.4e6, 1e3)])
def test_view_statistics_are_the_naive_renderers(offset):
    scene = ball(offset=offset)
    cameras = around(3).recentred(-np.asarray(offset))
    parts, origin = surfaces.core_scene(scene)
    found = _core.select_view_statistics(parts, surfaces.core_views(cameras, origin, parts))
    grid = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), -1).reshape(
        -1, 2
    )
    for (share, median), viewmat in zip(found, cameras.viewmats, strict=True):
        depth = naive.median_depth(scene, viewmat, K, grid)
        shown = np.sort(depth[depth > 0])
        assert len(shown) > 800
        # float32 may cross one half a splat later
        assert abs(share - len(shown) / len(depth)) < 0.002
        assert shown[len(shown) // 2 - 5] * 0.9999 < median < shown[len(shown) // 2 + 5] * 1.0001


@pytest.mark.parametrize(("real_scene", "tolerance"), [(True, 0.01), (False, 0.01), (False, 0.2)])
def test_visibility_of_scenes_is_a_ray_oracle_s(real_scene, tolerance):
    """A slice of a real scene and a small city against every Gaussian at every ray."""
    if real_scene:
        scene = read_splats(real("playbot", "0_0"))
        scene = scene.take(np.arange(0, len(scene), 80))  # thinner, so each is larger in its stead
        scene = replace(scene, scales=scene.scales * np.float32(np.sqrt(80)))
        pool = make_pool(scene, 24, seed=3).take([0, 9, 17]).resized(240)
    else:
        town = city(points=4000, views=24, size=(240, 180), blocks=1)
        scan, pool = town.points(), town.views["train"].take([0, 6, 15])
        scene = lift(scan.positions, scan.colors)
    cells = 100
    made = surface(scene, 20_000)
    seen = visible_cells(scene, made, pool, depth_tolerance=tolerance)
    tried = np.random.default_rng(0).choice(len(made.centers), cells, replace=False)
    agree, kept, total = rays.agreement(scene, made, pool, seen, tried, tolerance)
    assert total > cells / 2
    assert kept > 0.1 * total
    assert agree >= 0.995 * kept


def random_problem(rng, count=12, cells=60):
    n = rng.standard_normal((cells, 3))
    made = Surface(
        rng.standard_normal((cells, 3)),
        n / np.linalg.norm(n, axis=1)[:, None],
        rng.random(cells),
        rng.random(cells),
        0.1,
        np.zeros(3),
    )
    seen = [np.flatnonzero(rng.random(cells) < rng.uniform(0.05, 0.6)) for _ in range(count)]
    return made, seen, rng.standard_normal((count, 3)) * 4


def run_greedy(made, seen, positions, k, **options):
    starts = np.concatenate([[0], np.cumsum([len(s) for s in seen])]).astype(np.uint64)
    views = starts, np.concatenate(seen).astype(np.uint32), positions
    return _core.select_greedy(made.parts, views, k, CoverageOptions(**options))


@pytest.mark.parametrize("alpha", [2.0, 1.0, 0.5])
def test_greedy_is_the_naive_greedy(alpha):
    rng = np.random.default_rng(1)
    for _ in range(3):
        made, seen, positions = random_problem(rng)
        seen[-1], positions[-1] = seen[0], positions[0]  # twins: ties go to the first
        order, gains, evaluations = run_greedy(made, seen, positions, 6, alpha=alpha)
        want, value = naive.greedy(6, made, seen, positions, directional=True, alpha=alpha)
        assert order.tolist() == want
        np.testing.assert_allclose(gains, value, rtol=1e-6, atol=1e-12)
        assert np.all(np.diff(gains) <= 1e-12)  # submodular: gains never rise
        # those of a search that evaluates every view again
        assert evaluations < 12 + 11 + 10 + 9 + 8 + 7


def test_directions_and_epsilon_are_options():
    made, seen, positions = random_problem(np.random.default_rng(5))
    order, gains, _ = run_greedy(made, seen, positions, 6, anchors=48, epsilon=0.1)
    want, value = naive.greedy(
        6, made, seen, positions, directional=True, directions=48, epsilon=0.1
    )
    assert order.tolist() == want
    np.testing.assert_allclose(gains, value, rtol=1e-6, atol=1e-12)
    _, usual, _ = run_greedy(made, seen, positions, 6)
    assert abs(usual[0] - gains[0]) > 1e-3 * abs(usual[0])
    with pytest.raises(InputError, match=r"anchors: .*1, 64"):
        run_greedy(made, seen, positions, 6, anchors=65)


@pytest.mark.parametrize("count", [30, 9])
def test_auto_reaches_every_pose_and_then_represents(count):
    scene, cameras = ball(), around(count)
    coarse = surface(scene, 1000)
    depths, shares = poses.outlooks(coarse, cameras)
    alike = poses.pose_kernel(cameras, depths)
    wanted = poses.inverse_density(alike)
    np.testing.assert_array_equal(alike, alike.T)
    np.testing.assert_array_equal(np.diag(alike), 1.0)
    order = poses.facility_location(alike, wanted, np.ones(count, bool), shares)
    gains = poses.gains_of(order, alike, wanted)
    assert order.tolist() == naive.represent(count, alike, wanted, shares)
    assert gains.sum() == pytest.approx(1.0)
    assert gains.min() >= 0


def test_outlooks_count_surface_in_front():
    scene = ball()
    coarse = surface(scene, 2000)
    facing, back = (
        views([[0, -4.0, 0], [0, -4.0, 0]]),
        views([[0, -4.0, 0]], targets=[[0, -8.0, 0]]),
    )
    depths, shares = poses.outlooks(coarse, facing)
    assert depths[0] == depths[1] > 2
    assert 0.2 < shares[0] < 0.8  # not what the ball's front hides
    depths, shares = poses.outlooks(coarse, back)
    assert (depths[0], shares[0]) == (0, 0)


def test_auto_leaves_the_crowd():
    """Nine tenths of the pool crowd into one spot: nearly all of 10 chosen views lie elsewhere."""
    rng = np.random.default_rng(3)
    crowd = np.array([4.0, 0, 0]) + 0.05 * rng.standard_normal((90, 3))
    ring = np.linspace(0.5, 2 * np.pi - 0.5, 10)
    cameras = views(
        np.concatenate([crowd, 4 * np.stack([np.cos(ring), np.sin(ring), 0 * ring], 1)])
    )
    assert (select(ball(), cameras, 10).order >= 90).sum() >= 8
    many = select(ball(), cameras, 100)
    assert many.weights.mean() == pytest.approx(1.0)
    by_view = np.zeros(100)
    by_view[many.order] = many.weights
    assert by_view[90:].mean() > 10 * by_view[:90].mean()  # the crowd is drawn as one


@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_on_every_pool(policy):
    scene, options = ball(600), CoverageOptions(cells=300)
    pool = around(12)

    def run(cameras, k):
        return select(scene, cameras, k, policy=policy, options=options)

    one = run(pool.take([3]), 1)
    assert one.order.tolist() == [0]
    assert one.weights.tolist() == [1.0]
    everything = run(pool, 99)
    assert sorted(everything.order.tolist()) == list(range(12))
    assert everything.left_out == 0
    assert everything.gains.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(np.cumsum(everything.gains), everything.curve)
    few = run(pool, 5)
    assert len(set(few.order.tolist())) == 5
    np.testing.assert_array_equal(few.order, everything.order[:5])  # best first
    assert few.left_out == pytest.approx(1 - few.gains.sum())
    twice = Cameras.of(replace(pool[i // 2], name=str(i)) for i in range(24))
    assert len(run(twice, 20).order) == 20
    same = run(Cameras.of(replace(pool[0], name=str(i)) for i in range(6)), 3)
    assert len(set(same.order.tolist())) == 3
    assert np.isfinite(same.gains).all()
    assert same.weights.sum() == pytest.approx(3)
    away = views(
        [[4.0, 0, 0], [0, 4.0, 0], [9.0, 9, 9]], np.array([[0.0, 0, 0], [0, 0, 0], [99, 99, 99]])
    )
    partly = run(away, 3)
    assert sorted(partly.order.tolist()) == [0, 1]
    assert partly.refused.tolist() == [2]
    with pytest.raises(InputError, match="none of 1 view sees the scene"):
        run(away.take([2]), 1)


def test_a_view_within_matter_is_refused(tmp_path):
    rng = np.random.default_rng(5)
    solid = rng.standard_normal((6000, 3))
    solid *= (rng.random(6000) ** (1 / 3) / np.linalg.norm(solid, axis=1))[:, None]
    scene = Splats.create(
        solid, scales=np.full((6000, 3), 0.04), logit_opacities=np.full(6000, 3.0)
    )
    pool = views(
        [[4.0, 0, 0], [0.2, 0.1, 0], [0, 4.0, 0]], np.array([[0.0, 0, 0], [3, 0, 0.1], [0, 0, 0]])
    )
    for policy in POLICIES:
        chosen = select(scene, pool, 3, policy=policy, options=CoverageOptions(cells=1000))
        assert sorted(chosen.order.tolist()) == [0, 2]
        assert chosen.refused.tolist() == [1]
    photos = replace(pool, image_paths=(None, tmp_path / "photo.png", None))  # there was a camera
    assert not len(select(scene, photos, 3).refused)
    alone = select(scene, pool.take([1]), 1)  # nothing to compare it with
    assert alone.order.tolist() == [0]


def test_a_view_is_within_matter_nearer_than_a_fiftieth_of_the_usual_depth():
    """Views of a flat wall, whose depths are the distances to it, of the same sight in any unit."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-6, 6, 121), np.linspace(-6, 6, 121)))
    wall = Splats.create(
        np.stack([x, y, 0 * x], axis=1),
        scales=np.tile([0.1, 0.1, 1e-4], (len(x), 1)),
        logit_opacities=3 + 0 * x,
    )
    away = np.array([2.0] * 5 + [0.1, 0.06, 0.044, 0.036, 0.025, 0.015])
    eyes = np.stack([np.linspace(-2, 2, len(away)), 0 * away, away], axis=1)
    cameras = views(eyes, eyes - [0, 0, 1])
    for unit in (1, 1e3):
        scene, pool = in_units(wall, cameras, unit)
        depths, _ = poses.outlooks(surface(scene, 5000), pool)
        inside = poses.inside_geometry(scene, pool, depths, lambda *_: None)
        np.testing.assert_array_equal(inside, away < 0.04)


def test_auto_k_stops_at_the_bend():
    ring = np.repeat(np.linspace(0, 2 * np.pi, 6, endpoint=False), 10)
    rng = np.random.default_rng(4)
    places = 4 * np.stack([np.cos(ring), np.sin(ring), 0 * ring], 1) + 0.02 * rng.standard_normal(
        (60, 3)
    )
    chosen = select(ball(), views(places), "auto")
    assert len(chosen.order) == 6
    assert len(set((chosen.order // 10).tolist())) == 6
    assert chosen.left_out < 0.1


def test_neither_threads_nor_runs_change_anything():
    scene, pool = ball(), around(25)
    options = CoverageOptions(cells=800)
    first, *others = on_threads(
        lambda: select(scene, pool, 10, policy="directional", options=options)
    )
    for other in others:
        np.testing.assert_array_equal(other.order, first.order)
        np.testing.assert_array_equal(other.gains, first.gains)


def test_offset_and_scale_change_nothing():
    pool = around(20)
    base = select(ball(), pool, 8)
    offset = np.array([4.4e5, 4.4e6, 1e3])
    moved = select(ball(offset=tuple(offset)), pool.recentred(-offset), 8)
    np.testing.assert_array_equal(moved.order, base.order)
    np.testing.assert_array_equal(select(*in_units(ball(), pool, 8), 8).order, base.order)


@pytest.mark.parametrize(
    ("k", "policy", "words"),
    [
        (0, "auto", "k"),
        (2.5, "auto", "k"),
        (3, "best", "policy"),
        (3, "random", "auto, directional"),
    ],
)
def test_invalid_arguments_are_named(k, policy, words):
    with pytest.raises(InputError, match=words):
        select(ball(200), around(5), k, policy=policy)
    with pytest.raises(InputError, match="empty"):
        select(ball(200).take([]), around(5), 2)


@pytest.mark.parametrize("policy", ["auto", "directional"])
def test_images_too_large_for_the_rasteriser_are_rejected(policy):
    pool = around(3)
    huge = replace(pool, widths=np.array([64, 60_000, 64]))
    with pytest.raises(InputError, match=r"view_001: expected at most 32768 pixels"):
        select(ball(200), huge, 2, policy=policy)
