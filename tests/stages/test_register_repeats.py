"""Scenes that repeat themselves, and focal lengths that are off: σ knows of both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import SH_C0, Splats
from g2ard.stages.register import RegisterConfig, register
from g2ard.stages.register.align import focal_alone, focal_prior
from g2ard.stages.register.config import ROUGH_FOCAL_SIGMA
from g2ard.stages.register.matchers import sift_or_none
from g2ard.stages.register.repeats import Look, decisive, preference, repeated_poses
from g2ard.stages.register.report import PhotoReport
from helpers.feature_scenes import BALL, CONFIG, _photographed
from helpers.photos import photographed
from helpers.registration import off, result_errors
from helpers.scenes import around, views_at


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


def test_a_thing_that_neither_render_has_makes_a_choice_doubtful() -> None:
    """It may be as telling as the pixels where the renders differ."""
    rng = np.random.default_rng(1)
    everywhere = np.ones((90, 120), bool)
    wall = rng.random((90, 120, 3))
    door, photo = wall.copy(), wall + rng.normal(0, 0.03, wall.shape)
    door[30:50, 5:20] = [0.8, 0.1, 0.1]
    a, b, config = Look(wall, everywhere), Look(door, everywhere), RegisterConfig()
    assert decisive(preference(photo, everywhere, a, b, config))
    photo[30:70, 80:110] = [0.8, 0.1, 0.1]
    assert not decisive(preference(photo, everywhere, a, b, config))


def _wall(door: bool) -> Splats:
    """A wall, two units high, of five like panels one unit wide; with a door, one is red at its middle."""
    x, y = (
        a.ravel()
        for a in np.meshgrid(np.arange(-2.5, 2.5, 0.04) + 0.02, np.arange(-1, 1, 0.04) + 0.02)
    )
    panel = np.random.default_rng(7).random((12, 6, 3))
    color = panel[((y + 1) * 6).astype(int), ((x + 2.5) % 1 * 6).astype(int)]
    if door:
        color[(np.abs(x) < 0.3) & (y > 0.1)] = [0.9, 0.05, 0.05]
    return Splats.create(
        np.stack([x, y, 0 * x], 1),
        quats=np.tile([1.0, 0, 0, 0], (len(x), 1)),
        scales=np.tile([0.026, 0.026, 0.001], (len(x), 1)),
        logit_opacities=np.full(len(x), 4.0),
        sh0=((color - 0.5) / SH_C0)[:, None],
    )


def _before(x: float) -> NDArray[np.float64]:
    return look_at([x, 0.1, -2.0], [x + 0.05, 0, 0])


def test_a_photo_of_like_panels_is_uncertain_unless_the_door_tells(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    views = views_at([_before(0.1)], (240, 160), 200.0)
    starts = {views.names[0]: _before(1.1)}
    truth = dict(zip(views.names, views.viewmats, strict=True))
    config = RegisterConfig(size=240, align_size=240)
    rows: list[PhotoReport] = []
    for door in (False, True):
        scene, folder = _wall(door), tmp_path / str(door)
        folder.mkdir()
        photos = photographed(folder, scene, views, gain=0.8, bias=0.05)
        rows += register(scene, photos, starts=starts, config=config).report.photos
    plain, told = rows
    assert plain.status == "uncertain"
    assert "alike" in plain.reason
    assert plain.sigma.position > 0.4
    assert told.status == "registered"
    assert result_errors([told], truth)[0].position < 0.02


@pytest.mark.parametrize("x", [-0.2, 0.1])
def test_repeated_poses_are_panels_away(x: float) -> None:
    sift = sift_or_none(0.85, 4096)
    if sift is None:
        pytest.skip("needs pycolmap")
    view = views_at([_before(x)], (240, 160), 200.0)[0]
    found = repeated_poses(Renderer(_wall(True)), view, sift, RegisterConfig())
    moves = np.array([-T[:3, :3].T @ T[:3, 3] for T in found]) - [x, 0.1, -2.0]
    for side in (-1, 1):
        assert np.abs(moves - [side, 0, 0]).max(1).min() < 0.02
    ball = around(5, (240, 160), 2.5)[1]
    assert repeated_poses(Renderer(BALL), ball, sift, RegisterConfig()) == []


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
    rows = register(BALL, given, starts=starts, config=config, keep="all").report.photos
    for row, error in zip(rows, result_errors(rows, truth), strict=True):
        assert row.status != "registered" or error.position < 6 * row.sigma.position
