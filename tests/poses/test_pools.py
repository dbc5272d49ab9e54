"""Pools of poses: upright, in free space, seeing the scene, and the same whatever the file looks like."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import read_splats, read_views, write_splats
from g2ard.poses import make_pool, plan_pool
from g2ard.poses import pool as pool_module
from g2ard.poses.sight import Poses, Survey
from g2ard.poses.site import Site
from g2ard.scene.reproducible import fibonacci
from g2ard.scene.splats import Splats
from helpers.commands import CommandLine
from helpers.realdata import real
from reference import poses as naive

SCENES = {"statue": naive.statue, "room": naive.room, "town": naive.town}
KINDS = {"statue": {"orbit"}, "room": {"inside"}, "town": {"walk", "aerial"}}


@pytest.fixture(autouse=True)
def coarse_grids(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Take coarser occupancy grids than in real scenes: of small ones they are most of the time."""
    if request.function is not test_real_scenes:
        monkeypatch.setattr("g2ard.poses.matter._CELLS", (200_000, 6_000_000))


@pytest.fixture(scope="module")
def scenes() -> dict[str, Splats]:
    return {name: make() for name, make in SCENES.items()}


def inside_matter(name: str, eyes: np.ndarray) -> np.ndarray:
    """Return whether a position is in a solid or hollow body, under the ground, or outside the room."""

    def within(low, high, margin=0.0):
        return ((eyes > np.array(low) - margin) & (eyes < np.array(high) + margin)).all(axis=1)

    if name == "statue":
        return (np.linalg.norm(eyes - (0, 0, 1.3), axis=1) < 1.05) | (eyes[:, 2] < 0)
    if name == "room":
        bad = ~within((0, 0, 0), (6, 4, 2.7), -0.05)
        return bad | np.any([within(*t, 0.05) for t in naive.TABLES], axis=0)
    return (eyes[:, 2] < 0.1) | np.any([within(*h, 0.1) for h in naive.HOUSES], axis=0)


def share_in_frame(splats: Splats, cameras, every: int = 5) -> np.ndarray:
    """Per view, the share of 12×9 blocks of the frame that the means, or some of them, fall into."""
    shares = []
    for view, K in zip(cameras.viewmats, cameras.Ks, strict=True):
        p = (splats.means[::every] + splats.offset) @ view[:3, :3].T + view[:3, 3]
        p = p[p[:, 2] > 0]
        uv = (p @ K.T)[:, :2] / p[:, 2:] / (800 / 12, 600 / 9)
        uv = uv[(uv >= 0).all(1) & (uv < (12, 9)).all(1)].astype(int)
        shares.append(len(np.unique(uv, axis=0)) / 108)
    return np.array(shares)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("turned", [False, True])
def test_auto_pools_are_whole_upright_free_and_see_the_scene(name, turned, scenes) -> None:
    turn = naive.rotation(3) if turned else np.eye(3)
    shift = np.array([5.0, -3.0, 2.0])
    pool = plan_pool(naive.moved(scenes[name], turn, 1.0, shift), 64)
    assert set(pool.kind.split(" + ")) == KINDS[name]
    assert len(pool.cameras) == 64
    assert pool.up @ turn[:, 2] > np.cos(np.radians(5))
    eyes = (pool.cameras.positions - shift) @ turn
    assert not inside_matter(name, eyes).any()
    tops = -pool.cameras.viewmats[:, 1, :3] @ turn[:, 2]
    assert (tops > -1e-6).all()
    assert (tops > 0.3).mean() > 0.5
    within = pool.kind == "inside"  # a wall at arm's length shows few means, but fills the frame
    seen = share_in_frame(
        naive.moved(scenes[name], turn, 1.0, shift), pool.cameras, 1 if within else 5
    )
    assert seen.min() > (0.5 if within else 0.25)
    assert np.median(seen) > (0.9 if within else 0.4)


@pytest.mark.parametrize(
    ("name", "kind"), [("statue", "orbit"), ("town", "aerial"), ("town", "walk")]
)
def test_a_stated_kind_is_kept(name, kind, scenes) -> None:
    pool = plan_pool(scenes[name], 24, kind=kind)
    eyes, ahead = pool.cameras.positions, pool.cameras.forwards[:, 2]
    assert pool.kind == kind
    assert not inside_matter(name, eyes).any()
    if kind == "aerial":
        assert eyes[:, 2].min() > 9
        assert 4 <= (ahead < -0.999).sum() <= 16  # straight down
        assert (ahead < -0.45).all()
    if kind == "walk":
        assert eyes[:, 2].max() < 9
    if kind == "orbit":
        rise = np.degrees(np.arcsin(-ahead))
        assert (rise > -5.1).all()
        assert (rise < 50.1).all()


