"""Regions given by the user: spheres and boxes in world coordinates."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.scene.splats import Splats
from g2ard.scene.transform import in_box, in_sphere

Region = tuple[float, ...]
"""Sphere (x, y, z, r), or box (x, y, z, x, y, z) with its lower and upper corner."""


def check_region(region: Sequence[float]) -> Region:
    """Validate a region and return it as plain numbers.

    >>> check_region([0, 0, 0, 2])
    (0.0, 0.0, 0.0, 2.0)
    """
    numbers = tuple(float(value) for value in region)
    if len(numbers) not in (4, 6) or not all(map(math.isfinite, numbers)):
        raise InputError(
            f"expected X,Y,Z,R or X,Y,Z,X,Y,Z, got {', '.join(f'{n:g}' for n in numbers)}", parameter="region"
        )
    if len(numbers) == 4 and not numbers[3] > 0:
        raise InputError(f"expected a radius > 0, got {numbers[3]:g}", parameter="region")
    if len(numbers) == 6 and not all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise InputError("empty box; the lower corner comes first", parameter="region")
    return numbers


def as_regions(given: Sequence[Any]) -> tuple[Region, ...]:
    """Validate one or several regions and return them as plain numbers.

    >>> as_regions((0, 0, 0, 2)), as_regions([[0, 0, 0, 2]])
    (((0.0, 0.0, 0.0, 2.0),), ((0.0, 0.0, 0.0, 2.0),))
    """
    try:
        alone = len(given) > 0 and not np.ndim(given[0])
        return tuple(check_region(region) for region in ([given] if alone else given))
    except InputError:
        raise
    except (TypeError, ValueError):
        raise InputError(
            f"expected (x, y, z, r) or (x, y, z, x, y, z), got {given!r}", parameter="keep_region"
        ) from None


def in_any(splats: Splats, regions: Sequence[Region]) -> NDArray[np.bool_]:
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
