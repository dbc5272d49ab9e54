"""A scene in a small unit is the same scene, through every stage that looks at it."""

from dataclasses import replace

import numpy as np
import pytest

from g2ard.rendering.renderer import RasterSettings, render, settings_for
from g2ard.rendering.targets import TeacherRenders
from g2ard.rendering.visibility import visibility, visibility_source
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import recover
from g2ard.stages.simplify import simplify
from helpers.scenes import around, assert_same_bits, checkered_ball, in_units

BALL, VIEWS = checkered_ball(), around(12, (80, 60))


@pytest.mark.parametrize("method", ["default", "fast"])
@pytest.mark.parametrize("unit", [2.0**-10, 2.0**9])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_visibility_scales_exactly_by_powers_of_two(method, unit, dtype):
    scene, cameras = replace(BALL, means=BALL.means.astype(dtype)), VIEWS
    small, near = in_units(scene, cameras, unit)
    here = simplify(scene, 150, method=method, visibility=visibility_source(cameras))
    there = simplify(small, 150, method=method, visibility=visibility_source(near))
    assert here.report.fitted > 50
    back = in_units(there.splats, near, 1 / unit)[0]
    if method == "default":  # colours are fitted to renders, which do not scale exactly
        np.testing.assert_allclose(back.sh0, here.splats.sh0, rtol=0, atol=1e-5)
        back = replace(back, sh0=here.splats.sh0)
    assert_same_bits(back, here.splats)
    np.testing.assert_array_equal(there.parents, here.parents)


def test_an_image_does_not_depend_on_the_unit():
    scene, cameras = BALL, VIEWS
    small, near = in_units(scene, cameras, 1e-3)
    here, there = render(scene, cameras[0]), render(small, near[0])
    assert here.alpha.max() > 0.9
    np.testing.assert_allclose(there.image, here.image, rtol=0, atol=1e-3)
    seen, same = visibility(scene, cameras), visibility(small, near)
    assert abs(same.weight.sum() / seen.weight.sum() - 1) < 1e-3


def test_the_near_plane_is_the_conventions_in_ordinary_scenes():
    points = BALL.means
    inria = RasterSettings(convention="inria")
    assert settings_for(points).near_of(0) == 0.01
    assert settings_for(1000 * points, inria).near_of(0) == 0.2
    assert settings_for(points / 1000, inria).near_of(0) == pytest.approx(0.0004, rel=0.02)
    assert settings_for(points / 1000, RasterSettings(near=0.5)).near_of(0) == 0.5
    assert settings_for(points[:1]).near_of(0) == 0.01


def test_recovery_works_in_any_unit():
    figures = []
    for unit in (1.0, 1e-3):
        scene, cameras = in_units(BALL, VIEWS, unit)
        student = simplify(scene, 300).splats
        done = recover(student, TeacherRenders(scene, cameras), RecoverConfig(steps=30))
        figures.append((done.report.psnr.before, done.report.psnr.after))
    (before, after), (before_small, after_small) = figures
    assert after > before + 1
    assert before_small == pytest.approx(before, abs=0.05)
    assert after_small == pytest.approx(after, abs=0.3)
