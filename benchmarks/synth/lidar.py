"""Laser scan: first hits of rays from scanners along every street and from flight lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.synth.layout import Layout
from benchmarks.synth.shapes import Float, cast

__all__ = ["PART", "Returns", "scan"]

_SPACING = 12.0
"""Distance between scanner positions, metres."""
_MAST = 2.4
_FLIGHT = 130.0
_STREET_RANGE = 120.0
_AERIAL_SHARE = 0.4
_RAYS = 5000
"""Minimum rays per position; thin clouds use fewer positions."""
_LEAST = 12
"""Minimum rays per position in any case."""
_PACKET = 128, 512
"""Minimum and maximum rays per packet; a position has about forty packets."""
_SQUARE = 2.5
"""Ratio of packets per full turn to packets in elevation."""
PART = 2_000_000
"""Maximum returns in memory; a larger cloud is several scans from interleaved positions."""


@dataclass(frozen=True, eq=False)
class Returns:
    """n laser returns before noise.

    Args:
        origins: (3, n) origins of rays.
        directions: (3, n) unit directions.
        ranges: (n,) distances to the first surface, metres.
        primitives: (n,) indices of surfaces.
    """

    origins: Float
    directions: Float
    ranges: Float
    primitives: NDArray[np.int64]

    def take(self, index: NDArray[np.int64]) -> Returns:
        return Returns(
            self.origins[:, index],
            self.directions[:, index],
            self.ranges[index],
            self.primitives[index],
        )


def _stations(layout: Layout) -> tuple[Float, Float]:
    """Return (n, 3) scanner positions on streets and (m, 3) on flight lines."""
    street: list[Float] = []
    flight: list[Float] = []
    for axis in (0, 1):
        end = layout.reach[1 - axis] + 10.0
        along = np.linspace(-end, end, max(2, int(2 * end / _SPACING) + 1))
        across = layout.streets(axis)
        lines = np.linspace(-layout.reach[axis] - 20, layout.reach[axis] + 20, layout.blocks + 3)
        for height, at, out in ((_MAST, across, street), (_FLIGHT, lines, flight)):
            grid = np.stack(np.meshgrid(at, along, indexing="ij"), -1).reshape(-1, 2)
            grid = grid if axis == 0 else grid[:, ::-1]
            out.append(np.column_stack([grid, np.full(len(grid), height)]))
    return np.concatenate(street), np.concatenate(flight)


def _spin(rng: Generator, count: int) -> Float:
    """Return (3, count) directions of a spinning scanner, denser near the horizon, sorted by sector."""
    turn = (np.arange(count) + rng.random(count)) / count * 2 * np.pi
    lift = 2 * rng.random(count) - 1
    angle = np.deg2rad(np.where(lift > 0, 75.0, 50.0)) * np.sign(lift) * np.abs(lift) ** 1.6
    return np.stack([np.cos(turn) * np.cos(angle), np.sin(turn) * np.cos(angle), np.sin(angle)])


def _swath(rng: Generator, count: int) -> Float:
    """Return (3, count) downward directions within 35° of the vertical, sorted by sector."""
    turn = (np.arange(count) + rng.random(count)) / count * 2 * np.pi
    off = np.tan(np.deg2rad(35.0)) * np.sqrt(rng.random(count))
    d = np.stack([np.cos(turn) * off, np.sin(turn) * off, np.full(count, -1.0)])
    return d / np.linalg.norm(d, axis=0)


def _fire(layout: Layout, rng: Generator, stations: Float, rays: int, aerial: bool) -> Returns:
    """Return the first hits of about `rays` rays shared among the stations."""
    count = int(np.clip(rays // _RAYS, min(8 * layout.blocks, len(stations)), len(stations)))
    stations = stations[((np.arange(count) + rng.random()) * len(stations) / count).astype(int)]
    each = max(_LEAST, -(-rays // count))
    parts = []
    for at in stations:
        origin = (at + rng.normal(0.0, 0.3, 3) * [1.0, 1.0, 0.2])[:, None]
        d = _swath(rng, each) if aerial else _spin(rng, each)
        far = np.inf if aerial else _STREET_RANGE
        t, hit = _cast_in_patches(layout, origin, d, far)
        found = np.flatnonzero(hit >= 0)
        parts.append(
            Returns(np.broadcast_to(origin, (3, len(found))), d[:, found], t[found], hit[found])
        )
    return Returns(
        np.concatenate([p.origins for p in parts], 1),
        np.concatenate([p.directions for p in parts], 1),
        np.concatenate([p.ranges for p in parts]),
        np.concatenate([p.primitives for p in parts]),
    )


def _cast_in_patches(
    layout: Layout, origin: Float, d: Float, far: float
) -> tuple[Float, NDArray[np.int64]]:
    """Return the first hits of rays sorted by azimuth, cast in packets narrow in azimuth and elevation.

    A packet tests all primitives that its bounds may hit; a single ray into the sky prevents early stops.
    """
    n = d.shape[1]
    packet = int(np.clip(n // 40, *_PACKET))
    sector = packet * max(1, round(float(np.sqrt(n / packet / _SQUARE))))
    order = np.concatenate(
        [i + np.argsort(d[2, i : i + sector], kind="stable") for i in range(0, n, sector)]
    )
    t, hit = np.empty(n), np.empty(n, np.int64)
    t[order], hit[order] = cast(layout.shapes, origin, d[:, order], far=far, packet=packet)
    return t, hit


def scan(layout: Layout, count: int, seed: int) -> Iterator[Returns]:
    """Yield exactly `count` returns in parts of at most `PART`, each from the streets, then from the air."""
    street, flight = _stations(layout)
    parts = min(-(-count // PART), len(street), len(flight))
    for part in range(parts):
        share = count * (part + 1) // parts - count * part // parts
        aerial = int(share * _AERIAL_SHARE)
        seeds = [part] if parts > 1 else []
        yield from _survey(layout, street[part::parts], share - aerial, [seed, 1, 0], seeds)
        yield from _survey(layout, flight[part::parts], aerial, [seed, 1, 1], seeds)


def _survey(
    layout: Layout, stations: Float, wanted: int, seed: list[int], part: list[int]
) -> Iterator[Returns]:
    got, rays, attempt = 0, int(wanted * 1.3) + len(stations), 0
    while got < wanted:
        rng = np.random.default_rng([*seed, attempt, *part])
        returns = _fire(layout, rng, stations, rays, aerial=seed[-1] == 1)
        found = len(returns.ranges)
        keep = min(found, wanted - got)
        yield returns.take(np.sort(rng.permutation(found)[:keep]))
        got += keep
        rays, attempt = int((wanted - got) * 1.6) + len(stations), attempt + 1
