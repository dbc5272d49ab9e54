"""Regions of a scene: spheres and boxes given by the user in world coordinates, and the sky."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from g2ard.arrays import Float, Mask
from g2ard.errors import InputError
from g2ard.scene.samples import weighted_quantile
from g2ard.scene.shape import longer_axes
from g2ard.scene.splats import Splats
from g2ard.scene.transform import in_box, in_sphere

Region = tuple[float, ...]
"""Sphere (x, y, z, r), or box (x, y, z, x, y, z) with its lower and upper corner."""


_SKY_RADII = (np.sqrt(2) + 1) / (np.sqrt(2) - 1)
"""Least distance of the sky from the middle of the near scene, about 5.8 of its radii: between any two places
within the radius, the distance to the sky changes by less than √2, the step between two levels of detail."""

_NEAR_SHARE = 2 / 3  # share of the opacity within the radius of the near scene
_LEAST_SKY_SHARE = 1e-3  # share of all directions up to which far Gaussians are floaters
_RADIUS_SAMPLE = 200_000  # largest number of rows that decide middle and radius


def check_region(region: Sequence[float]) -> Region:
    """Validate a region and return it as plain numbers.

    >>> check_region([0, 0, 0, 2])
    (0.0, 0.0, 0.0, 2.0)
    """
    numbers = tuple(float(value) for value in region)
    if len(numbers) not in (4, 6) or not all(map(math.isfinite, numbers)):
        got = ", ".join(f"{n:g}" for n in numbers)
        raise InputError(f"expected X,Y,Z,R or X,Y,Z,X,Y,Z, got {got}", parameter="region")
    if len(numbers) == 4 and not numbers[3] > 0:
        raise InputError(f"expected a radius > 0, got {numbers[3]:g}", parameter="region")
    if len(numbers) == 6:
        sides = zip(numbers[:3], numbers[3:], strict=True)
        if not all(low < high for low, high in sides):
            raise InputError("empty box; the lower corner comes first", parameter="region")
    return numbers


def as_regions(given: Sequence[Any]) -> tuple[Region, ...]:
    """Validate one or several regions and return them as plain numbers.

    >>> as_regions((0, 0, 0, 2)), as_regions([[0, 0, 0, 2]])
    (((0.0, 0.0, 0.0, 2.0),), ((0.0, 0.0, 0.0, 2.0),))
    """
    try:
        regions = given
        if len(given) > 0 and not np.ndim(given[0]):
            regions = [given]
        return tuple(check_region(region) for region in regions)
    except InputError:
        raise
    except (TypeError, ValueError):
        raise InputError(
            f"expected (x, y, z, r) or (x, y, z, x, y, z), got {given!r}", parameter="keep_region"
        ) from None


def in_any(splats: Splats, regions: Sequence[Region]) -> Mask:
    """Return the (N,) mask of means in any of the regions.

    >>> pair = Splats.create([[0, 0, 0], [5, 0, 0]], scales=np.ones((2, 3)))
    >>> in_any(pair, [(4.0, -1.0, -1.0, 6.0, 1.0, 1.0)]).tolist()
    [False, True]
    """
    inside = np.zeros(len(splats), bool)
    for region in regions:
        if len(region) == 4:
            inside |= in_sphere(splats, region[:3], region[3])
        else:
            inside |= in_box(splats, region[:3], region[3:])
    return inside


def sky_mask(splats: Splats) -> Mask:
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
    middle, reach = _find_near_scene(splats, opacities)
    away = np.linalg.norm(splats.means.astype(np.float64) - middle, axis=1)
    sky = away > reach
    middle_size, largest = longer_axes(splats.scales[sky].astype(np.float64)).T
    # 2πσσ of 4π steradians
    covered = opacities[sky] * middle_size * largest
    covered /= 2 * away[sky] ** 2
    if covered.sum() <= _LEAST_SKY_SHARE:
        sky[:] = False
    return sky


def _find_near_scene(splats: Splats, opacities: Float) -> tuple[Float, float]:
    """Return the (3,) middle of the near scene, and the distance from it at which a sky may begin.

    Rows beyond are dropped and both are found again, because a sky moves the middle and widens the radius.
    """
    visible = splats.finite_rows()
    visible &= opacities > 1 / 255
    rows = np.flatnonzero(visible)
    rows = rows[:: max(1, -(-len(rows) // _RADIUS_SAMPLE))]
    middle = np.zeros(3)
    reach = np.inf
    for _ in range(4):
        if not len(rows):
            break
        means = splats.means[rows].astype(np.float64)
        weights = opacities[rows]
        middle = np.array([weighted_quantile(column, weights, 0.5) for column in means.T])
        away = np.linalg.norm(means - middle, axis=1)
        reach = _SKY_RADII * weighted_quantile(away, weights, _NEAR_SHARE)
        rows = rows[away <= reach]
    return middle, reach
