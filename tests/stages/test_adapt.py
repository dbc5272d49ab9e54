"""Appearance refitted on frozen geometry."""

import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard import io
from g2ard.errors import InputError
from g2ard.pipeline.adapt import AdaptConfig, adapt
from g2ard.scene.targets import TeacherRenders
from g2ard.stages.evaluate import evaluate
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball

VIEWS = around(24)
TRAIN, OTHER = VIEWS.take(np.arange(24) % 3 > 0), VIEWS.take(np.arange(24) % 3 == 0)


def pale(splats):  # type: ignore[no-untyped-def]
    """Return the same geometry without its colours."""
    flat = replace(splats, sh0=np.full_like(splats.sh0, 0.4), shN=np.zeros_like(splats.shN))
    return replace(flat, logit_opacities=splats.logit_opacities - 1)


@pytest.mark.parametrize(("schedule", "gain"), [("default", 8), ("paper", 1)])
def test_colours_come_back_and_geometry_does_not_move(schedule: str, gain: float) -> None:
    ball = checkered_ball(800)
    start = pale(ball)
    before = evaluate(start, TeacherRenders(ball, OTHER)).psnr
    found = adapt(start, TeacherRenders(ball, TRAIN), AdaptConfig(steps=600, schedule=schedule))
    after = evaluate(found.splats, TeacherRenders(ball, OTHER)).psnr
    assert after > before + gain
    for name in ("means", "quats", "scales"):
        np.testing.assert_array_equal(getattr(found.splats, name), getattr(start, name))
    assert found.splats.sh_degree == ball.sh_degree
    assert found.report.steps == 600
    assert found.report.psnr.after > found.report.psnr.before + gain


def test_stops_once_it_has_converged_and_not_before() -> None:
    ball = checkered_ball(300)
    targets = TeacherRenders(ball, TRAIN.resized(32))
    there = adapt(ball, targets, AdaptConfig(steps=7000))
    assert there.report.converged
    assert there.report.steps == 500
    every = adapt(pale(ball), targets, AdaptConfig(steps=1500, tolerance=0))
    assert every.report.steps == 1500
    assert [s.steps for s in every.report.stretches] == [500, 1000]


def test_gives_a_flat_scene_bands_of_its_own() -> None:
    ball = checkered_ball(300)
    flat = ball.with_sh_degree(0)
    found = adapt(flat, TeacherRenders(ball, TRAIN), AdaptConfig(steps=200, sh_degree=2))
    assert found.splats.sh_degree == 2
    assert found.splats.shN.any()


@pytest.mark.parametrize("stop", [7, 520])
def test_an_interrupted_run_resumes_to_the_same_bits(stop: int, tmp_path: Path) -> None:
    ball = checkered_ball(200)
    start, targets = pale(ball), TeacherRenders(ball, TRAIN.resized(24))
    config = AdaptConfig(steps=1500, tolerance=0)
    whole = adapt(start, targets, config)
    told = 0

    def stop_there(stage: str, done: int, total: int, info: object = None) -> None:
        nonlocal told
        told += 1
        if told == stop:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        adapt(start, targets, config, work=tmp_path, progress=stop_there)
    assert (tmp_path / "stretches.npz").exists() == (stop > 500)
    resumed = adapt(start, targets, config, work=tmp_path)
    for name in ("logit_opacities", "sh0", "shN", "means"):
        np.testing.assert_array_equal(getattr(resumed.splats, name), getattr(whole.splats, name))
    assert resumed.report.stretches == whole.report.stretches
    with pytest.raises(InputError, match="other options"):
        adapt(start, targets, replace(config, seed=1), work=tmp_path)


def test_invalid_options_are_rejected() -> None:
    for wrong in ({"steps": 0}, {"tolerance": -1.0}, {"tolerance": float("nan")}, {"schedule": "best"}):
        with pytest.raises(InputError):
            AdaptConfig(**wrong)


def test_command(command_line: CommandLine, tmp_path: Path) -> None:
    ball = checkered_ball(300)
    io.write_splats(tmp_path / "teacher.ply", ball)
    io.write_splats(tmp_path / "pale.ply", pale(ball))
    io.write_views(tmp_path / "views.json", VIEWS)
    options = ["--views", "views.json", "--teacher", "teacher.ply", "-o", "out.ply", "--steps", "60"]
    succeeds(command_line, tmp_path, "adapt", "pale.ply", *options)
    out, start = io.read_splats(tmp_path / "out.ply"), io.read_splats(tmp_path / "pale.ply")
    np.testing.assert_array_equal(out.means, start.means)
    np.testing.assert_allclose(out.scales, start.scales, rtol=1e-6)
    assert np.abs(out.sh0 - start.sh0).max() > 0.1
    assert "out.ply" in refused(command_line, tmp_path, "adapt", "pale.ply", *options, status=1)
