"""Scenes painted by what simplification computes: protection flags, locality cells and parents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard import _core
from g2ard.errors import InputError, require
from g2ard.scene.splats import SH_C0, Splats

_FLAGGED_COLOUR = np.array([0.93, 0.33, 0.10])
_PLAIN_COLOUR = np.array([0.55, 0.60, 0.66])
_DROPPED_COLOUR = np.array([0.06, 0.06, 0.06])
"""Colour of rows that were dropped or trimmed."""

_LUMA = np.array([0.2126, 0.7152, 0.0722])
_SCENE_BRIGHTNESS_SHARE = 0.45
"""Share of the brightness taken from the scene, so that its shape stays visible."""

_GOLDEN = 0.6180339887498949


def painted(splats: Splats, colors: ArrayLike) -> Splats:
    """Recolour a scene, view-independently, shaded by the luma of its own colours.

    Args:
        colors: (N, 3) in [0, 1].

    Returns:
        The same geometry and opacities, SH degree 0.

    >>> scene = Splats.create(np.zeros((2, 3)), scales=np.ones((2, 3)), sh0=np.full((2, 1, 3), 9.0))
    >>> painted(scene, [[1, 0, 0], [0, 0, 1]]).colors.round(3).tolist() == [[1, 0, 0], [0, 0, 1]]
    True
    """
    paint = np.asarray(colors, np.float64)
    require("colors", paint.shape, paint.shape == (len(splats), 3), f"shape ({len(splats)}, 3)")
    luma = np.clip(splats.colors.astype(np.float64) @ _LUMA, 0, 1)
    shaded = paint * (1 - _SCENE_BRIGHTNESS_SHARE + _SCENE_BRIGHTNESS_SHARE * luma[:, None])
    sh0 = np.ascontiguousarray(((shaded - 0.5) / SH_C0)[:, None], np.float32)
    return replace(splats, sh0=sh0, shN=np.zeros((len(splats), 0, 3), np.float32))


def flag_colors(flags: ArrayLike) -> NDArray[np.float64]:
    """Return (N, 3) colours of (N,) protection flags: orange if p_i = 1 (eq. `frequency`), otherwise grey."""
    return np.where(np.asarray(flags, bool)[:, None], _FLAGGED_COLOUR, _PLAIN_COLOUR)


def label_colors(labels: ArrayLike) -> NDArray[np.float64]:
    """Return (N, 3) colours of (N,) labels: one hue per label, nearly black for negative labels.

    Hues advance by the golden ratio, so consecutive labels differ; distant labels may look alike.

    >>> np.unique(label_colors([0, 1, 1, -1]), axis=0).shape
    (3, 3)
    """
    numbers = np.asarray(labels, np.int64)
    hue = (numbers * _GOLDEN) % 1.0
    wheel = np.abs((hue[:, None] * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1
    tone = 0.25 + 0.25 * ((numbers * _GOLDEN**2) % 1.0)
    colors = tone[:, None] + (1 - tone[:, None]) * np.clip(wheel, 0, 1)
    return np.where(numbers[:, None] < 0, _DROPPED_COLOUR, colors)


def cell_labels(splats: Splats, count: int) -> NDArray[np.int64]:
    """Return the locality cell of each Gaussian: adaptive voxels, about `count` of them occupied
    (`tab:s_config`).

    They are the cells of `simplify.flag` for a budget of `count`. A Gaussian outside the lattice gets a cell
    of its own.

    Args:
        count: number of cells, N_S in the paper.

    Returns:
        (N,) cell numbers from 0, in arbitrary order.
    """
    if count < 1 or not len(splats):
        raise InputError(
            f"expected at least one cell and one Gaussian, got {count} and {len(splats)}", parameter="cells"
        )
    means = splats.means.astype(np.float64)
    origin, radius = _frame(means)
    arrays = (means - origin, splats.quats, splats.scales, splats.opacities)
    size = _core.select_surface(tuple(np.ascontiguousarray(a) for a in arrays), count)["size"]
    lattice = np.floor((means - origin + radius) / size)
    outside = ((lattice < 0) | (lattice >= 2**21)).any(1)
    lattice[outside, 0] = -1 - np.arange(np.count_nonzero(outside))
    lattice[outside, 1:] = 0
    return np.unique(lattice.astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)


def _frame(means: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the centre and half-width of the lattice's cube, as in the core's `Frame`."""
    last = len(means) - 1
    ranks = np.sort(means, axis=0)
    low, middle, high = (ranks[rank] for rank in (last // 100, last // 2, last - last // 100))
    reach = float(np.maximum(middle - low, high - middle).max())
    if not reach > 0:
        reach = float(np.maximum(middle - ranks[0], ranks[-1] - middle).max())
    return middle, 2 * reach if reach > 0 else 1.0
