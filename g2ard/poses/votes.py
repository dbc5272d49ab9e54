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
from g2ard.scene.reproducible import along, directions, fibonacci, halton, middle, norms, quantile
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

_WORSE = (1.5, 0.01)
"""Factor on the share that is lost, and addition to it, with which a wider hypothesis is as good. A limit on
the difference alone would let a sky of nine tenths of the rows decide."""

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
    def of(cls, points: Float, sizes: Float, opacities: Float, represents: float = 1.0) -> Votes:
        """Let the first `_VOTERS` rows vote, of which each row stands for some Gaussians."""
        some = slice(_VOTERS)
        represents *= len(points) / len(points[some])
        return cls(
            points=points[some],
            reach=_FOCAL * sizes[some],
            weights=opacities[some] / max(float(opacities[some].sum()), 1e-30),
            faces=represents * 2 * np.pi * np.square(sizes[some]) * opacities[some],
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
        level = np.sqrt(1 - np.square(2 * height - 1))
        places = self.points[rows]
        places = places + (self.reach[rows] * far**_CLOSE)[:, None] * directions(turn, level, 2 * height - 1)
        votes = self.at(places)
        best = places[votes >= votes.max() - _WINNING]
        away = np.array([self._log_distance(place) for place in best])
        order = np.argsort(away, kind="stable")
        return middle(best[order[: max(1, round(_CENTRAL * len(best)))]])

    def _log_distance(self, place: Float) -> float:
        distances = np.maximum(norms(self.points - place), np.finfo(float).tiny)
        return float((self.weights * np.log(distances)).sum())

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
        losses = {
            radius: float((1 - self.at(self._around(radius))).mean()) + self._hidden(gaps, radius)
            for radius in [*gaps, np.inf]
            if self._lost_beyond(radius) <= _LOST
        }
        most = _WORSE[0] * min(losses.values()) + _WORSE[1]
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
        shells = [gap for gap in gaps if gap < radius]
        inside = [float(self.weights[self.distances <= gap].sum()) for gap in shells]
        return max((a * self._closed(gap) for a, gap in zip(inside, shells, strict=True)), default=0.0)

    def _closed(self, radius: float) -> float:
        """Return the share of the directions from `centre` in which matter beyond a radius stops light."""
        beyond = self.distances > radius
        away = self.points[beyond] - self.centre
        faces = self.faces[beyond]
        angles = faces / np.square(self.distances[beyond])
        way = np.argmax(np.stack([along(away, axis) for axis in _WAYS]), axis=0)
        depth = np.bincount(way, weights=angles, minlength=len(_WAYS)) * len(_WAYS) / (4 * np.pi)
        return float((1 - np.exp(-depth)).mean())

    def _gaps(self) -> list[float]:
        """Return the distances at which gaps begin."""
        distances = self.distances
        order = np.argsort(distances, kind="stable")
        far = distances[order]
        total = np.append(0.0, np.cumsum(self.weights[order]))
        beyond = np.searchsorted(far, _GAP * far, side="right")
        empty = total[beyond] - total[1:] < _EMPTY
        empty &= total[1:] > _LEAST  # the first rows are few anywhere
        empty[: _FEWEST - 1] = False
        empty[beyond == len(far)] = False  # nothing lies beyond the gap
        return far[empty & ~np.append(empty[1:], False)].tolist()

    def _around(self, radius: float) -> Float:
        """Return places around what is within a radius, from which it fits the frame."""
        within = self.distances <= radius
        away = _AWAY * float(quantile(self.distances[within], self.weights[within], _FITTING))
        return self.centre + away * fibonacci(_EYES)

    def _lost_beyond(self, radius: float) -> float:
        """Return the share of the scene that lies beyond a radius and covers no pixel from around it."""
        beyond = self.distances > radius
        return float(np.mean([self.weights[beyond & ~self._sees(eye)].sum() for eye in self._around(radius)]))
