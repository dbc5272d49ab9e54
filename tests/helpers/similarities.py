"""Similarity transforms, and a scene whose look depends on the direction."""

from dataclasses import replace

import numpy as np

from g2ard.scene.splats import Splats
from helpers.scenes import checkered_ball


def turn(seed: int = 0) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def matrix(scale: float, rotation: np.ndarray, shift: list[float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = scale * rotation, shift
    return out


def directional(degree: int = 3) -> Splats:
    ball = checkered_ball(800)
    rng = np.random.default_rng(5)
    return replace(ball, shN=rng.normal(0, 0.2, (800, (degree + 1) ** 2 - 1, 3)).astype(np.float32))
