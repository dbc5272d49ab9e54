"""Visibility sampled from small renders, against all pixels of all views."""

import numpy as np
import pytest

from g2ard.rendering.visibility import visibility, visibility_source
from helpers.scenes import around, checkered_ball


@pytest.mark.parametrize("longest", [32, 96, 640])
def test_pixel_sizes_are_those_of_the_full_images(longest: int) -> None:
    ball, views = checkered_ball(400), around(8, (640, 480))
    sampled = visibility_source(views, longest=longest)(ball).pixel_size
    full = visibility(ball, views).pixel_size
    assert np.isfinite(full).all()
    np.testing.assert_allclose(sampled, full, rtol=0.01)
