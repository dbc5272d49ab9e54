"""The sky: what stands far behind everything, wherever the scene is."""

import numpy as np
import pytest

from g2ard.scene.regions import sky_mask
from g2ard.scene.transform import transform
from helpers.scenes import checkered_ball, under_a_sky


@pytest.mark.parametrize("shift", [[0, 0, 0], [70, 0, 0], [-30, 500, 20]])
@pytest.mark.parametrize("scale", [0.01, 1, 100])
def test_the_sky_does_not_depend_on_place_or_unit(shift: list[float], scale: float) -> None:
    ball = checkered_ball(400)
    scene = under_a_sky(ball)
    moved = scale * np.eye(4)
    moved[:, 3] = [*np.multiply(scale, shift), 1]
    sky = sky_mask(transform(scene, moved))
    np.testing.assert_array_equal(sky, np.arange(len(scene)) >= len(ball))