def test_orbit_fills_the_frame(scenes) -> None:
    ball = naive.sphere((4, 5, 6), 2.0, 0.1)
    cameras = make_pool(ball, 32, kind="orbit", up=(0, 0, 1))
    distances = np.linalg.norm(cameras.positions - (4, 5, 6), axis=1)
    fits = 2.0 / np.sin(np.arctan(0.75 * np.tan(np.radians(25))))
    assert (distances > 0.8 * fits).all()
    assert (distances < 1.3 * fits).all()


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", [1, 5])
def test_up_is_found_in_any_orientation(name, seed, scenes) -> None:
    turn = naive.rotation(seed)
    up = plan_pool(naive.moved(scenes[name], turn), 1, kind="orbit").up
    assert up @ turn[:, 2] > np.cos(np.radians(5))


def test_planning_reports_its_progress_and_does_not_depend_on_it(scenes, monkeypatch) -> None:
    told: list[tuple] = []
    scene = next(iter(scenes.values()))
    whole = plan_pool(scene, 600, progress=lambda *report: told.append(report[:2])).cameras
    assert len({done for stage, done in told if stage == "poses"}) > 2
    monkeypatch.setattr("g2ard.poses.sight._BLOCK", 10**9)
    np.testing.assert_array_equal(plan_pool(scene, 600).cameras.viewmats, whole.viewmats)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_few_poses(count, scenes) -> None:
    assert len(make_pool(scenes["town"], count)) == count


def test_more_poses_than_places_look_elsewhere_from_the_same(scenes, monkeypatch) -> None:
    monkeypatch.setattr("g2ard.poses.within._TRIES", (64, 64))
    cameras = make_pool(scenes["room"], 200, kind="walk")
    assert len(np.unique(cameras.positions.round(6), axis=0)) < 64
    assert len(np.unique(cameras.viewmats.reshape(200, -1), axis=0)) == 200


def test_up_can_be_given(scenes) -> None:
    pool = plan_pool(scenes["statue"], 8, up=(0, 0, 5.0))
    np.testing.assert_array_equal(pool.up, [0, 0, 1])
    assert "as given" in pool.why


@pytest.mark.parametrize("name", SCENES)
def test_row_order_does_not_show(name, scenes) -> None:
    splats = scenes[name]
    mixed = splats.take(np.random.default_rng(0).permutation(len(splats)))
    here, there = make_pool(splats, 24), make_pool(mixed, 24)
    np.testing.assert_array_equal(here.viewmats, there.viewmats)


def test_the_order_of_equal_rows_does_not_matter() -> None:
    points = np.random.default_rng(0).normal(size=(3000, 3))
    splats = Splats.create(points, scales=np.full((3000, 3), 0.05))
    mixed = splats.take(np.random.default_rng(1).permutation(3000))
    np.testing.assert_array_equal(make_pool(splats, 8).viewmats, make_pool(mixed, 8).viewmats)


@pytest.mark.parametrize("name", SCENES)
def test_moving_and_scaling_the_scene_moves_and_scales_the_poses(name, scenes) -> None:
    here = make_pool(scenes[name], 24)
    for scale, shift, close in ((4.0, 0.0, 1e-12), (1000.0, 7e4, 1e-6)):
        there = make_pool(naive.moved(scenes[name], None, scale, (shift, 0, -shift)), 24)
        expected = here.positions * scale + (shift, 0, -shift)
        np.testing.assert_allclose(there.positions, expected, rtol=0, atol=close * scale * 60)
        np.testing.assert_allclose(there.viewmats[:, :3, :3], here.viewmats[:, :3, :3], atol=1e-6)


def test_offset_is_added(scenes) -> None:
    offset = np.array([637_000.0, 5_400_000.0, 120.0])
    here = make_pool(scenes["statue"], 16)
    there = make_pool(replace(scenes["statue"], offset=offset), 16)
    np.testing.assert_allclose(there.positions, here.positions + offset, rtol=0, atol=1e-8)


