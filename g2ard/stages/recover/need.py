"""How many steps a scene needs: every Gaussian should be looked at about as often."""

from __future__ import annotations

import math

import numpy as np

from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

__all__ = ["steps_for"]

_POINTS = 4096
"""Gaussians looked for to find out."""

_MOST = 2.25
"""Times the schedule's steps, at most: recovery must end in minutes."""


def steps_for(scene: Splats, cameras: Cameras, steps: int) -> int:
    """`steps`, made for views that hold the whole scene, times 1/√share for views that hold a share of it.

    An object is whole in every view of an orbit; in a room or on a path a view holds a tenth. At equal steps
    its Gaussians would learn a tenth as often; the root is the middle between that and equal time.

    Args:
        scene: what is to be recovered.
        cameras: the views it learns from, in world coordinates.
        steps: the schedule's.

    Returns:
        Between `steps` and 2.25 times that.

    >>> from g2ard.scene.cameras import look_at
    >>> line = Splats.create([[0, 0, 0], [9, 0, 0], [0, 0, 9], [-9, 0, 0]], scales=np.ones((4, 3)))
    >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
    >>> view = Cameras.from_lists([look_at([0, -3, 0], [0, 0, 0])], [K], [(64, 64)], ["a"])
    >>> steps_for(line, view, 1000)
    2000
    """
    some = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), _POINTS)).round().astype(int))
    points = scene.means[some].astype(np.float64) + scene.offset
    return round(steps / math.sqrt(max(cameras.usual_share(points), 1 / _MOST**2)))
