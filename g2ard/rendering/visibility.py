"""Contribution of each Gaussian to views: over all pixels, or sampled from a few small renders."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.arrays import Float, Float32, Values
from g2ard.progress import Progress, counter, silent
from g2ard.rendering.renderer import RasterSettings, arrays_of, centred, settings_for, view_of
from g2ard.scene.cameras import USUAL, Cameras, rows_by_kind
from g2ard.scene.prepared import as_prepared
from g2ard.scene.samples import evenly_spaced, take_evenly
from g2ard.scene.splats import Splats

MOST_VIEWS = 96
"""Largest number of views per scene or tile."""

LONGEST = 300
"""Longer side of their renders in pixels."""

ROUND = 16
"""Views per round."""

_FREE_GAUSSIAN_VIEWS = 6_000_000
"""Gaussians × views up to which another round costs almost nothing."""

NEAR = 1e-3
"""Near plane as a fraction of the cameras' median distance from the scene's centre."""

_OTHER_VIEWS = 32
"""Most views of other kinds than usual ones."""

_OTHER_SHARE = 0.05
"""Their weight relative to that of all usual views, because they show few Gaussians with many pixels each.
Measured in decision 0040."""

CONVERGED = 0.01
"""Sampling stops after a round whose share of newly seen Gaussians is below this."""


@dataclass(frozen=True, eq=False)
class SampledVisibility:
    """Visibility sampled from a few small renders, for the weights of simplification.

    Args:
        weight: (N,) float32, Σ αT²: behind transmittance T, a change adds to a squared error with T².
        pixel_size: (N,) float32, the smallest depth / focal length over the views whose image contains the
            Gaussian's mean: the size of a pixel there, scene units; ∞ if no view contains it. It is that of
            the full-size image.
    """

    weight: Values
    pixel_size: Float32


@dataclass(frozen=True, eq=False)
class Visibility(SampledVisibility):
    """Contribution of each Gaussian to a set of views, summed over their pixels.

    Args:
        weight: (N,) float64, Σ αT: the light that it sends to the cameras.
        transmittance: (N,) float64, Σ T over the pixels it touches.
        hits: (N,) uint64, pixels it touches (α ≥ 1/255, before the light is used up).
        dominant: (N,) uint64, pixels where no other Gaussian has a larger αT.
        peak: (N,) float32, its largest αT.
    """

    transmittance: Float
    hits: NDArray[np.uint64]
    dominant: NDArray[np.uint64]
    peak: Float32


def visibility(
    splats: Splats,
    cameras: Cameras,
    progress: Progress = silent,
    *,
    settings: RasterSettings | None = None,
) -> Visibility:
    """Sum each Gaussian's contributions αT over all pixels of all views.

    Summation has a fixed order, so the result does not depend on the number of threads.
    """
    splats, cameras = centred(splats, cameras)
    settings = settings_for(splats.means, settings, antialiased=splats.antialiased)
    views = [view_of(cameras, i, settings) for i in range(len(cameras))]
    progress("visibility", 0, len(views))
    sums: dict[str, Any] = _core.accumulate(
        arrays_of(splats), views, settings, counter(progress, "visibility")
    )
    return Visibility(**sums)


def overdraw(splats: Splats, cameras: Cameras, progress: Progress = silent) -> float:
    """Return the mean number of Gaussians per pixel with α ≥ 1/255, hidden ones included: what viewers draw.

    At most 2,348 count in one pixel.

    >>> from g2ard.scene.cameras import Camera, Cameras
    >>> walls = Splats.create(np.eye(3), scales=np.full((3, 3), 9), logit_opacities=[9] * 3)
    >>> overdraw(walls, Cameras.of([Camera.facing([0, -30, 0], [0, 0, 0], width=32, height=24, fov=10)]))
    3.0
    """
    # comes after the test, so that light is never used up
    faint = RasterSettings(alpha_max=1 / 255)
    seen = visibility(splats, cameras, progress, settings=faint)
    return float(seen.hits.sum() / cameras.pixels.sum())


def visibility_source(
    cameras: Cameras, *, longest: int = LONGEST, progress: Progress = silent
) -> _Sampler:
    """Return a function that samples a scene's visibility from a few small renders, for `simplify`.

    Views are rendered in rounds of sixteen until a round finds under 1 % more of the Gaussians, and at least
    while Gaussians × views are few: 32 views for an object of half a million, 80 for a small one, all for a
    room (decision 0007). The first scene fixes the views for later ones, so that sums are comparable.
    Results do not depend on the order of the scene's rows.

    Args:
        cameras: the views; at most 96 usual ones are used, evenly spaced, and at most 32 of other kinds,
            which together weigh a twentieth of the usual ones. Without usual views, all are equal.
        longest: longer side of the renders, pixels; `pixel_size` refers to the full image.

    Returns:
        scene → `SampledVisibility`, with the attribute `views`, the usual views at this size. A
        `g2ard.scene.prepared.PreparedScene` is not sorted again.
    """
    return _Sampler(cameras, longest, progress)


def usual_and_others(cameras: Cameras) -> tuple[Cameras, Cameras]:
    """Return the usual views, or all if no kind is usual, and those of other kinds."""
    every = np.arange(len(cameras))
    usual = np.array(rows_by_kind(cameras.kinds).get(USUAL, every))
    other = np.setdiff1d(every, usual)
    some = evenly_spaced(len(other), _OTHER_VIEWS)
    return cameras.take(usual), cameras.take(other[some])


def weight_of_others(usual: int, others: int) -> float:
    """Return the weight of a view of another kind among some usual views."""
    if not others:
        return 0.0
    return _OTHER_SHARE * usual / others


class _Sampler:
    """Function of `visibility_source`: usual `views`, of which it renders the rounds `used`, and `others`."""

    def __init__(
        self,
        cameras: Cameras,
        longest: int,
        progress: Progress,
    ) -> None:
        usual, others = usual_and_others(cameras)
        self.others = others.resized(longest)
        full = take_evenly(usual, MOST_VIEWS)
        self.views = full.resized(longest)
        self.shrunk = np.float32((self.views.widths / full.widths).mean())
        self.used: list[range] | None = None  # until the first scene decides it
        self.settings = RasterSettings()
        self.progress = progress

    def __call__(self, scene: Splats) -> SampledVisibility:
        core = as_prepared(scene).core
        sums = _core.VisibilityAccumulator(core)
        here = self.views.recentred(scene.offset)
        if self.used is None:
            distance = np.median(np.linalg.norm(here.positions - core.origin, axis=1))
            self.settings = RasterSettings(
                antialiased=scene.antialiased, near=NEAR * float(distance) or None
            )
            self.used = add_until_converged(
                lambda views: self._add(sums, here, views),
                len(here),
                len(scene),
                free=_FREE_GAUSSIAN_VIEWS,
            )
        else:
            for views in self.used:
                self._add(sums, here, views)
        weight, pixel_size = sums.by_row()
        if len(self.others):
            rendered = sum(map(len, self.used))
            sums = _core.VisibilityAccumulator(core)
            self._add(
                sums,
                self.others.recentred(scene.offset),
                range(len(self.others)),
            )
            weight += np.float32(weight_of_others(rendered, len(self.others))) * sums.by_row()[0]
        return SampledVisibility(weight, pixel_size * self.shrunk)

    def _add(
        self,
        sums: _core.VisibilityAccumulator,
        cameras: Cameras,
        views: range,
    ) -> int:
        """Add a round of views; return the number of Gaussians seen so far."""
        made = [view_of(cameras, i, self.settings) for i in views]
        return sums.add(made, self.settings, counter(self.progress, "visibility"))


def add_until_converged(
    add: Callable[[range], int],
    count: int,
    rows: int,
    *,
    free: int = 0,
) -> list[range]:
    """Add rounds of views until one finds few new Gaussians; return those that were added.

    Args:
        add: adds some of `count` views, and returns how many of `rows` Gaussians were seen so far.
        free: Gaussians × views up to which rounds are added without need.
    """
    apart = max(1, math.ceil(count / ROUND))
    rounds = list[range]()
    seen = 0
    for first in spread(apart):
        rounds.append(range(first, count, apart))
        before = seen
        seen = add(rounds[-1])
        converged = len(rounds) > 1 and seen - before < CONVERGED * rows
        if converged and len(rounds) * ROUND * rows >= free:
            break
    return rounds


def spread(count: int) -> list[int]:
    """Order 0 … count − 1 so that neighbours in the order are far apart.

    >>> spread(6)
    [0, 3, 1, 4, 2, 5]
    """
    order = [0] * count
    half = (count + 1) // 2
    order[::2] = range(half)
    order[1::2] = range(half, count)
    return order
