"""Pools of kind `auto`: poses within rooms, near views, and places from where an open scene looks sharp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from g2ard.io import read_splats
from g2ard.poses import plan_pool
from g2ard.poses.matter import Matter
from g2ard.poses.sight import Glance, Poses, Survey
from g2ard.poses.site import Site
from g2ard.poses.up import estimate_up
from g2ard.poses.within import plan_inside, plan_sharp
from g2ard.scene.cameras import Cameras
from g2ard.scene.reproducible import fibonacci
from g2ard.scene.splats import Splats
from helpers.realdata import real
from reference import poses as naive


def surveyed(splats: Splats) -> Survey:
    return Survey(splats, 1.0, Site.of(splats))


@pytest.fixture(scope="module")
def room() -> Splats:
    return naive.room()


@pytest.fixture(scope="module")
def open_scene() -> Splats:
    """A ground of radius 4 with three columns, under a sky of 400 layers, each half as wide."""
    k = np.arange(12_000)
    r, t = 4 * np.sqrt((k + 0.5) / len(k)), k * 2.399963
    ground = np.stack([r * np.cos(t), r * np.sin(t), np.zeros(len(k))], axis=1)
    flat = naive.discs(ground, np.tile([0.0, 0.0, 1.0], (len(k), 1)), 0.06, seed=1)
    columns = [
        naive.box((x, y, 0), (x + 0.5, y + 0.5, 2), 0.06) for x, y in ((-2, 1), (2, 1), (0, -2))
    ]
    up = fibonacci(400, low=0.0)
    return naive.joined(flat, *columns, naive.discs(6 * up, up, 2.0))


def test_a_room_is_seen_from_within(room) -> None:
    survey = surveyed(room)
    site, inside = survey.site, survey.inside
    assert inside.share > 0.05
    clearance = site.grid.distance(inside.places)
    assert (clearance > 2 * site.grid.cell).all()
    assert (np.diff(clearance) <= 0).all()
    poses = plan_inside(survey, 48)
    assert len(poses) == 48
    eyes = site.origin + site.size * (poses.eyes @ site.axes)
    assert ((eyes > 0.05) & (eyes < np.array([6, 4, 2.7]) - 0.05)).all()
    assert not np.any([((eyes > t[0]) & (eyes < t[1])).all(axis=1) for t in naive.TABLES])
    assert (np.abs(poses.gazes[:, 2]) < np.sin(0.31)).all()
    assert np.linalg.norm(poses.gazes.mean(axis=0)[:2]) < 0.3  # all around


@pytest.mark.parametrize("make", [naive.statue, naive.town])
def test_no_pose_stands_inside_objects_or_houses(make) -> None:
    survey = surveyed(make())
    assert survey.inside.share < 0.005
    assert not len(plan_inside(survey, 0))


def test_a_closed_shell_is_seen_from_outside_as_well() -> None:
    points = fibonacci(20_000)
    shell = naive.discs(points, points, 0.02)
    eyes = np.linalg.norm(plan_pool(shell, 32).cameras.positions, axis=1)
    assert 8 <= (eyes > 1.2).sum() <= 24


def test_an_open_scene_is_seen_from_below_its_sky(open_scene) -> None:
    pool = plan_pool(open_scene, 48)
    assert pool.up[2] > 0.99
    assert np.linalg.norm(pool.cameras.positions, axis=1).max() < 6
    assert (pool.cameras.positions[:, 2] > 0).all()
    assert "blurred" in pool.why


def test_sharp_poses_are_full_fine_and_free(open_scene) -> None:
    survey = surveyed(open_scene)
    site, glance, poses = survey.site, survey.glance, plan_sharp(survey, 12)
    assert 6 <= len(poses) <= 12
    assert (site.grid.distance(poses.eyes) > 3 * site.grid.cell).all()
    covered, fine, _ = glance.of(survey.cameras(poses))
    assert (covered > 0.5).all()
    assert (fine > 0.1).all()
    assert (fine <= covered + 1e-9).all()
    sky = Poses(np.tile([0.0, 0.0, 0.2], (4, 1)), np.tile([0.0, 0.0, 1.0], (4, 1)))
    assert (glance.of(survey.cameras(sky))[1] < 0.1).all()


@pytest.mark.parametrize("layers", [400, 1500])
def test_a_scene_behind_its_sky_is_not_orbited(open_scene, layers) -> None:
    up = fibonacci(layers, low=0.0)
    pool = plan_pool(naive.joined(open_scene, naive.discs(6.2 * up, up, 2.0)), 24)
    assert "orbit" not in pool.kind


def test_a_backdrop_does_not_count() -> None:
    outward = fibonacci(600)
    splats = naive.joined(naive.statue(), naive.discs(60 * outward, outward, 4.0))
    glance = Glance(splats)
    cameras = plan_pool(splats, 8, kind="orbit").cameras
    whole, near = glance.of(cameras), glance.of(cameras, np.full(8, 30.0))
    np.testing.assert_array_equal(near[0], whole[0])
    assert (whole[2] > 0.05).all()
    assert (near[2] < 0.03).all()


def test_a_coarse_object_is_still_seen_from_around() -> None:
    pool = plan_pool(naive.sphere((0, 0, 0), 1.0, 0.16), 16)
    assert pool.kind == "orbit"


def test_a_thinned_object_is_still_seen_from_around() -> None:
    scene = read_splats(real("playbot/0_0"))
    thin = scene.take(np.arange(0, len(scene), 160))
    # each is larger in its stead
    thin = replace(thin, scales=thin.scales * np.float32(np.sqrt(160)))
    pool = plan_pool(thin, 24)
    assert len(pool.cameras) == 24
    assert pool.kind.startswith("orbit")


@pytest.mark.parametrize("make", [naive.statue, naive.room])
def test_near_views_are_nearer_and_free(make) -> None:
    splats = make()
    pool = plan_pool(splats, 32)
    near = Cameras.of(pool.more("near", 12))
    assert 6 <= len(near) <= 12
    assert near.names[0] == "near_0000"
    assert not set(near.names) & set(pool.cameras.names)
    eyes = near.positions
    gaps = [np.linalg.norm(splats.means - eye, axis=1).min() for eye in eyes]
    far = [np.linalg.norm(splats.means - eye, axis=1).min() for eye in pool.cameras.positions]
    assert min(gaps) > 0.05
    assert np.median(gaps) < np.median(far)
    if make is naive.statue:
        assert (np.linalg.norm(eyes - (0, 0, 1.3), axis=1) > 1.05).all()
        assert (eyes[:, 2] > 0).all()
    else:
        assert ((eyes > 0.05) & (eyes < np.array([6, 4, 2.7]) - 0.05)).all()
    again = Cameras.of(plan_pool(splats, 32).more("near", 12))
    np.testing.assert_array_equal(again.viewmats, near.viewmats)


@pytest.mark.parametrize("make", [naive.statue, naive.room])
def test_views_from_anywhere_are_free_and_see_their_aim(make) -> None:
    splats = make()
    pool = plan_pool(splats, 16)
    views = Cameras.of(pool.more("anywhere", 12))
    assert views.names == tuple(f"anywhere_{i:04d}" for i in range(12))
    assert (views.widths == 800).all()
    gaps = [np.linalg.norm(splats.means - eye, axis=1) for eye in views.positions]
    assert min(gap.min() for gap in gaps) > 0.05
    site = Site.of(splats)
    eyes = (views.positions - site.origin) @ site.axes.T / site.size
    aims = site.grid.cast(eyes, views.forwards @ site.axes.T)
    diagonal = np.linalg.norm(site.box[1] - site.box[0])
    assert (aims > 0.03 * diagonal).all()
    assert (aims < 0.45 * diagonal).all()
    np.testing.assert_array_equal(Cameras.of(pool.more("anywhere", 12)).viewmats, views.viewmats)
    np.testing.assert_array_equal(Cameras.of(pool.more("anywhere", 6)).viewmats, views.viewmats[:6])


@pytest.mark.parametrize(("make", "grown"), [(naive.statue, False), (naive.room, True)])
def test_a_pool_grows_where_a_view_holds_little_of_the_scene(make, grown) -> None:
    splats = make()
    plain, more = plan_pool(splats, 32), plan_pool(splats, 32, grow=2)
    if not grown:
        np.testing.assert_array_equal(more.cameras.viewmats, plain.cameras.viewmats)
    else:
        assert 40 <= len(more.cameras) <= 64
        assert more.unseen < plain.unseen + 0.02


def test_poses_step_nearer_to_matter_under_a_pixel() -> None:
    statue = naive.statue()
    fine = replace(statue, scales=statue.scales * np.float32(0.1))
    coarse, fair = plan_pool(fine, 32, near=0.25), plan_pool(statue, 32, near=0.25)
    assert fair.coarse < 0.2
    assert "near" not in fair.kind
    assert "near" in coarse.kind
    assert len(coarse.cameras) == 32
    assert coarse.coarse < plan_pool(fine, 32).coarse


def test_poses_step_nearer_where_a_view_holds_little(room) -> None:
    assert "near" in plan_pool(room, 32, near=0.25).kind
    assert "near" not in plan_pool(room, 32).kind


def test_a_pool_reports_its_unseen_share(room) -> None:
    all_around, few = plan_pool(room, 64), plan_pool(room, 1)
    assert all_around.unseen < 0.3
    assert few.unseen > 0.6
    assert 0 <= all_around.coarse < 0.2


def test_up_is_found_by_layers_when_noise_lies_behind_floor_and_ceiling() -> None:
    rng, count = np.random.default_rng(0), 20_000
    points = rng.uniform((0, 0, 0.1), (9, 7, 2.5), (count, 3))
    points[:, 2] = np.where(np.arange(count) % 2 == 0, -points[:, 2], 2.5 + points[:, 2])
    noise = Splats.create(
        points,
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.06, 0.12, (count, 3)) * (1, 1, 0.2),
        logit_opacities=rng.uniform(-1, 3, count),
        sh0=rng.normal(size=(count, 1, 3)),
    )
    table = naive.box((3, 2, 0), (5, 4, 0.7), 0.1, floor=False)
    scene = naive.joined(naive.box((0, 0, 0), (9, 7, 2.5), 0.1), table, noise)
    found = estimate_up(Matter.of(scene).first())
    assert "layers" in found.why
    assert found.grounded
    assert abs(found.axis[2]) > np.cos(np.radians(5))