def test_seeds_and_repetition(scenes) -> None:
    pools = [make_pool(scenes["statue"], 16, seed=s).viewmats for s in (0, 0, 1)]
    np.testing.assert_array_equal(pools[0], pools[1])
    assert np.abs(pools[0] - pools[2]).max() > 0.1


def test_floaters_and_sky_do_not_move_the_cameras(scenes) -> None:
    clean = scenes["statue"]
    rng = np.random.default_rng(0)
    far = Splats.create(
        rng.normal(size=(60, 3)) * 6e4,
        scales=rng.uniform(10, 500, (60, 3)),
        sh0=rng.normal(size=(60, 1, 3)),
    )
    dome = naive.discs(60 * fibonacci(600), fibonacci(600), 4.0)
    odd = plan_pool(naive.joined(clean, far, dome), 32)
    pool = plan_pool(clean, 32)
    assert odd.kind == pool.kind
    assert odd.up @ pool.up > np.cos(np.radians(1))
    reach = [np.linalg.norm(p.cameras.positions, axis=1).mean() for p in (odd, pool)]
    assert reach[0] == pytest.approx(reach[1], rel=0.05)


def test_every_eighth_is_a_fair_sample(scenes) -> None:
    cameras = make_pool(scenes["town"], 128)
    assert list(cameras.names) == sorted(cameras.names)
    walks = cameras.positions[:, 2] < 9
    assert 16 <= walks.sum() <= 48
    assert abs(walks[::8].sum() - walks.sum() / 8) <= 2
    spread = cameras.positions.std(axis=0)
    drift = np.abs(cameras.positions[::8].mean(axis=0) - cameras.positions.mean(axis=0))
    assert (drift < 0.35 * spread).all()


def test_names_sort_in_pool_order_when_there_are_many(scenes) -> None:
    poses = Poses(np.zeros((10_001, 3)), np.tile([1.0, 0, 0], (10_001, 1)))
    names = Survey(scenes["statue"], 1.0, Site.of(scenes["statue"])).cameras(poses).names
    assert list(names) == sorted(set(names))


def one(**kwargs):
    return Splats.create([[3.0, 4.0, 5.0]], scales=[[1.0, 1.0, 1.0]], **kwargs)


@pytest.mark.parametrize(
    "splats",
    [
        one(),
        Splats.create(np.full((500, 3), 7.0), scales=np.full((500, 3), 0.1)),
        Splats.create(np.outer(np.arange(300.0), [1, 2, 3]), scales=np.full((300, 3), 0.5)),
        Splats.create([[0.0, 0, 0], [9, 0, 0]], scales=[[1e-20] * 3, [1e-20] * 3]),
    ],
    ids=["one", "one point", "a line", "two specks"],
)
def test_tiny_scenes_are_looked_at_from_outside(splats) -> None:
    cameras = make_pool(splats, 16, kind="orbit")
    assert len(cameras) == 16
    middle = splats.means.mean(axis=0)
    assert (np.einsum("ci,ci->c", cameras.forwards, middle - cameras.positions) > 0).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"count": 0}, "count"),
        ({"kind": "spiral"}, "spiral"),
        ({"size": (0, 600)}, "size"),
        ({"fov": 180.0}, "fov"),
        ({"fov": float("nan")}, "fov"),
        ({"up": (0, 0, 0)}, "up"),
        ({"up": (0, np.nan, 0)}, "up"),
        ({"kind": "walk"}, "free place .*`g2ard poses --kind`.*give views"),
    ],
)
def test_invalid_requests_are_one_clear_error(change, words) -> None:
    with pytest.raises(InputError, match=words):
        make_pool(one(), **{"count": 4, **change})


@pytest.mark.parametrize(
    "splats", [one(logit_opacities=[-np.inf]), Splats.create([[np.nan, 0, 0]], scales=[[1, 1, 1]])]
)
def test_invisible_scenes_are_refused(splats) -> None:
    with pytest.raises(InputError, match="visible"):
        make_pool(splats)


