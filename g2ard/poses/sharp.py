"""Poses from where an open scene looks sharp: a trained scene does from where its photos were taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.poses.lattice import halton
from g2ard.poses.numbers import canonical_order, norms, quantile
from g2ard.poses.sight import Lens, Poses, clearance
from g2ard.poses.site import Site
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

Floats = NDArray[np.float64]

_ROWS, SIGHT_ROWS = 12_000, 24_000
"""Gaussians rendered per glance, and where lines of sight matter."""

_LONGEST = 96
"""Longer side of a glance's image, in pixels."""

_MOST_WIDENED = 4.0
"""Largest factor by which a sample of 12,000 Gaussians grows along the two longer axes, to cover for the
rest; a larger sample may grow more."""

_SOLID = 0.3
"""Least opacity of Gaussians that a view may aim at."""

_TRIED = 8
"""Candidates tried per requested pose, at most."""

_FINE = 0.03
"""Radians: Gaussians with a smaller angular standard deviation are detail; the rest is fog and sky."""

_GOOD = ((0.8, 0.3), (0.7, 0.2), (0.5, 0.1))
"""Least shares of the image that the scene covers, and that detail covers. Poses that pass the first pair
come first; the later pairs fill up if those are too few."""

_COARSEST = 0.9
"""Quantile of the angular sizes seen that `Sharpness.coarse` reports: one tenth may be fog."""

_NEAR = 0.05
"""Near plane as a share of the distance within which matter is close."""

