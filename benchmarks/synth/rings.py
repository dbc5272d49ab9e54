"""Scan of a furnished room by a scanner that turns rings of lasers."""

from __future__ import annotations

import numpy as np

from benchmarks.synth.shapes import Float, Kind, Shapes, cast
from g2ard.io.types import Points

__all__ = ["ring_scan"]

_ROOM = (10.0, 7.0, 3.0)
_STATIONS = ((2.5, 2.0, 1.6), (7.0, 4.5, 1.6))
_FURNITURE = (
    ((4, 3, 0), (5.2, 3.8, 0.9)),
    ((8.5, 0.3, 0), (9.7, 1.2, 2.1)),
    ((1, 5.5, 0), (3, 6.5, 0.5)),
)
_ELEVATIONS = (-40.0, 25.0)
_NOISE = 0.01


def ring_scan(rings: int = 48, turns: int = 1200) -> Points:
    """Scan a room of 10 × 7 × 3 m from two places, with 1 cm of noise along each ray.

    Args:
        rings: lasers, from −40° to 25° of elevation.
        turns: rays of a ring per turn.

    Returns:
        2 · rings · turns points; the ceiling and floor near a scanner have none.

    >>> len(ring_scan(4, 10).positions)
    80
    """
    rng = np.random.default_rng(5)
    up = np.radians(np.linspace(*_ELEVATIONS, rings))[:, None]
    around = np.arange(turns) * 2 * np.pi / turns
    flat = np.cos(up)
    rays = np.stack(
        [flat * np.cos(around), flat * np.sin(around), np.sin(up) + 0 * around]
    ).reshape(3, -1)
    lo, hi = np.array(_FURNITURE, np.float64).swapaxes(0, 1)
    things = Shapes(np.full(len(lo), Kind.BOX), lo, hi)
    room = Shapes(np.full(1, Kind.BOX), np.zeros((1, 3)), np.array([_ROOM]))
    found = []
    for place in _STATIONS:
        origin = np.array(place)[:, None]
        far = np.minimum(cast(things, origin, rays)[0], cast(room, origin, rays)[0])
        found.append((origin + rays * (far + rng.normal(0, _NOISE, far.shape))).T)
    positions = np.concatenate(found)
    return Points(positions, _colours(positions).astype(np.float32))


def _colours(positions: Float) -> Float:
    """Return tiles of 0.5 m under smooth shades, (n, 3) in [0, 1]."""
    tiles = np.floor(positions * 2 + 0.01).sum(axis=1) % 2
    shades = np.sin(positions @ np.array([[1.3, 0.4, 2.1], [0.6, 1.9, 0.8], [1.1, 0.7, 1.7]]))
    return 0.45 + 0.2 * shades + 0.15 * tiles[:, None]
