"""Tests that a reduction keeps a yard under a sky and the lines of a sign."""

from __future__ import annotations

import numpy as np
import pytest

import g2ard
from g2ard.rendering.metrics import detail
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from helpers.skies import courtyard, sign, under_sky


def looking(target: tuple[float, float, float], distance: float, count: int = 4) -> Cameras:
    """Return views of 320 by 240 pixels from the front of a target, somewhat above it."""
    views = []
    for i, turn in enumerate(np.linspace(-0.6, 0.6, count)):
        eye = np.add(target, distance * np.array([np.sin(turn), -np.cos(turn), 0.15]))
        views.append(Camera.facing(eye, target, width=320, height=240, fov=55, name=f"{i}"))
    return Cameras.of(views)


def kept(dense: Splats, small: Splats, views: Cameras) -> float:
    """Return the mean share of detail that a result keeps."""
    pairs = [[g2ard.Renderer(scene).clipped(view) for scene in (small, dense)] for view in views]
    return float(np.mean([detail(*pair) for pair in pairs]))


@pytest.mark.parametrize("share", [0.1, 0.35, 0.6])
def test_a_yard_keeps_its_house_under_any_share_of_sky(share: float) -> None:
    scene = under_sky(courtyard(), share, 500.0, -0.1)
    small = g2ard.simplify(scene, ratio=10)
    near = np.linalg.norm(small.splats.means, axis=1) < 50
    assert near.sum() > 0.05 * len(courtyard())
    assert kept(scene, small.splats, looking((-1, 1, 1), 6.0)) > 0.7


def test_a_sign_keeps_its_lines() -> None:
    scene = sign()
    small = g2ard.simplify(scene, ratio=10)
    assert kept(scene, small.splats, looking((0, 0, 1.45), 1.6)) > 0.28
