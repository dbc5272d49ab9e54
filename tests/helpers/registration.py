"""A scene, poses and images for tests of direct alignment."""

import numpy as np

from benchmarks.kinds.register import displaced as off
from benchmarks.kinds.register import result_errors
from g2ard.io.images import resize
from g2ard.scene.cameras import Camera, Cameras
from g2ard.stages.register.align import Level, level_of
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import grey_of
from helpers.scenes import checkered_ball

__all__ = ["BALL", "CONFIG", "off", "pyramid_of", "result_errors"]

CONFIG = RegisterConfig(size=160, coarsest=40)
BALL = checkered_ball(2500)


def pyramid_of(
    camera: Camera, image: np.ndarray, config: RegisterConfig
) -> list[tuple[Camera, Level]]:
    cameras = [Cameras.of([camera]).resized(side)[0] for side in config.levels()]
    return [(c, level_of(grey_of(resize(image, (c.width, c.height))))) for c in cameras]
