"""A scene, poses and images for tests of direct alignment."""

import numpy as np

from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.images import resized
from g2ard.stages.register.align import Level, level_of
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import grey_of
from g2ard.stages.register.pose import rotation_of
from helpers.scenes import checkered_ball

CONFIG = RegisterConfig(size=160, coarsest=40)


BALL = checkered_ball(2500)


def pyramid_of(camera: Camera, image: np.ndarray, config: RegisterConfig) -> list[tuple[Camera, Level]]:
    cameras = [Cameras.of([camera]).resized(side)[0] for side in config.levels()]
    return [(c, level_of(grey_of(resized(image, (c.width, c.height))))) for c in cameras]


def off(viewmat: np.ndarray, distance: float, degrees: float, seed: int) -> np.ndarray:
    """Return a pose whose centre is `distance` away and whose rotation differs by `degrees`."""
    rng = np.random.default_rng(seed)
    v, w = rng.normal(size=(2, 3))
    turn = rotation_of(np.radians(degrees) * w / np.linalg.norm(w))
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3] + distance * v / np.linalg.norm(v)
    out = np.eye(4)
    out[:3, :3] = turn @ viewmat[:3, :3]
    out[:3, 3] = -out[:3, :3] @ centre
    return out
