"""Degenerate pools."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.config.choices import POLICIES
from g2ard.errors import InputError
from g2ard.io import read_view_set, write_splats, write_views
from g2ard.scene.cameras import look_at
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from g2ard.stages.select import CoverageOptions, select
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball, views_at

OPTIONS = CoverageOptions(cells=500)
BALL = checkered_ball(800)


def balls(count: int) -> Splats:
    """Balls along x, 50 apart."""
    return join(
        [replace(BALL, means=BALL.means + np.float32([50 * i, 0, 0])) for i in range(count)]
    )


@pytest.mark.parametrize("policy", POLICIES)
def test_views_without_overlap_are_worth_the_same(policy: str) -> None:
    scene = balls(4)
    pool = views_at([look_at([50 * i, -4, 0], [50 * i, 0, 0]) for i in range(4)])
    chosen = select(scene, pool, 4, policy=policy, options=OPTIONS)
    assert sorted(chosen.order.tolist()) == [0, 1, 2, 3]
    np.testing.assert_allclose(chosen.gains, 0.25, atol=0.02)
    np.testing.assert_allclose(chosen.weights, 1, atol=0.02)
    assert len(select(scene, pool, "auto", policy=policy, options=OPTIONS).order) == 4
    assert chosen.curve[-1] == pytest.approx(1)


@pytest.mark.parametrize("policy", POLICIES)
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


def test_the_command_says_which_views_see_nothing(
    command_line: CommandLine, tmp_path: Path
) -> None:
    write_splats(tmp_path / "ball.ply", BALL)
    away = look_at([30.0, 0, 0], [60, 0, 0])
    ask = (
        "select",
        "ball.ply",
        "--views",
        "pool.json",
        "-k",
        5,
        "--split",
        "all",
        "-o",
        "out.json",
    )
    write_views(tmp_path / "pool.json", views_at([*around(4).viewmats, away]))
    out, told = succeeds(command_line, tmp_path, *ask, "--json", "-")
    said = json.loads(out)
    assert (
        len(said["views"])
        == len(said["curve"])
        == len(read_view_set(tmp_path / "out.json").cameras)
        == 4
    )
    assert len(said["refused"]) == 1
    assert "1 view not used" in told
    write_views(tmp_path / "pool.json", views_at([away]), overwrite=True)
    error = refused(command_line, tmp_path, *ask, "-w", "-q", status=1)
    assert "none of 1 view sees the scene" in error
