"""Places from which a scene was looked at: each Gaussian votes for those that show it at a pixel or more.

Trainers split Gaussians until they cover a pixel or two in the nearest photos, and scanned points are as fine
as the scanner was near. So a Gaussian with a standard deviation σ was looked at from within σ·f, where f is
the focal length in pixels. A sky's Gaussians grow with their distance, and vote for the same places as the
rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from g2ard.arrays import Float, Mask
from g2ard.scene.reproducible import (
    along,
    directions,
    fibonacci,
    halton,
    middle,
    norms,
    positive,
    quantile,
)
from g2ard.system.cached import cached_property

_FOCAL = 858.0
"""Pixels: focal length of views 800 pixels and 50° wide."""

_VOTERS = 4096
"""Gaussians that vote."""

_PLACES = 1024
"""Places that voters are asked about."""

_CLOSE = 4.0
"""Power of the share of a Gaussian's reach at which a place is tried: most are close, where matter is."""

_WINNING = 0.02
"""Votes below the most with which a place still is among the best."""

_CENTRAL = 1 / 8
"""Share of the best places, nearest to matter, that make the centre."""

_GAP = 2.0
"""Factor of distance that a gap spans."""

_EMPTY = 0.005
"""Share of the scene within a gap, at most."""

_FITTING = 0.97
"""Share of the weight that a view from outside has in frame."""

_AWAY = 2.4
"""Distance of such a view in radii of that share."""

_EYES = 32
"""Number of such views per hypothesis."""

_FEWEST = 64
"""Fewest voters that are near."""

_LEAST = 0.05
"""Least share of the scene that is near."""

_LOST = 0.05
"""Largest share of the scene that lies beyond and is below a pixel from around what is near."""

_WORSE_FACTOR = 1.5
"""Factor on the share that is lost with which a wider hypothesis is as good. A limit on the difference alone
would let a sky of nine tenths of the rows decide."""

_WORSE = 0.01
"""Addition to this share."""

_CLOSED = 0.3
"""Share of the directions that a sky fills: half of a dome and more."""

_WAYS = fibonacci(64)
"""Directions in which a sky may hide what it surrounds."""