_PITCHES = (-35.0, 20.0)
"""Range of gaze pitches, in degrees above the horizon."""


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Statistics of glances, per camera (C,).

    Args:
        covered: mean α of the image.
        fine: the part of it from Gaussians whose angular standard deviation is under 0.03 rad.
        coarse: 90th percentile, weighted by αT, of the angular standard deviations seen, in radians. Fog, sky
            and matter too close to the camera are coarse.
    """

    covered: Floats
    fine: Floats
    coarse: Floats

    def good(self, covered: float, fine: float) -> NDArray[np.int64]:
        """Return the cameras whose shares exceed both limits."""
        return np.flatnonzero((self.covered > covered) & (self.fine > fine))


class Glance:
    """Small renders of a sample of a scene, sky and floaters included, that measure sharpness and sight.

    Args:
        splats: the scene, or a fair sample of it.
        represents: Gaussians of the scene per row of `splats`.
        limit: largest number of Gaussians to render.
    """

    def __init__(self, splats: Splats, represents: float = 1.0, limit: int = _ROWS) -> None:
        rows = np.flatnonzero(splats.opacities > 1 / 255)
        some = rows[canonical_order(splats, rows)[:limit]]
        sample = splats.take(some[splats.take(some).finite_rows()])
        scales = np.sort(sample.scales.astype(np.float64), axis=1)
        self._sigma = np.sqrt(scales[:, 1] * scales[:, 2])
        self._middle = sample.offset + np.median(sample.means.astype(np.float64), axis=0)
        means = sample.means.astype(np.float64) + sample.offset - self._middle
        most = _MOST_WIDENED * limit / _ROWS
        widen = min(most, np.sqrt(represents * len(rows) / max(1, len(some))))
        shortest = np.arange(3) == np.argmin(sample.scales, axis=1)[:, None]
        logs = np.log(np.maximum(sample.scales, np.finfo(np.float32).tiny))
        self._means, self._antialiased = means, sample.antialiased
        self.points, self.solid = means + self._middle, sample.opacities > _SOLID
        self._arrays: tuple[NDArray[np.float32], ...] = (
            np.ascontiguousarray(means, np.float32),
            np.ascontiguousarray(sample.quats, np.float32),
            np.ascontiguousarray(np.where(shortest, logs, logs + np.log(widen)), np.float32),
            np.ascontiguousarray(np.clip(sample.logit_opacities, -80, 80), np.float32),
            np.zeros((len(means), 1, 3), np.float32),
            np.zeros((len(means), 0, 3), np.float32),
        )

    def of(
        self, cameras: Cameras, tell: Callable[[int, int], None], reach: Floats | None = None
    ) -> Sharpness:
        """Look through each camera; matter beyond `reach`, (C,), counts only towards `covered`."""
        from g2ard.rendering.renderer import RasterSettings, view_of

        if not len(cameras):
            return Sharpness(*np.zeros((3, 0)))
        here = cameras.resized(_LONGEST).recentred(self._middle)
        distance = float(np.median(norms(here.positions)))
        settings = RasterSettings(antialiased=self._antialiased, near=1e-3 * distance or None)
        figures = np.zeros((3, len(here)))
        for i in range(len(here)):
            sums: dict[str, Any] = _core.accumulate(
                self._arrays, [view_of(here, i, settings)], settings, None
            )
            weight = sums["weight"]
            depth = norms(self._means - here.positions[i])
            seen = (weight > 0) & (depth <= (np.inf if reach is None else reach[i]))
            pixels = here.widths[i] * here.heights[i]
            figures[:, i] = weight.sum() / pixels, 0.0, np.inf
            if seen.any():
                angle = self._sigma[seen] / np.maximum(depth[seen], np.finfo(float).tiny)
                fine = weight[seen][angle < _FINE].sum() / pixels
                figures[1:, i] = fine, quantile(angle, weight[seen], _COARSEST)
            tell(i + 1, len(here))
        return Sharpness(*figures)

    def sight(self, cameras: Cameras, aims: NDArray[np.int64], close: float) -> tuple[Floats, Floats]:
        """Return the light from close matter, and how clear the lines of sight are.

        Args:
            cameras: C views.
            aims: (C,) rows of `points` that they look at.
            close: distance within which matter is close, scene units.

        Returns:
            (C,) share of the image that shows close matter, and (C,) mean transmittance in front of the aim.
        """
        from g2ard.rendering.renderer import RasterSettings, view_of

        here = cameras.resized(_LONGEST).recentred(self._middle)
        settings = RasterSettings(antialiased=self._antialiased, near=_NEAR * close)
        murk, clear = np.ones(len(here)), np.zeros(len(here))
        for i, aim in enumerate(aims):
            sums: dict[str, Any] = _core.accumulate(
                self._arrays, [view_of(here, i, settings)], settings, None
            )
            beside = norms(self._means - here.positions[i]) < close
            murk[i] = sums["weight"][beside].sum() / (here.widths[i] * here.heights[i])
            clear[i] = sums["transmittance"][aim] / max(1, sums["hits"][aim])
        return murk, clear


def plan_sharp(
    site: Site,
    glance: Glance,
    count: int,
    lens: Lens,
    seed: int,
    tell: Callable[[int, int], None],
    *,
    also: Poses | None = None,
) -> Poses:
    """Plan at most `count` poses in free space whose image is full and shows detail.

    Args:
        site: the scene, upright.
        glance: renders of the scene.
        count: number of poses.
        lens: lens of the poses.
        seed: seed of the placement.
        tell: called with the number of poses rendered.
        also: poses to try before those anywhere in free space.
    """
    poses = Poses(np.zeros((0, 3)), np.zeros((0, 3))) if also is None else also
    found = glance.of(poses.cameras(site, lens), tell) if len(poses) else Sharpness(*np.zeros((3, 0)))
    for batch in range(_TRIED):
        if len(found.good(*_GOOD[0])) >= count:
            break
        more = _anywhere(site, batch * count, (batch + 1) * count, lens, seed)
        if not len(more):
            continue
        poses = Poses.joined([poses, more])
        seen = glance.of(more.cameras(site, lens), tell)
        found = Sharpness(
            *(np.append(getattr(found, k), getattr(seen, k)) for k in ("covered", "fine", "coarse"))
        )
    rows: list[int] = []
    for least in _GOOD:
        rows += [row for row in found.good(*least).tolist() if row not in rows]
    return poses.take(np.sort(np.array(rows[:count], np.int64)))


def _anywhere(site: Site, start: int, stop: int, lens: Lens, seed: int) -> Poses:
    """Return part of an endless even sequence of poses in free space with nothing close in front."""
    *at, turn, pitch = halton(2 * start, 2 * stop, 5, seed + 2).T
    points = site.box[0] + (site.box[1] - site.box[0]) * np.stack(at, axis=1)
    around = 2 * np.pi * turn
    rise = np.radians(_PITCHES[0] + (_PITCHES[1] - _PITCHES[0]) * pitch)
    gazes = np.stack([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)], axis=1)
    free = site.grid.distance(points) > 3 * site.grid.cell
    poses = Poses(points[free], gazes[free])
    return poses.take(clearance(site, poses, lens) > 4 * site.grid.cell)
