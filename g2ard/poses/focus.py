"""Poses from where an open scene is in focus: a trained scene is sharp from where its photos were taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.cameras import Cameras
from g2ard.poses.lattice import halton
from g2ard.poses.numbers import canonical_order, norms, quantile
from g2ard.poses.sight import Lens, Poses, look
from g2ard.poses.site import Site
from g2ard.splats import Splats

__all__ = ["Focus", "Glance", "plan_focus"]

Floats = NDArray[np.float64]

_ROWS = 20_000
"""Gaussians that a glance renders."""

_LONGEST = 96
"""Longer side of its image, pixels."""

_MOST_WIDENED = 4.0
"""A sample's Gaussians grow to cover what the others did, along the two longer axes, at most so much."""

_TRIED = 6
"""Candidates looked at for each pose wanted."""

_COVERED = 0.8
"""Share of the image that the scene covers in a pose worth keeping."""

_PITCHES = (-35.0, 20.0)
"""Degrees above the horizon of the gazes tried."""


@dataclass(frozen=True, eq=False)
class Focus:
    """What glances show, per camera (C,).

    Args:
        covered: mean α of the image.
        typical: median standard deviation of what is seen, weighed by αT, in radians.
        coarse: the 90th percentile of the same: fog, sky and what is too near are coarse.
    """

    covered: Floats
    typical: Floats
    coarse: Floats


class Glance:
    """Small renders of a sample of a scene, sky and floaters included, that tell what is in focus."""

    def __init__(self, splats: Splats) -> None:
        rows = np.flatnonzero(splats.opacities > 1 / 255)
        some = rows[canonical_order(splats, rows)[:_ROWS]]
        sample = splats.take(some[splats.take(some).finite_rows()])
        scales = np.sort(sample.scales.astype(np.float64), axis=1)
        self._sigma = np.sqrt(scales[:, 1] * scales[:, 2])
        self._middle = sample.offset + np.median(sample.means.astype(np.float64), axis=0)
        means = sample.means.astype(np.float64) + sample.offset - self._middle
        widen = min(_MOST_WIDENED, np.sqrt(len(rows) / max(1, len(some))))
        shortest = np.arange(3) == np.argmin(sample.scales, axis=1)[:, None]
        logs = np.log(np.maximum(sample.scales, np.finfo(np.float32).tiny))
        self._means = means
        self._arrays: tuple[NDArray[np.float32], ...] = (
            np.ascontiguousarray(means, np.float32),
            np.ascontiguousarray(sample.quats, np.float32),
            np.ascontiguousarray(np.where(shortest, logs, logs + np.log(widen)), np.float32),
            np.ascontiguousarray(np.clip(sample.logit_opacities, -80, 80), np.float32),
            np.zeros((len(means), 1, 3), np.float32),
            np.zeros((len(means), 0, 3), np.float32),
        )

    def of(self, cameras: Cameras, tell: Callable[[int, int], None], reach: Floats | None = None) -> Focus:
        """Look through each camera; what is farther than `reach`, (C,), is a backdrop and does not count."""
        from g2ard.render import RasterSettings, view_of

        here = cameras.resized(_LONGEST).recentred(self._middle)
        distance = float(np.median(norms(here.positions)))
        settings = RasterSettings(near=1e-3 * distance or None)
        figures = np.zeros((3, len(here)))
        for i in range(len(here)):
            sums: dict[str, Any] = _core.accumulate(
                self._arrays, [view_of(here, i, settings)], settings.choices, None
            )
            weight = sums["weight"]
            depth = norms(self._means - here.positions[i])
            seen = (weight > 0) & (depth <= (np.inf if reach is None else reach[i]))
            figures[0, i] = weight.sum() / (here.widths[i] * here.heights[i])
            figures[1:, i] = np.inf
            if seen.any():
                angle = self._sigma[seen] / np.maximum(depth[seen], np.finfo(float).tiny)
                figures[1:, i] = quantile(angle, weight[seen], [0.5, 0.9])
            tell(i + 1, len(here))
        return Focus(*figures)


def plan_focus(
    site: Site, glance: Glance, count: int, lens: Lens, seed: int, tell: Callable[[int, int], None]
) -> tuple[Poses, Focus]:
    """At most `count` poses in free space whose image the scene fills, the sharpest of those tried.

    Returns:
        The poses and what glances show of them.
    """
    tries = _TRIED * count
    *at, turn, pitch = halton(0, 2 * tries, 5, seed + 2).T
    points = site.box[0] + (site.box[1] - site.box[0]) * np.stack(at, axis=1)
    around = 2 * np.pi * turn
    rise = np.radians(_PITCHES[0] + (_PITCHES[1] - _PITCHES[0]) * pitch)
    gazes = np.stack([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)], axis=1)
    free = site.grid.distance(points) > 3 * site.grid.cell
    poses = Poses(points[free], gazes[free]).take(slice(tries))
    if not len(poses):
        return poses, Focus(*np.zeros((3, 0)))
    near = look(site, poses, lens).close
    poses = poses.take(near > 4 * site.grid.cell)
    found = glance.of(poses.cameras(site, lens), tell) if len(poses) else Focus(*np.zeros((3, 0)))
    rows = np.flatnonzero(found.covered > _COVERED)
    rows = np.sort(rows[np.argsort(found.coarse[rows], kind="stable")[:count]])
    return poses.take(rows), Focus(found.covered[rows], found.typical[rows], found.coarse[rows])
