"""Appearance refitted on frozen geometry: colours changed at once, and Gaussians that few views have seen."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import g2ard
from g2ard.errors import InputError
from g2ard.pipeline.adapt import (
    AdaptConfig,
    _fit,
    adapt,
    blend_appearance,
    count_views_seeing,
    fit_colour_change,
    recolour,
)
from g2ard.progress import silent
from g2ard.rendering.renderer import render
from g2ard.rendering.targets import Subset, TeacherRenders
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.simplify import simplify
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball

VIEWS = around(24)
TRAIN, OTHER = VIEWS.take(np.arange(24) % 3 > 0), VIEWS.take(np.arange(24) % 3 == 0)


def pale(splats):  # type: ignore[no-untyped-def]
    """Return the same geometry without its colours."""
    flat = replace(splats, sh0=np.full_like(splats.sh0, 0.4), shN=np.zeros_like(splats.shN))
    return replace(flat, logit_opacities=splats.logit_opacities - 1)


@pytest.mark.parametrize(("schedule", "gain"), [("default", 8), ("paper", 0.5)])
def test_colours_come_back_and_geometry_does_not_move(schedule: str, gain: float) -> None:
    ball = checkered_ball(800)
    start = pale(ball)
    before = evaluate(start, TeacherRenders(ball, OTHER)).psnr
    found = adapt(start, TeacherRenders(ball, TRAIN), AdaptConfig(steps=300, schedule=schedule))
    after = evaluate(found.splats, TeacherRenders(ball, OTHER)).psnr
    assert after > before + gain
    for name in ("means", "quats", "scales"):
        np.testing.assert_array_equal(getattr(found.splats, name), getattr(start, name))
    assert found.splats.sh_degree == ball.sh_degree
    assert found.report.steps == 300
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


@pytest.mark.parametrize(
    ("count", "given", "said", "taken"),
    [
        (2, {}, "2 images: 250 steps", 250),
        (20, {}, "20 images: 500 to 1,000 steps, as long as they gain", 500),
        (20, {"tolerance": 0.0}, "20 images: 1,000 steps", 1000),
        (2, {"steps": 3}, "2 images: 3 steps", 3),
    ],
)
def test_steps_follow_the_number_of_images(
    count: int,
    given: dict[str, float],
    said: str,
    taken: int,
    command_line: CommandLine,
    tmp_path: Path,
) -> None:
    """The ball is there already, so that it stops as soon as it may."""
    ball = checkered_ball(60)
    g2ard.save(tmp_path / "ball.ply", ball)
    g2ard.save_views(tmp_path / "views.json", VIEWS.take(range(count)).resized(16))
    ask = ("adapt", "ball.ply", "--teacher", "ball.ply", "--views", "views.json", "--split", "all")
    words = [word for name, value in given.items() for word in (f"--{name}", value)]
    told = succeeds(
        command_line, tmp_path, *ask, *words, "-o", "out.ply", "--json", "told.json"
    ).err
    assert f"{said}\n" in told
    assert json.loads((tmp_path / "told.json").read_text())["steps"] == taken
    planned = succeeds(command_line, tmp_path, *ask, *words, "--dry-run", "--json", "plan.json")
    assert json.loads((tmp_path / "plan.json").read_text())["steps"] >= taken, planned


def test_few_images_are_not_learnt_by_heart() -> None:
    """More steps than the default for two images harm all other views, which gain by the default."""
    ball, _ = evening()
    compact = simplify(ball, 200).splats
    targets = TeacherRenders(replace(ball, sh0=np.abs(ball.sh0)), VIEWS.resized(32))
    some, others = Subset(targets, [0, 3]), Subset(targets, [1, 2, 4, 23])
    few, many = (
        adapt(compact, some, AdaptConfig(**how)) for how in ({}, {"steps": 2000, "tolerance": 0.0})
    )
    assert few.report.steps == 250
    assert evaluate(few.splats, others).psnr > evaluate(many.splats, others).psnr
    assert evaluate(few.splats, others).psnr > evaluate(compact, others).psnr


def test_gives_a_flat_scene_bands_of_its_own() -> None:
    ball = checkered_ball(300)
    flat = ball.with_sh_degree(0)
    found = adapt(flat, TeacherRenders(ball, TRAIN), AdaptConfig(steps=200, sh_degree=2))
    assert found.splats.sh_degree == 2
    others = TeacherRenders(ball, OTHER)
    without = adapt(flat, TeacherRenders(ball, TRAIN), AdaptConfig(steps=200))
    assert without.splats.sh_degree == 0
    assert evaluate(found.splats, others).psnr > evaluate(without.splats, others).psnr + 1


def test_invalid_options_are_rejected() -> None:
    for wrong in (
        {"steps": 0},
        {"tolerance": -1.0},
        {"tolerance": float("nan")},
        {"schedule": "best"},
    ):
        with pytest.raises(InputError):
            AdaptConfig(**wrong)


BACKGROUND = (0.2, 0.3, 0.1)
MATRIX = np.array([[0.8, 0.1, 0.0], [0.0, 0.7, 0.1], [0.05, 0.0, 0.9]])
SHIFT = np.array([0.05, 0.0, 0.02])


def evening(count: int = 800):  # type: ignore[no-untyped-def]
    """A ball of many colours, and the same under another light."""
    ball = checkered_ball(count)
    colours = np.random.default_rng(3).uniform(-1, 1, ball.sh0.shape).astype(np.float32)
    ball = replace(ball, sh0=colours, shN=0.1 * ball.shN)
    matrix = MATRIX.astype(np.float32)
    rest = (MATRIX.sum(1) * 0.5 + SHIFT - 0.5) / 0.28209479177387814
    lit = replace(ball, sh0=ball.sh0 @ matrix.T + rest.astype(np.float32), shN=ball.shN @ matrix.T)
    return ball, lit


def test_a_change_of_light_is_found_and_made() -> None:
    ball, lit = evening()
    change = fit_colour_change(ball, TeacherRenders(lit, VIEWS, background=BACKGROUND), BACKGROUND)
    np.testing.assert_allclose(change.matrix, MATRIX, atol=0.02)
    np.testing.assert_allclose(change.shift, SHIFT, atol=0.02)
    assert change.gain > 15
    moved = recolour(ball, change)
    for view in (0, 7):
        got, want = (render(s, VIEWS[view], background=BACKGROUND).image for s in (moved, lit))
        np.testing.assert_allclose(got, want, atol=0.02)


def test_an_unchanged_light_gives_the_identity() -> None:
    ball = checkered_ball(500)
    change = fit_colour_change(ball, TeacherRenders(ball, VIEWS), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(change.matrix, np.eye(3), atol=1e-5)  # targets have 16 bits
    assert (
        adapt(ball, TeacherRenders(ball, VIEWS), AdaptConfig(steps=5)).report.colour_change is None
    )


def test_masked_pixels_are_ignored(tmp_path: Path) -> None:
    ball, lit = evening(500)

    class HalfBlack(TeacherRenders):
        def __getitem__(self, view: int):  # type: ignore[no-untyped-def]
            return np.where(self.mask(view)[..., None], super().__getitem__(view), np.float32(0))

        def mask(self, view: int):  # type: ignore[no-untyped-def]
            height, width = int(self.cameras.heights[view]), int(self.cameras.widths[view])
            return np.broadcast_to(np.arange(width) < width // 2, (height, width))

    change = fit_colour_change(ball, HalfBlack(lit, VIEWS), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(change.matrix, MATRIX, atol=0.03)


def test_views_that_see_a_gaussian_are_counted() -> None:
    ball = checkered_ball(800)
    all_round, one = count_views_seeing(ball, VIEWS), count_views_seeing(ball, VIEWS.take([0]))
    assert 0 <= one.min() <= one.max() < 1
    assert all_round.max() > 4
    eye = VIEWS.positions[0] / np.linalg.norm(VIEWS.positions[0])
    facing = (ball.means @ eye) / np.linalg.norm(ball.means, axis=1)
    assert one[facing > 0.8].mean() > 10 * one[facing < -0.2].mean()


def test_a_blend_goes_its_share_of_the_way() -> None:
    ball, lit = evening(50)
    share = np.linspace(0, 1, 50)
    mixed = blend_appearance(ball, lit, share)
    np.testing.assert_array_equal(mixed.sh0[0], ball.sh0[0])
    np.testing.assert_allclose(mixed.sh0[-1], lit.sh0[-1], atol=1e-6)
    want = ball.shN + share[:, None, None] * (lit.shN - ball.shN)
    np.testing.assert_allclose(mixed.shN, want, atol=1e-6)
    np.testing.assert_array_equal(mixed.means, ball.means)


def test_few_images_also_change_unseen_gaussians() -> None:
    """Three photos of one side: the other side gets the light but no noise."""
    ball, lit = evening(1500)
    targets = TeacherRenders(lit, VIEWS)
    facing = VIEWS.positions @ VIEWS.positions[0]
    rows, others = np.argsort(-facing)[:3], Subset(targets, np.argsort(facing)[:6])
    compact = simplify(ball, 300).splats  # of fewer the reduction's error hides the light's
    psnr = {}
    for prior_views in (0.0, 1.0):
        config = AdaptConfig(steps=300, prior_views=prior_views)
        done = adapt(compact, Subset(targets, rows), config)
        psnr[prior_views] = evaluate(done.splats, others).psnr
    assert psnr[1.0] > evaluate(compact, others).psnr + 2
    assert psnr[1.0] > psnr[0.0] + 0.3
    assert 0.3 < done.report.prior_share < 0.95


def test_each_stretch_draws_views_in_another_order() -> None:
    """One seed for all stretches would omit the same views at the beginning of each."""
    seeds, ball = [], checkered_ball(40)

    def recover(
        name: str, scene: Splats, targets: object, how: RecoverConfig, **_: object
    ) -> object:
        seeds.append(how.seed)
        return scene, SimpleNamespace(psnr=SimpleNamespace(before=0.0, after=1.0))

    targets, steps = SimpleNamespace(cameras=VIEWS), SimpleNamespace(recover=recover)
    config = AdaptConfig(steps=4000, seed=5)
    _fit(ball, targets, config, steps, silent)  # type: ignore[arg-type]
    assert len(seeds) == len(config.stretches(24)) == 3
    assert seeds == [5, 6, 7]
