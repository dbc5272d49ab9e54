"""Colours fitted to renders of the dense scene."""

from dataclasses import replace

import numpy as np
import pytest

from g2ard.rendering.recolour import recoloured
from g2ard.rendering.renderer import Renderer
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join
from helpers.scenes import around, checkered_ball

VIEWS = around(8)


def error(dense: Splats, small: Splats) -> float:
    """Return the error of colours alone, Σ A·B²·|t/A − i/B|²."""
    total = 0.0
    for view in range(len(VIEWS)):
        t, i = (Renderer(scene).render(VIEWS[view]) for scene in (dense, small))
        a, b = (np.maximum(r.alpha, 1e-6)[..., None] for r in (t, i))
        total += float((a * b**2 * (t.image / a - i.image / b) ** 2).sum())
    return total


@pytest.mark.parametrize("seed", range(4))
def test_a_fit_never_increases_the_error_of_colours(seed: int) -> None:
    dense, rng = checkered_ball(600), np.random.default_rng(seed)
    small = dense.take(np.arange(0, 600, 9))
    small = replace(
        small,
        scales=(small.scales * rng.uniform(0.5, 4, (len(small), 1))).astype(np.float32),
        sh0=rng.normal(1, 0.3, small.sh0.shape).astype(np.float32),  # nothing is clipped at black
    )
    errors = [error(dense, small)]
    for _ in range(4):
        small = recoloured(dense, small, VIEWS)
        errors.append(error(dense, small))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.7 * errors[0]


def test_light_that_passes_or_is_stopped_does_not_change_colours() -> None:
    dense = checkered_ball(300).with_sh_degree(0)
    dense = replace(dense, sh0=np.full((300, 1, 3), 0.7, np.float32))
    for scale, logit in ((0.5, -2.0), (2.0, 6.0)):
        small = dense.take(np.arange(0, 300, 5))
        small = replace(
            small,
            scales=small.scales * np.float32(scale),
            logit_opacities=np.full(len(small), logit, np.float32),
        )
        np.testing.assert_allclose(recoloured(dense, small, VIEWS).sh0, 0.7, atol=1e-4)


def test_gaussians_that_no_view_shows_keep_their_colours() -> None:
    dense = checkered_ball(300).with_sh_degree(0)
    far = Splats.create(
        [[1e4] * 3], scales=[[0.01] * 3], logit_opacities=[9], sh0=[[[0.1, 0.2, 0.3]]]
    )
    small = dense.take(np.arange(50))
    small = join([small, far])
    fitted = recoloured(dense, small, VIEWS)
    np.testing.assert_array_equal(fitted.sh0[-1], far.sh0[0])
    assert (fitted.sh0[:-1] != small.sh0[:-1]).any()
    for name in ("means", "quats", "scales", "logit_opacities", "shN"):
        assert getattr(fitted, name) is getattr(small, name)


def test_gaussians_that_views_hardly_show_hardly_change() -> None:
    """All around a speck is wrong by 1; it hardly shows there, and its views say little about its colour."""
    dense = checkered_ball(300).with_sh_degree(0)
    dense = replace(dense, sh0=np.full((300, 1, 3), 0.7, np.float32))
    pale = replace(dense, sh0=dense.sh0 + np.float32(1))
    speck = Splats.create(
        [[0, 0, 1.3]], scales=[[2e-3] * 3], logit_opacities=[-3], sh0=[[[0.7] * 3]]
    )
    small = join([pale, speck])
    shift = (recoloured(dense, small, VIEWS).sh0 - small.sh0)[:, 0]
    assert np.median(shift[:-1]) < -0.5
    assert (shift[-1] > -0.3).all()
    assert (shift[-1] < 0).all()
