"""View selection by light: views that resolve the Gaussians which other views leave unresolved."""

from collections.abc import Callable

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Float32, Int
from g2ard.progress import Progress, silent
from g2ard.rendering.renderer import arrays_of, centred, settings_for, view_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced, take_evenly
from g2ard.scene.splats import Splats

_RESOLVING_PIXELS = 16.0
"""Light in pixels, τ, that resolves a Gaussian once: it has 13 values without harmonics."""
_MOST_PIXELS = 64.0
"""Most light in pixels that counts per Gaussian and view: more shows nothing new."""
_RENDER_SIDE = 240
"""Longer side in pixels of the renders that measure light."""
_SAMPLED_ROWS = 50_000
"""Gaussians that represent all."""
_SAMPLED_VIEWS = 64
"""Given views that represent all."""
_BATCH = 32
"""Views rendered together."""


def complete(
    scene: Splats,
    given: Cameras,
    offered: Cameras,
    most: int,
    *,
    least_views: int = 1,
    represents: float = 1.0,
    progress: Progress = silent,
) -> tuple[Int, Float, float]:
    """Choose offered views greedily by what they resolve beyond the given ones (decision 0034).

    The objective is F = Σ_i log(1 + Σ_v A_vi/16) over the given and the chosen views v, where A_vi is the
    light αT that Gaussian i sends to view v, in pixels of its full-size image, at most 64. Views are chosen
    while the next gains more than looking again from one of the n given views, (1/n) Σ_i B_i/(1 + B_i) on
    average, where B_i is the sum over these.

    Args:
        least_views: n is at least this, so that few given views do not end the choice early.
        represents: Gaussians to be trained per row of `scene`.

    Returns:
        (K,) indices of the chosen views, best first; (K,) what each added to the objective, per Gaussian; and
        the share of the Gaussians that neither the given nor the chosen views show with a pixel of light.

    >>> from g2ard.scene.cameras import Camera
    >>> pair = Splats.create([[0, 0, 0], [9, 0, 0]], scales=np.full((2, 3), 0.1), logit_opacities=[9, 9])
    >>> left = Cameras.of([Camera.facing([0, -2, 0], [0, 0, 0], width=64, height=48)])
    >>> both = [Camera.facing([x, -3, 0], [x, 0, 0], width=64, height=48, name=str(x)) for x in (0, 9)]
    >>> order, _, unseen = complete(pair, left, Cameras.of(both), 1)
    >>> order.tolist(), unseen
    ([1], 0.0)
    """
    some = np.array(evenly_spaced(len(scene), _SAMPLED_ROWS), np.int64)
    measured = take_evenly(given, _SAMPLED_VIEWS)
    renders = len(measured) + len(offered)

    def light(cameras: Cameras, first: int) -> Float32:
        return _measure_light(
            scene, cameras, some, 1 / represents, lambda i: progress("coverage", first + i, renders)
        )

    progress("coverage", 0, renders)
    before = light(measured, 0).sum(axis=0, dtype=np.float64) * (len(given) / max(1, len(measured)))
    received = light(offered, len(measured))
    progress("select", 0, 0)
    order, gains = _core.select_light(received, before, most)
    again = float((before / (1 + before)).sum()) / max(len(given), least_views)
    count = int(np.searchsorted(-gains, -again))  # gains fall
    total = before + received[order[:count]].sum(axis=0, dtype=np.float64)
    unseen = float((total * _RESOLVING_PIXELS < 1).mean())
    return order[:count].astype(np.int64), gains[:count] / len(some), unseen


def _measure_light(
    scene: Splats,
    cameras: Cameras,
    rows: Int,
    share: float,
    tell: Callable[[int], None],
) -> Float32:
    """Return (C, R) min(share·A, 64)/16 for some rows."""
    local, here = centred(scene, cameras.resized(_RENDER_SIDE))
    settings = settings_for(local.means, None, antialiased=local.antialiased)
    arrays = arrays_of(local)
    light = np.zeros((len(cameras), len(rows)), np.float32)
    for first in range(0, len(cameras), _BATCH):
        batch = range(first, min(first + _BATCH, len(cameras)))
        views = [view_of(here, i, settings) for i in batch]
        for i, sums in zip(batch, _core.accumulate_each(arrays, views, settings), strict=True):
            pixels = float(cameras.widths[i] * cameras.heights[i]) / float(
                here.widths[i] * here.heights[i]
            )
            light[i] = (
                np.minimum(sums["weight"][rows] * (pixels * share), _MOST_PIXELS)
                / _RESOLVING_PIXELS
            )
        tell(batch.stop)
    return light
