"""Representative views of twelve scenes: whole and sharp, from around or from within, and far apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.io import read_cloud, read_splats
from g2ard.poses import best_views, plan_pool, turntable
from g2ard.rendering.renderer import arrays_of, settings_for, view_of
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.lift import lift
from helpers.halls import SIZE, hall, open_hall
from helpers.realdata import real
from reference import poses as naive

_DRAWN = 120_000


def chunks(name: str) -> Splats:
    folder = real(name)
    parts = [read_splats(part).narrowed() for part in sorted(folder.glob("0_*"))]
    return naive.joined(*(part.recentred(parts[0].offset) for part in parts))


def autzen() -> Splats:
    points = read_cloud(real("autzen_lidar/autzen_stadium.laz")).points
    assert points.colors is not None
    return lift(points.positions[::20], points.colors[::20])


SCENES: dict[str, tuple[Callable[[], Splats], str]] = {
    "statue": (naive.statue, "around"),
    "town": (naive.town, "around"),
    "ball": (lambda: naive.sphere((0, 0, 0), 1.0, 0.03), "around"),
    "coarse": (lambda: naive.sphere((0, 0, 0), 1.0, 0.16), "around"),
    "room": (naive.room, "within"),
    "hall": (hall, "within"),
    "hall under plates": (lambda: hall(plate=0.2), "within"),
    "playbot": (lambda: read_splats(real("playbot/0_0")), "around"),
    "biker": (lambda: read_splats(real("format_samples/biker.compressed.ply")), "around"),
    "guitar": (lambda: read_splats(real("format_samples/guitar.compressed.ply")), "around"),
    "autzen": (autzen, "around"),
    "taebak_park": (lambda: chunks("taebak_park"), "around"),
    "showroom": (lambda: chunks("showroom"), "within"),
    "paljassaare": (lambda: read_splats(real("paljassaare/0_0")), "within"),
}


def seen(splats: Splats, cameras: Cameras) -> np.ndarray:
    """Return per view the share of the image that is not empty, and the share that is resolved."""
    some = splats.take(slice(None, None, -(-len(splats) // _DRAWN))).narrowed()
    grown = some.scales * np.float32(np.sqrt(len(splats) / len(some)))  # to cover for the others
    settings = settings_for(some.means, antialiased=some.antialiased)
    small = cameras.resized(120).recentred(some.offset)
    views = [view_of(small, i, settings) for i in range(len(small))]
    sigma = np.sort(some.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1) ** 0.5
    found = []
    for view, sums in enumerate(
        _core.accumulate_each(arrays_of(replace(some, scales=grown)), views, settings)
    ):
        weight = sums["weight"] / (small.widths[view] * small.heights[view])
        away = np.linalg.norm(some.means - small.positions[view], axis=1)
        found.append((weight.sum(), weight[sigma < 0.03 * away].sum()))
    return np.array(found)


def subject(splats: Splats) -> np.ndarray:
    """Return the means that are opaque, without the outermost hundredth along each axis."""
    means = splats.means[splats.opacities > 0.3].astype(np.float64) + splats.offset
    low, high = np.quantile(means, [0.01, 0.99], axis=0)
    return means[((means >= low) & (means <= high)).all(axis=1)]


def least_angle(cameras: Cameras) -> float:
    cosines = cameras.forwards @ cameras.forwards.T
    return float(
        np.degrees(np.arccos(np.clip(cosines[~np.eye(len(cameras), dtype=bool)].max(), -1, 1)))
    )


@pytest.mark.parametrize("name", SCENES)
def test_the_best_views_are_whole_or_within_sharp_and_apart(name: str) -> None:
    make, where = SCENES[name]
    splats = make()
    views = best_views(splats, 4)
    assert views.names == ("view_0000", "view_0001", "view_0002", "view_0003")
    matter, (covered, resolved) = subject(splats), seen(splats, views).T
    frames = np.array([view.holds(matter).mean() for view in views])
    low, high = matter.min(axis=0), matter.max(axis=0)
    outside = ((views.positions < low) | (views.positions > high)).any(axis=1)
    print(name, frames.round(3), covered.round(2), resolved.round(2), least_angle(views), outside)
    if where == "around":
        assert outside.all()
        assert frames[0] >= 0.995
        assert (frames >= 0.98).all()
        if name != "coarse":
            assert (resolved >= 0.9 * covered).all()
        assert least_angle(views) >= 35
    else:
        assert not outside.any()
        assert (covered > 0.8).all()
        assert (resolved > 0.4).all()
        assert frames[0] > 0.15
        assert least_angle(views) >= 20


def test_a_hall_without_a_roof_is_shown_and_seen_from_within() -> None:
    scene = open_hall()
    views, pool = best_views(scene, 4), plan_pool(scene, 16, rows=100_000).cameras
    for cameras in (views, pool):
        assert ((cameras.positions > 0) & (cameras.positions < (60, 40, 5))).all()
    coarse = open_hall(0.25)  # resolved from around
    assert (best_views(coarse, 2).positions[:, 2] > 5).all()


def test_a_hall_that_is_no_room_still_trains_from_within(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("g2ard.poses.site._ENCLOSED", 1.1)  # more than all directions
    pool = plan_pool(hall(plate=0.2), 16, rows=60_000)  # a ceiling that looks sharp from above
    standing = Cameras.of(pool.more("standing", 8))
    assert len(standing) >= 4
    for cameras in (pool.cameras, standing):
        assert ((cameras.positions > 0) & (cameras.positions < SIZE)).all()
    assert "ceiling" in pool.why


def test_photos_are_chosen_by_what_they_see() -> None:
    statue = naive.statue()
    views = Cameras.of(
        Camera.facing(eye, target, fov=60, name=name)
        for name, eye, target in (
            ("away", (5, 0, 3), (9, 0, 3)),
            ("close", (0, -1.6, 1.3), (0, 0, 1.3)),
            ("front", (0, -6, 3), (0, 0, 0.8)),
            ("back", (0, 6, 3), (0, 0, 0.8)),
            ("beside", (0.4, -6, 3), (0, 0, 0.8)),
        )
    )
    chosen = best_views(statue, 3, views).names
    assert set(chosen[:2]) in ({"front", "back"}, {"beside", "back"})
    assert "away" not in chosen


def test_the_colourful_side_comes_first() -> None:
    ball = naive.sphere((0, 0, 0), 1.0, 0.03)
    front = np.array([0.6, -0.8, 0.0])
    faint = np.where((ball.means @ front > 0.5)[:, None, None], 1.0, 0.3).astype(np.float32)
    view = best_views(replace(ball, sh0=ball.sh0 * faint), axis=(0, 0, 1))[0]
    assert view.position @ front > 0.7 * np.linalg.norm(view.position)


def test_a_biker_opens_with_the_face() -> None:
    biker = SCENES["biker"][0]()
    assert best_views(biker).forwards[0] @ (1, 0, 0) > 0.7  # the biker faces −x


def test_photos_that_cut_their_subject_come_last() -> None:
    statue = naive.statue()
    views = [
        Camera.facing((5 * np.cos(a), 5 * np.sin(a), 2), (0, 0, 1.2), fov=45, name=f"whole {i}")
        for i, a in enumerate(np.linspace(0, 5, 6))
    ]
    cut = [
        replace(
            view, viewmat=Camera.facing(0.6 * view.position, (0, 0, 0.3)).viewmat, name=f"cut {i}"
        )
        for i, view in enumerate(views[:2])
    ]
    assert all("whole" in name for name in best_views(statue, 4, Cameras.of([*cut, *views])).names)


def test_a_turntable_keeps_all_of_an_object_in_frame() -> None:
    statue = naive.statue()
    first = best_views(statue, size=(320, 180))[0]
    views, up = turntable(statue, 7, size=(320, 180))
    seen = np.stack([view.outward(subject(statue)) for view in views])
    assert seen.max() < 0.97
    assert seen.max() > 0.75  # it fills the frame
    np.testing.assert_allclose(views.forwards[0], first.viewmat[2, :3], atol=1e-6)
    np.testing.assert_allclose(views.forwards @ up, views.forwards[0] @ up, atol=1e-6)
    steps = np.diff(np.unwrap(np.arctan2(views.forwards[:, 1], views.forwards[:, 0])))
    np.testing.assert_allclose(np.abs(steps), 2 * np.pi / 7, atol=1e-3)


def test_in_a_room_the_camera_turns_in_place() -> None:
    views, _ = turntable(naive.room(), 4, size=(320, 180))
    np.testing.assert_allclose(views.positions, np.tile(views.positions[0], (4, 1)), atol=1e-6)
    assert least_angle(views) > 60


def test_a_turn_keeps_to_the_side_that_photos_show() -> None:
    statue = naive.statue()
    photos = Cameras.of(
        Camera.facing((5 * np.cos(a), 5 * np.sin(a), 2), (0, 0, 1.2), fov=45, name=f"{i}")
        for i, a in enumerate(np.radians([-40, -15, 10, 35]))
    )
    views, _ = turntable(statue, 12, photos, size=(320, 180), axis=(0, 0, 1))
    angles = np.degrees(np.arctan2(views.positions[:, 1], views.positions[:, 0]))
    assert angles.min() == pytest.approx(-40, abs=3)
    assert angles.max() == pytest.approx(35, abs=3)
    np.testing.assert_allclose(np.linalg.norm(views.positions[:, :2], axis=1), 5, rtol=0.1)


def test_the_best_views_do_not_depend_on_the_order_of_rows() -> None:
    statue = naive.statue()
    order = np.random.default_rng(0).permutation(len(statue))
    first, second = best_views(statue, 3), best_views(statue.take(order), 3)
    np.testing.assert_allclose(first.viewmats, second.viewmats, atol=1e-6)
