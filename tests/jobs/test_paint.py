"""Scenes painted by what was found about each Gaussian."""

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.jobs.clean import paint
from helpers.scenes import checkered_ball


def test_paint_keeps_geometry_and_shade() -> None:
    ball = checkered_ball(300)
    found = paint(
        ball, np.where(np.arange(300)[:, None] < 100, [0.93, 0.33, 0.10], [0.55, 0.60, 0.66])
    )
    assert np.array_equal(found.means, ball.means)
    assert np.array_equal(found.logit_opacities, ball.logit_opacities)
    assert found.sh_degree == 0
    assert (found.colors[:100, 0] > found.colors[:100, 2]).all()
    assert (found.colors[100:, 0] < found.colors[100:, 2]).all()
    assert found.colors[ball.colors.sum(1).argmax()].sum() > 0.3
    with pytest.raises(InputError, match=r"expected shape \(300, 3\)"):
        paint(ball, np.zeros((2, 3)))
