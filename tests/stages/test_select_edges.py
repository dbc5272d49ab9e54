"""Degenerate pools, through the function and through the command."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.config.choices import POLICIES
from g2ard.errors import InputError
from g2ard.io import read_view_set, write_splats, write_views
from g2ard.progress import plural
from g2ard.scene.cameras import look_at
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.select import CoverageOptions, select
from helpers.commands import CommandLine
from helpers.scenes import around, checkered_ball, views_at

OPTIONS = CoverageOptions(cells=500)
MEASURING = [p for p in POLICIES if p not in ("random", "uniform")]
BALL = checkered_ball(800)


def balls(count: int) -> Splats:
    """Balls along x, 50 apart."""
    return join([replace(BALL, means=BALL.means + np.float32([50 * i, 0, 0])) for i in range(count)])


@pytest.mark.parametrize("policy", MEASURING)
def test_views_without_overlap_are_worth_the_same(policy: str) -> None:
    scene = balls(4)
    pool = views_at([look_at([50 * i, -4, 0], [50 * i, 0, 0]) for i in range(4)])
    chosen = select(scene, pool, 4, policy=policy, options=OPTIONS)
    assert sorted(chosen.order.tolist()) == [0, 1, 2, 3]
    if policy != "pose-diverse":  # its gains are distances
        np.testing.assert_allclose(chosen.gains, 0.25, atol=0.02)
        np.testing.assert_allclose(chosen.weights, 1, atol=0.02)
        assert len(select(scene, pool, "auto", policy=policy, options=OPTIONS).order) == 4
    assert chosen.curve[-1] == pytest.approx(1)


@pytest.mark.parametrize("policy", MEASURING)
def test_duplicate_poses_are_chosen_last(policy: str) -> None:
    places = around(5).viewmats
    pool = views_at([places[i] for i in (0, 0, 0, 1, 1, 2, 3, 4, 4, 4)])
    first = {0: 0, 1: 0, 2: 0, 3: 1, 4: 1, 5: 2, 6: 3, 7: 4, 8: 4, 9: 4}
    chosen = select(BALL, pool, 10, policy=policy, options=OPTIONS)
    assert len({first[i] for i in chosen.order[:5].tolist()}) == 5
    assert sorted(chosen.order.tolist()) == list(range(10))
    assert np.isfinite(chosen.weights).all()
    assert chosen.weights.mean() == pytest.approx(1)
    again = select(BALL, pool, 10, policy=policy, options=OPTIONS)
    np.testing.assert_array_equal(chosen.order, again.order)


def test_only_duplicates() -> None:
    pool = views_at([around(3).viewmats[0]] * 6)
    for policy in POLICIES:
        chosen = select(BALL, pool, 3, policy=policy, options=OPTIONS)
        assert len(set(chosen.order.tolist())) == 3
        assert np.isfinite(chosen.gains).all()
        np.testing.assert_allclose(chosen.weights.sum(), 3)


def test_the_curve_is_where_k_can_be_read_off() -> None:
    whole = select(BALL, around(12), 12)
    few = select(BALL, around(12), 4)
    np.testing.assert_array_equal(few.curve, whole.curve)
    assert few.curve[3] == pytest.approx(1 - few.left_out)
    assert np.all(np.diff(few.curve) >= 0)


def test_invalid_poses_are_rejected() -> None:
    pool = around(3)
    for field, value, words in (
        ("viewmats", np.nan, "view 1 .*not finite"),
        ("Ks", np.inf, "view 1 .*not finite"),
        ("widths", 0, "view 1 .*empty image"),
        ("heights", 0, "view 1 .*empty image"),
    ):
        broken = getattr(pool, field).copy()
        broken[1] = value
        with pytest.raises(InputError, match=words):
            replace(pool, **{field: broken})
    with pytest.raises(InputError, match="no candidate"):
        select(BALL, pool.take([]), 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "ball.ply", BALL)
    return tmp_path


def ask(command_line: CommandLine, folder: Path, k: object, *more: object) -> tuple[int, str, str]:
    words = ["select", "ball.ply", "--views", "pool.json", "-o", "out.json", "--json", "-"]
    return command_line(*words, "-k", k, *more, cwd=folder)


def test_the_command_on_pools_of_all_shapes(command_line: CommandLine, folder: Path) -> None:
    away = look_at([30.0, 0, 0], [60, 0, 0])
    shapes = {
        "one": ([around(4).viewmats[0]], 1, 1, 0),
        "duplicates": ([around(4).viewmats[0]] * 5, 3, 3, 0),
        "all and more": (list(around(6).viewmats), 50, 6, 0),
        "some see nothing": ([*around(4).viewmats, away], 5, 4, 1),
    }
    for name, (poses, k, count, refused) in shapes.items():
        write_views(folder / "pool.json", views_at(poses), overwrite=True)
        status, out, error = ask(command_line, folder, k, "-w", "--split", "all")
        assert status == 0, (name, error)
        said = json.loads(out)
        assert len(said["views"]) == count == len(read_view_set(folder / "out.json").cameras)
        assert len(said["refused"]) == refused
        assert (f"{plural(refused, 'view')} not used" in error) == bool(refused)
        assert len(said["curve"]) == len(poses) - refused
    write_views(folder / "pool.json", views_at([away]), overwrite=True)
    status, _, error = ask(command_line, folder, 1, "-w", "--split", "all")
    assert status == 1
    assert "none of 1 view sees the scene" in error