@pytest.mark.parametrize(
    "wrong",
    [("-k", "0"), ("--kind", "spiral"), ("--size", "800x"), ("--up", "0,0"), ("--up", "0,0,0")],
)
def test_command_usage(wrong, command_line: CommandLine, tmp_path: Path) -> None:
    status, _, error = command_line("poses", "scene.ply", "-o", "p.json", *wrong, cwd=tmp_path)
    assert status == 2
    assert len(error.strip().splitlines()) == 1
    assert wrong[0] in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("size", "pixels"), [(None, (800, 600)), ("64", (64, 48)), ("48x64", (48, 64))]
)
def test_size_is_a_longer_side_or_both(
    size: str | None, pixels: tuple[int, int], command_line: CommandLine, tmp_path: Path
) -> None:
    write_splats(tmp_path / "scene.ply", one())
    given = () if size is None else ("--size", size)
    assert (
        command_line("poses", "scene.ply", "-k", "2", *given, "-o", "p.json", cwd=tmp_path)[0] == 0
    )
    views = read_views(tmp_path / "p.json")
    assert {*zip(views.widths.tolist(), views.heights.tolist(), strict=True)} == {pixels}


def test_threads_do_not_matter(scenes, tmp_path: Path) -> None:
    write_splats(tmp_path / "scene.ply", scenes["town"])
    code = (
        "import hashlib, sys; from g2ard.io import read_splats; from g2ard.poses import make_pool\n"
        "print(hashlib.sha256(make_pool(read_splats(sys.argv[1]), 16).viewmats.tobytes()).hexdigest())"
    )
    program = [sys.executable, "-c", code, str(tmp_path / "scene.ply")]
    found = set()
    for threads in ("1", "8"):
        env = {**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        done = subprocess.run(program, env=env, capture_output=True, text=True, check=True)
        found.add(done.stdout)
    assert len(found) == 1


@pytest.mark.parametrize(
    ("name", "asked", "kind", "up"),
    [
        ("taebak_park/0_4", "auto", "walk + aerial", (0, -1, 0)),
        ("format_samples/guitar.compressed.ply", "auto", "orbit", (0, -1, 0)),
        ("showroom/0_6", "walk", "walk", (0, 0, 1)),
    ],
)
def test_real_scenes(name, asked, kind, up) -> None:
    pool = plan_pool(read_splats(real(name)), 64, kind=asked)
    assert pool.kind == kind
    assert pool.up @ up > np.cos(np.radians(5))
    assert len(pool.cameras) == 64


def test_a_pool_planned_on_a_sample_looks_at_the_same_thing(scenes: dict[str, Splats]) -> None:
    splats = scenes["statue"]
    whole, part = (plan_pool(splats, 16, rows=rows) for rows in (None, len(splats) // 2))
    assert part.kind == whole.kind
    assert part.up @ whole.up > 0.99
    mixed = splats.take(np.random.default_rng(1).permutation(len(splats)))
    again = make_pool(mixed, 16, rows=len(splats) // 2)
    np.testing.assert_array_equal(again.viewmats, part.cameras.viewmats)
    with pytest.raises(InputError, match="rows: expected at least 1"):
        make_pool(splats, 4, rows=0)


def test_a_grown_pool_keeps_the_kinds_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """More poses from above are lower, and may all look blurred where fewer do not."""
    plan, asked = pool_module._plan, []

    def flipping(survey: Survey, kind: str, count: int) -> tuple[Poses, list[str], str]:
        asked.append(count)
        return plan(survey, "orbit" if len(asked) == 1 else "sharp", count)

    monkeypatch.setattr(pool_module, "_plan", flipping)
    monkeypatch.setattr(pool_module, "_measure_share_held", lambda survey, poses: 0.25)
    found = plan_pool(naive.statue(), 16, grow=2.0)
    assert asked == [16, 32]
    assert len(found.cameras) == 32
    assert found.kind == "orbit + sharp"


def test_a_larger_pool_keeps_poses_of_kinds_that_it_would_not_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Poses that the larger number judges otherwise stay; the rest is evenly spread over the new ones."""
    planned = pool_module._plan

    def changing(survey: Survey, kind: str, count: int) -> tuple[Poses, list[str], str]:
        poses, _, why = planned(survey, "orbit", count)
        return poses, ["orbit"] if count == 12 else ["sharp"], why

    scene = SCENES["statue"]()
    alone = plan_pool(scene, 12)
    monkeypatch.setattr(pool_module, "_plan", changing)
    monkeypatch.setattr(pool_module, "_measure_share_held", lambda *_: 0.25)
    grown = plan_pool(scene, 12, grow=2)
    assert len(grown.cameras) == 24
    assert grown.kind == "orbit + sharp"
    eyes = {tuple(eye) for eye in grown.cameras.positions.round(9).tolist()}
    assert {tuple(eye) for eye in alone.cameras.positions.round(9).tolist()} <= eyes
