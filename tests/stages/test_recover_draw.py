"""Recovery that draws views by weight: as often as they say, the same for a seed, exact across a resume."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats, write_views
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.loop import check_weights, draw_views
from g2ard.stages.recover.optimize import recover
from g2ard.stages.simplify import simplify
from helpers.commands import succeeds
from helpers.scenes import around, checkered_ball

VIEWS = around()
TEACHER = checkered_ball(1500)
WEIGHTS = np.linspace(0, 3, len(VIEWS)) ** 2


@pytest.fixture(scope="module")
def targets() -> TeacherRenders:
    return TeacherRenders(TEACHER, VIEWS)


@pytest.fixture(scope="module")
def student() -> Splats:
    return simplify(TEACHER, 300, method="paper").splats


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0, 1e300), min_size=1, max_size=40).filter(any), st.integers(0, 5))
def test_every_epoch_draws_within_one_of_the_weights(raw: list[float], epoch: int) -> None:
    weights = check_weights(raw, len(raw))
    counts = np.bincount(draw_views(3, epoch, len(raw), weights), minlength=len(raw))
    assert counts.sum() == len(raw)
    assert np.all(np.abs(counts - weights) < 1 + 1e-9)
    assert not counts[weights == 0].any()


def test_many_epochs_draw_views_by_weight() -> None:
    weights = check_weights(np.random.default_rng(0).random(20) ** 3, 20)
    counts = sum(
        np.bincount(draw_views(1, epoch, 20, weights), minlength=20) for epoch in range(400)
    )
    np.testing.assert_allclose(counts / 400, weights, atol=0.08)


@pytest.mark.parametrize("value", [1.0, 0.3, 7e-200])
def test_equal_weights_draw_like_no_weights(value: float) -> None:
    weights = check_weights(np.full(23, value), 23)
    for epoch in range(3):
        np.testing.assert_array_equal(draw_views(5, epoch, 23, weights), draw_views(5, epoch, 23))


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ([1.0] * 3, "expected 16"),
        ([-1.0] * 16, "view 0"),
        ([np.nan] * 16, "view 0"),
        ([0.0] * 16, "zero"),
    ],
)
def test_invalid_weights_are_rejected(
    student: Splats, targets: TeacherRenders, weights: list[float], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        recover(student, targets, RecoverConfig(steps=1), weights=weights)


def test_the_command_scores_held_out_views_by_kind(
    student: Splats, tmp_path: Path, command_line: Any
) -> None:
    write_splats(tmp_path / "teacher.ply", TEACHER)
    write_splats(tmp_path / "student.ply", student)
    views = replace(around(8), kinds=tuple("anywhere" if i % 4 else "usual" for i in range(8)))
    write_views(tmp_path / "views.json", views, splits=("train", "test") * 4)
    ask = (
        "recover",
        "student.ply",
        "--views",
        "views.json",
        "--teacher",
        "teacher.ply",
        "--steps",
        20,
    )
    ask = (*ask, "-o", "out.ply", "--json", "-")
    (kind,) = json.loads(succeeds(command_line, tmp_path, *ask).out)["kinds"]
    held_out = TeacherRenders(TEACHER, views.take([1, 3, 5, 7]))
    assert (kind["kind"], kind["views"]) == ("anywhere", 4)
    recovered = evaluate(read_splats(tmp_path / "out.ply"), held_out)
    assert kind["psnr"]["after"] == pytest.approx(recovered.psnr, abs=1e-3)
    assert (
        json.loads(succeeds(command_line, tmp_path, *ask, "--split", "all", "-w").out)["kinds"]
        == []
    )


def test_the_command_draws_by_weights_of_views(
    student: Splats, tmp_path: Path, command_line: Any
) -> None:
    write_splats(tmp_path / "teacher.ply", TEACHER)
    write_splats(tmp_path / "student.ply", student)
    write_views(tmp_path / "plain.json", VIEWS)
    write_views(tmp_path / "weighted.json", VIEWS, weights=WEIGHTS)
    made = {}
    ask = ("recover", "student.ply", "--teacher", "teacher.ply", "--split", "all", "--steps", 20)
    for name, *views in (
        ("even", "plain"),
        ("drawn", "weighted"),
        ("ignored", "weighted", "--no-weights"),
    ):
        views[0] = f"--views={views[0]}.json"
        error = succeeds(command_line, tmp_path, *ask, *views, "-o", f"{name}.ply").err
        assert ("views by weight" in error) == (name == "drawn")
        made[name] = read_splats(tmp_path / f"{name}.ply").fingerprint()
    assert made["even"] == made["ignored"] != made["drawn"]
