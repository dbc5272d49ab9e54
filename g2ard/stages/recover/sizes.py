"""Length unit of each Gaussian, and the typical size of Gaussians in views."""

import numpy as np
from numpy.typing import NDArray

from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.shape import NEEDLE_UNIT, longer_axes
from g2ard.scene.splats import Splats

_MEASURED_VIEWS = 8


def radii(splats: Splats) -> NDArray[np.float32]:
    """Return (N,) √(s₁·s₂) of the two longer scales s₁ ≥ s₂, with s₂ at least s₁/100: the unit of a mean's
    rate.

    With the largest scale as unit, needles would move by several widths.

    >>> radii(Splats.create([[0, 0, 0]], scales=[[9.0, 1e-9, 4.0]])).tolist()
    [6.0]
    """
    middle, largest = longer_axes(splats.scales.astype(np.float64)).T
    middle = np.maximum(middle, NEEDLE_UNIT * largest)
    return np.ascontiguousarray(np.sqrt(middle * largest).astype(np.float32))


def typical_share(splats: Splats, cameras: Cameras) -> float:
    """Return the median of f·s₁/z over Gaussians and a few views, as a share of the longer side.

    Views are evenly spaced, and occlusion is ignored. The share is 0 if no view shows a Gaussian.

    >>> from g2ard.scene.cameras import look_at
    >>> dot = Splats.create([[0, 0, 0]], scales=[[0.1, 0.2, 0.01]])
    >>> views = Cameras.from_lists(
    ...     [look_at([0, -2, 0], [0, 0, 0])], [[[50, 0, 16], [0, 50, 12], [0, 0, 1]]], [(40, 24)], ["v"])
    >>> round(typical_share(dot, views), 6)  # 50 · 0.2 / 2 = 5 pixels of 40
    0.125
    """
    cameras = cameras.recentred(splats.offset)
    largest, view_shares = splats.scales.max(1, initial=0.0).astype(np.float64), []
    for view in evenly_spaced(len(cameras), _MEASURED_VIEWS):
        pose, K = cameras.viewmats[view], cameras.Ks[view]
        size = np.array([cameras.widths[view], cameras.heights[view]], np.float64)
        at = (splats.means @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        front = at[:, 2] > 0
        depth = np.where(front, at[:, 2], 1.0)
        pixel = at[:, :2] / depth[:, None]
        inside = front & ((pixel >= 0) & (pixel < size)).all(1)
        view_shares.append(largest[inside] / depth[inside] * (K[0, 0] / size.max()))
    shares = np.concatenate(view_shares)
    return float(np.median(shares)) if len(shares) else 0.0