@dataclass(frozen=True, eq=False)
class Votes:
    """Gaussians that vote.

    Args:
        points: (N, 3) means.
        reach: (N,) distances within which they cover a pixel.
        weights: (N,) weights, with a sum of 1.
        faces: (N,) opaque areas of the Gaussians that each stands for.
    """

    points: Float
    reach: Float
    weights: Float
    faces: Float

    @classmethod
    def of(
        cls,
        points: Float,
        sizes: Float,
        opacities: Float,
        represents: float = 1.0,
    ) -> Votes:
        """Let the first `_VOTERS` rows vote, of which each row stands for some Gaussians."""
        count = len(points)
        points = points[:_VOTERS]
        sizes = sizes[:_VOTERS]
        opacities = opacities[:_VOTERS]
        represents *= count / len(points)
        return cls(
            points=points,
            reach=_FOCAL * sizes,
            weights=opacities / max(float(opacities.sum()), 1e-30),
            faces=represents * 2 * np.pi * np.square(sizes) * opacities,
        )

    def at(self, places: Float) -> Float:
        """Return (P,) shares of the scene that cover a pixel seen from each place, if nothing hides them."""
        return np.array([self.weights[self._sees(place)].sum() for place in places])

    def _sees(self, place: Float) -> Mask:
        return norms(self.points - place) <= self.reach

    @cached_property
    def centre(self) -> Float:
        """(3,) the middle of the places with the most votes and the least mean logarithm of the distances.

        Where all is coarse, votes alone leave it open, and the middle of a dome has as many as its floor.
        """
        which, far, turn, height = halton(0, _PLACES, 4, 0).T
        rows = (which * len(self.points)).astype(int)
        z = 2 * height - 1
        level = np.sqrt(1 - np.square(z))
        ways = directions(turn, level, z)  # even on the sphere
        away = self.reach[rows] * far**_CLOSE
        places = self.points[rows] + away[:, None] * ways
        votes = self.at(places)
        best = places[votes >= votes.max() - _WINNING]
        logs = []
        for place in best:
            distances = positive(norms(self.points - place))
            logs.append((self.weights * np.log(distances)).sum())
        order = np.argsort(logs, kind="stable")
        central = max(1, round(_CENTRAL * len(best)))
        return middle(best[order[:central]])

    @cached_property
    def distances(self) -> Float:
        """(N,) distances from `centre`."""
        return norms(self.points - self.centre)

    @cached_property
    def radius(self) -> float:
        """Distance from `centre` within which matter is near; inf if all of it is.

        There is a hypothesis for each gap in the distances, and one for the whole scene: that people look at
        what is within, from around it. Rows beyond may be below a pixel from there only if they are few. Of
        these hypotheses the widest is returned that hardly loses more than the best one: rows are lost below
        a pixel, or behind a sky.
        """
        gaps = self._gaps()
        losses: dict[float, float] = {}
        for radius in [*gaps, np.inf]:
            if self._lost_beyond(radius) <= _LOST:
                below_a_pixel = float((1 - self.at(self._around(radius))).mean())
                losses[radius] = below_a_pixel + self._hidden(gaps, radius)
        most = _WORSE_FACTOR * min(losses.values()) + _WORSE
        return max(radius for radius, loss in losses.items() if loss <= most)

    @cached_property
    def horizon(self) -> float:
        """Distance from `centre` at which a sky begins; inf if none surrounds what is near."""
        beyond = self.distances[self.distances > self.radius]
        if len(beyond) and self._closed(self.radius) > _CLOSED:
            return float(beyond.min())
        return np.inf

    def _hidden(self, gaps: list[float], radius: float) -> float:
        """Return the largest share of the scene that a sky within a radius surrounds and hides."""
        largest = 0.0
        for gap in gaps:
            if gap < radius:
                inside = self.weights[self.distances <= gap].sum()
                largest = max(largest, inside * self._closed(gap))
        return largest

    def _closed(self, radius: float) -> float:
        """Return the share of the directions from `centre` in which matter beyond a radius stops light."""
        beyond = self.distances > radius
        away = self.points[beyond] - self.centre
        angles = self.faces[beyond] / np.square(self.distances[beyond])  # solid angles
        cosines = np.stack([along(away, axis) for axis in _WAYS])
        nearest_way = np.argmax(cosines, axis=0)
        total = np.bincount(nearest_way, weights=angles, minlength=len(_WAYS))
        depth = total * len(_WAYS) / (4 * np.pi)  # optical depth along each way
        return float((1 - np.exp(-depth)).mean())

    def _gaps(self) -> list[float]:
        """Return the distances at which gaps begin."""
        order = np.argsort(self.distances, kind="stable")
        far = self.distances[order]
        total = np.append(0.0, np.cumsum(self.weights[order]))
        upto = total[1:]  # the weight up to each row
        beyond = np.searchsorted(far, _GAP * far, side="right")
        empty = total[beyond] - upto < _EMPTY
        empty &= upto > _LEAST  # the first rows are few anywhere
        empty[: _FEWEST - 1] = False
        empty[beyond == len(far)] = False  # nothing lies beyond the gap
        is_last = ~np.append(empty[1:], False)  # a gap begins at the last row before it
        return far[empty & is_last].tolist()

    def _around(self, radius: float) -> Float:
        """Return places around what is within a radius, from which it fits the frame."""
        within = self.distances <= radius
        fitting = quantile(
            self.distances[within],
            self.weights[within],
            _FITTING,
        )
        return self.centre + _AWAY * fitting * fibonacci(_EYES)

    def _lost_beyond(self, radius: float) -> float:
        """Return the share of the scene that lies beyond a radius and covers no pixel from around it."""
        beyond = self.distances > radius
        lost = []
        for eye in self._around(radius):
            unseen = beyond & ~self._sees(eye)
            lost.append(self.weights[unseen].sum())
        return float(np.mean(lost))
