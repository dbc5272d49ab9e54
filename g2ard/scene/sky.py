"""Sky and far background of a scene."""

import numpy as np
from numpy.typing import NDArray

from g2ard.scene.samples import weighted_quantile
from g2ard.scene.shape import longer_axes
from g2ard.scene.splats import Splats

_SKY_RADII = (np.sqrt(2) + 1) / (np.sqrt(2) - 1)
"""Least distance of the sky from the middle of the near scene, about 5.8 of its radii: between any two places
within the radius, the distance to the sky changes by less than √2, the step between two levels of detail."""

_NEAR_SHARE = 2 / 3
"""Share of the opacity within the radius of the near scene."""

_LEAST_SKY_SHARE = 1e-3
"""Share of all directions up to which far Gaussians are floaters."""

_RADIUS_SAMPLE = 200_000
"""Largest number of rows that decide middle and radius."""


def sky_mask(splats: Splats) -> NDArray[np.bool_]:
    """Return an (N,) mask of the sky and the far background; none of the rows if there is neither.

    From everywhere in the near scene these Gaussians stand behind it, and at almost the same distance.

    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> dome = 40 * ball[:100] / np.linalg.norm(ball[:100], axis=1, keepdims=True)
    >>> sizes = np.repeat([[0.1] * 3, [4.0] * 3], [900, 100], axis=0)
    >>> scene = Splats.create(np.concatenate([ball, dome]), scales=sizes)
    >>> int(sky_mask(scene).sum()), int(sky_mask(scene.take(slice(900))).sum())
    (100, 0)
    """
    opacities = splats.opacities.astype(np.float64)
    rows = np.flatnonzero(splats.finite_rows() & (opacities > 1 / 255))
    rows = rows[:: max(1, -(-len(rows) // _RADIUS_SAMPLE))]
    middle, reach = np.zeros(3), np.inf
    for _ in range(4):  # without the sky, which moves the middle and widens the radius
        if not len(rows):
            break
        means, weights = splats.means[rows].astype(np.float64), opacities[rows]
        middle = np.array([weighted_quantile(means[:, axis], weights, 0.5) for axis in range(3)])
        away = np.linalg.norm(means - middle, axis=1)
        reach = _SKY_RADII * weighted_quantile(away, weights, _NEAR_SHARE)
        rows = rows[away <= reach]
    away = np.linalg.norm(splats.means.astype(np.float64) - middle, axis=1)
    sky = away > reach
    middle_size, largest = longer_axes(splats.scales[sky].astype(np.float64)).T
    covered = opacities[sky] * middle_size * largest / (2 * away[sky] ** 2)  # 2πσσ of 4π steradians
    if covered.sum() <= _LEAST_SKY_SHARE:
        sky[:] = False
    return sky
