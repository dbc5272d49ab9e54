"""A scene with enough texture for feature matching, and photos of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register import RegisterConfig
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball

CONFIG = RegisterConfig(size=400, align_size=200, matcher="sift")


def blotched(count: int = 6000, blotches: int = 200, seed: int = 5) -> Splats:
    """Return a ball of which no two places look alike."""
    ball = checkered_ball(count)
    rng = np.random.default_rng(seed)
    middles = rng.normal(size=(blotches, 3))
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    color = rng.random((blotches, 1, 3))[np.argmax(ball.means @ middles.T, axis=1)]
    return replace(ball, sh0=((color - 0.5) / 0.28209479).astype(np.float32))


BALL = blotched()


def _photographed(folder: Path, count: int = 2, size: tuple[int, int] = (400, 300)) -> Cameras:
    """Views of the ball, photographed under other light."""
    return photographed(folder, BALL, around(count, size, 2.5), gain=0.7, bias=0.1)
