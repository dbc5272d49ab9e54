"""Targets: which renders are kept, and at what precision."""

import numpy as np

from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import TeacherRenders
from helpers.scenes import around, checkered_ball


def test_renders_beyond_the_limit_are_kept_in_16_bits() -> None:
    ball, views = checkered_ball(), around().resized(32)
    exact = [Renderer(ball).clipped(view) for view in views]
    size = sum(image.nbytes for image in exact)
    whole, rounded = TeacherRenders(ball, views, limit=size), TeacherRenders(ball, views, limit=size // 2)
    assert all(np.array_equal(whole[i], image) for i, image in enumerate(exact))
    for i, image in enumerate(exact):
        assert rounded[i].dtype == np.float32
        assert 0 < np.abs(rounded[i] - image).max() <= 0.51 / 65535
    assert len(rounded._kept) == len(views)
