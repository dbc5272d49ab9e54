"""Scenes that repeat themselves, and focal lengths that are off: σ knows of both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.scene.cameras import Cameras
from g2ard.stages.register import RegisterConfig, register
from g2ard.stages.register.align import focal_alone, focal_prior
from g2ard.stages.register.config import ROUGH_FOCAL_SIGMA
from g2ard.stages.register.repeats import Look, decisive, preference
from helpers.feature_scenes import BALL, CONFIG, _photographed
from helpers.registration import off


def test_a_photo_prefers_the_render_that_explains_where_two_differ() -> None:
    rng = np.random.default_rng(0)
    everywhere = np.ones((90, 120), bool)
    wall = rng.random((90, 120, 3))
    door = wall.copy()
    door[30:70, 40:70] = [0.8, 0.1, 0.1]
    a, b = Look(door, everywhere), Look(wall, everywhere)
    noise = rng.normal(0, 0.03, wall.shape)
    config = RegisterConfig()
    for seen, first, second in ((door, a, b), (wall, b, a)):
        photo = 0.7 * seen + 0.1 + noise
        assert decisive(preference(photo, everywhere, first, second, config))
        assert preference(photo, everywhere, second, first, config) < 0
    between = 0.7 * (door + wall) / 2 + 0.1 + noise
    assert not decisive(abs(preference(between, everywhere, a, b, config)))
    assert preference(0.7 * wall + noise, everywhere, b, b, config) == 0


def test_data_that_contradict_a_focal_length_widen_its_prior() -> None:
    matrix = np.diag([1.0] * 6 + [1e4])
    alone = focal_alone(matrix, np.array([0.0] * 6 + [500.0]), 1.05)
    assert alone == pytest.approx((np.log(1.05) + 0.05, 0.01))
    assert focal_prior(alone, 0.001) == pytest.approx(alone[0])
    assert focal_prior(alone, 0.1) == 0.1
    assert focal_prior((1.0, np.inf), 0.1) == 0.1


@pytest.mark.parametrize("wrong", [0.9, 1.1])
@pytest.mark.parametrize("matcher", ["sift", "direct"])
def test_sigma_knows_of_a_wrong_focal_length(wrong: float, matcher: str, tmp_path: Path) -> None:
    if matcher == "sift":
        pytest.importorskip("pycolmap")
    views = _photographed(tmp_path)
    Ks = views.Ks.copy()
    Ks[:, [0, 1], [0, 1]] *= wrong
    truth = dict(zip(views.names, views.viewmats, strict=True))
    starts = {name: off(pose, 0.05, 2, i) for i, (name, pose) in enumerate(truth.items())}
    config = replace(CONFIG, matcher=matcher, focal_sigma=ROUGH_FOCAL_SIGMA)
    given: Cameras = replace(views, Ks=Ks)
    for row in register(BALL, given, starts=starts, truth=truth, config=config).report.photos:
        assert row.status != "registered" or row.error.position < 6 * row.sigma.position
