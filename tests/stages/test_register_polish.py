"""Polishing: its energy's gradient, its minimum, and the features' prior."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from g2ard.rendering.renderer import Renderer
from g2ard.stages.register import RegisterConfig, pose_error
from g2ard.stages.register.align import Aligned
from g2ard.stages.register.grey import blurred, blurred_back
from g2ard.stages.register.polish import Energy, Prior, polish
from g2ard.stages.register.pose import moved
from helpers.registration import off, pyramid_of
from helpers.scenes import around, checkered_ball

CONFIG = RegisterConfig(size=160)
BALL = checkered_ball(2500)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_blur_s_transpose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 9, 2))
    a, b = rng.normal(size=(2, *shape))
    assert (blurred(a) * b).sum() == pytest.approx((a * blurred_back(b)).sum(), abs=1e-12)


def test_its_slope_is_how_the_energy_changes() -> None:
    """Differences along all eight unknowns at once, because pixels and Gaussians come and go."""
    camera, renderer = around(5, (160, 120), 2.5)[1], Renderer(BALL)
    level = pyramid_of(camera, np.clip(0.9 * renderer.image(camera), 0, 1), CONFIG)[-1][1]
    start = off(camera.viewmat, 0.02, 0.4, 3)
    prior = Prior(off(camera.viewmat, 0.01, 0.2, 4), 50 * np.eye(6))
    energy = Energy(renderer, camera, level, prior, CONFIG)
    here = energy.at(start, 1.0, 0.0)
    along = here.slope / np.sqrt(np.diag(here.hessian))
    along /= np.linalg.norm(along) * np.sqrt(np.diag(here.hessian))
    step = 0.3
    ends = [energy.at(moved(start, s * along[:6]), 1 + s * along[6], s * along[7]) for s in (step, -step)]
    assert (ends[0].energy - ends[1].energy) / (2 * step) == pytest.approx(here.slope @ along, rel=0.1)


@pytest.mark.parametrize("view", range(3))
def test_it_ends_at_the_pose(view: int) -> None:
    """Less exactly than alignment does: the cut of α at 1/255 has no gradient to follow."""
    camera, renderer = around(5, (160, 120), 2.5)[view], Renderer(BALL)
    level = pyramid_of(camera, np.clip(0.7 * renderer.image(camera) + 0.1, 0, 1), CONFIG)[-1][1]
    start = Aligned(off(camera.viewmat, 0.01, 0.3, view), 0.7, 0.1, None, 0.0, 0, 0.0)
    found = polish(renderer, start, camera, level, None, CONFIG)
    distance, angle = pose_error(found.viewmat, camera.viewmat)
    assert distance < 3e-3
    assert angle < 0.1
    held = Prior(start.viewmat, 1e9 * np.eye(6))
    stays = polish(renderer, start, camera, level, held, CONFIG)
    assert pose_error(stays.viewmat, start.viewmat)[0] < 1e-4


def test_out_of_sight_there_is_nothing_to_polish() -> None:
    camera = around(5, (160, 120), 2.5)[0]
    level = pyramid_of(camera, np.full((120, 160, 3), 0.5, np.float32), CONFIG)[-1][1]
    away = camera.viewmat.copy()
    away[:3, 3] = [0, 0, -20]
    start = Aligned(away, 1.0, 0.0, None, 0.0, 0, 0.0)
    assert polish(Renderer(BALL), start, replace(camera, viewmat=np.eye(4)), level, None, CONFIG) is None
