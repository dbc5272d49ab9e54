"""Layout of the city: blocks on a street grid, with houses, perimeter buildings, towers and parks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.synth.shapes import Float, Kind, Shapes

__all__ = ["CURB", "PITCH", "ROAD", "Layout", "Material", "plan"]

PITCH = (72.0, 58.0)
"""Distance between street centres along x and y, metres."""
ROAD = 5.0
"""Half the width of a carriageway, metres: a lane and a parking strip."""
PAVEMENT = 3.0
CURB = 0.15
MARGIN = 45.0
"""Ground beyond the outermost street, metres."""

Colour = Sequence[float] | Float

_WALLS = (
    (0.78, 0.70, 0.56),
    (0.66, 0.36, 0.28),
    (0.86, 0.83, 0.76),
    (0.60, 0.58, 0.55),
    (0.80, 0.62, 0.38),
    (0.55, 0.62, 0.66),
    (0.72, 0.50, 0.42),
    (0.84, 0.77, 0.60),
)
_ROOFS = ((0.62, 0.30, 0.22), (0.50, 0.26, 0.20), (0.36, 0.37, 0.40), (0.45, 0.33, 0.26))
_CARS = (
    (0.75, 0.12, 0.10),
    (0.12, 0.22, 0.50),
    (0.88, 0.88, 0.88),
    (0.18, 0.18, 0.20),
    (0.55, 0.57, 0.60),
    (0.20, 0.42, 0.25),
    (0.85, 0.65, 0.15),
)


class Material(IntEnum):
    """Materials of primitives, with a function each in `paint`."""

    GROUND = 0
    # pavement round a lot: parameter 0 is 1 for grass within, 1 is 1 where paths cross it
    BLOCK = 1
    FACADE = 2  # window pitch, storey height, window width and height as shares, brick
    TILES = 3
    LEAVES = 4
    PLAIN = 5


@dataclass
class _Builder:
    kinds: list[int] = field(default_factory=list)
    lo: list[Colour] = field(default_factory=list)
    hi: list[Colour] = field(default_factory=list)
    materials: list[int] = field(default_factory=list)
    colours: list[Colour] = field(default_factory=list)
    parameters: list[Colour] = field(default_factory=list)

    def add(
        self,
        kind: Kind,
        lo: Colour,
        hi: Colour,
        colour: Colour,
        material: Material = Material.PLAIN,
        parameters: Colour = (),
    ) -> None:
        self.kinds.append(kind)
        self.lo.append(lo)
        self.hi.append(hi)
        self.materials.append(material)
        self.colours.append(colour)
        self.parameters.append((*parameters, *[0.0] * (5 - len(parameters))))

    def around(
        self,
        kind: Kind,
        center: Colour,
        half: Colour,
        colour: Colour,
        material: Material = Material.PLAIN,
    ) -> None:
        """Add a shape by its centre in x and y, its foot in z, its half widths and its height."""
        x, y, foot = center
        a, b, height = half
        self.add(kind, (x - a, y - b, foot), (x + a, y + b, foot + height), colour, material)


@dataclass(frozen=True, eq=False)
class Layout:
    """Primitives of a city and their materials; metres, z up, centre at the origin, ground at 0.

    Args:
        shapes: P primitives.
        materials: (P,) `Material`.
        colours: (P, 3) float32 base colours.
        parameters: (P, 5) float32 parameters of the materials.
        blocks: blocks per side.
    """

    shapes: Shapes
    materials: NDArray[np.int64]
    colours: NDArray[np.float32]
    parameters: NDArray[np.float32]
    blocks: int

    def streets(self, axis: int) -> Float:
        """Return the coordinates along `axis` of the centre lines of streets that cross it."""
        return (np.arange(self.blocks + 1, dtype=np.float64) - self.blocks / 2) * PITCH[axis]

    @property
    def reach(self) -> Float:
        """The (2,) half extent up to the outermost street centres."""
        return np.array(PITCH) * self.blocks / 2


def _pick(rng: Generator, items: Sequence[Colour], jitter: float = 0.05) -> Float:
    base = np.asarray(items[int(rng.random() * len(items))])
    shift = jitter * (2 * rng.random() - 1) + 0.4 * jitter * (2 * rng.random(3) - 1)
    return np.clip(base + shift, 0.02, 0.95).astype(np.float64)


def _tree(b: _Builder, rng: Generator, x: float, y: float, foot: float) -> None:
    size = 0.75 + 0.6 * rng.random()
    green = np.array([0.33, 0.41, 0.21]) + (rng.random(3) - 0.5) * [0.16, 0.10, 0.08]
    trunk = 2.2 * size
    b.around(
        Kind.CYLINDER, (x, y, foot), (0.16 * size, 0.16 * size, trunk + size), (0.33, 0.24, 0.17)
    )
    if rng.random() < 0.2:
        for k in range(3):
            r = (1.7 - 0.45 * k) * size
            at = (x, y, foot + trunk * 0.6 + 1.5 * k * size)
            b.around(Kind.CONE, at, (r, r, 2.6 * size), green * [0.7, 0.8, 1.0], Material.LEAVES)
        return
    for k in range(6):
        turn = 2 * np.pi * (k / 5 + 0.15 * rng.random())
        out = 0.0 if k == 5 else (0.8 + 0.5 * rng.random()) * size
        r = (1.5 if k == 5 else 0.9 + 0.4 * rng.random()) * size
        tall = r * (1.7 if k == 5 else 1.4 + 0.4 * rng.random())
        at = (
            x + out * np.cos(turn),
            y + out * np.sin(turn),
            foot + trunk * (0.8 + 0.4 * rng.random()),
        )
        b.around(
            Kind.ELLIPSOID, at, (r, r, tall), green * (0.9 + 0.2 * rng.random()), Material.LEAVES
        )


def _lamp(b: _Builder, x: float, y: float, towards: Float) -> None:
    b.around(Kind.CYLINDER, (x, y, CURB), (0.09, 0.09, 6.2), (0.30, 0.32, 0.33))
    arm = np.array([x, y]) + 0.8 * towards
    b.around(Kind.BOX, (*arm, 6.2), (*(0.12 + 0.75 * np.abs(towards)), 0.12), (0.30, 0.32, 0.33))
    b.around(Kind.BOX, (*(arm + 0.6 * towards), 6.1), (0.25, 0.25, 0.14), (0.92, 0.90, 0.80))


def _car(b: _Builder, rng: Generator, x: float, y: float, along: int) -> None:
    colour = _pick(rng, _CARS, 0.03)
    length, width = 2.05 + 0.3 * rng.random(), 0.86

    def sides(a: float, c: float) -> tuple[float, float]:
        return (a, c) if along == 0 else (c, a)

    b.around(Kind.BOX, (x, y, 0.28), (*sides(length, width), 0.62), colour)
    b.around(Kind.BOX, (x, y, 0.90), (*sides(length * 0.55, width * 0.9), 0.45), (0.13, 0.16, 0.19))
    b.around(Kind.BOX, (x, y, 1.35), (*sides(length * 0.5, width * 0.86), 0.06), colour)
    for k in (-0.62, 0.62):
        wheel = np.array([x, y]) + np.array(sides(k * length, 0.0))
        b.around(Kind.BOX, (*wheel, 0.0), (*sides(0.32, width + 0.02), 0.6), (0.07, 0.07, 0.08))


def _building(b: _Builder, rng: Generator, lo: Float, hi: Float, storeys: int, gable: bool) -> None:
    storey = 2.9 + 0.6 * rng.random()
    windows = (
        2.4 + 1.6 * rng.random(),
        storey,
        0.35 + 0.3 * rng.random(),
        0.45 + 0.2 * rng.random(),
    )
    wall = _pick(rng, _WALLS)
    brick = 1.0 if rng.random() < 0.45 else 0.0
    top = CURB + storeys * storey + (0.25 if gable else 0.8)
    b.add(Kind.BOX, (*lo, CURB), (*hi, top), wall, Material.FACADE, (*windows, brick))
    middle, half = (lo + hi) / 2, (hi - lo) / 2
    if gable:
        along_x = half[0] > half[1]
        kind, rise = (Kind.GABLE_X, half[1]) if along_x else (Kind.GABLE_Y, half[0])
        eaves = half + 0.35
        b.around(
            kind, (*middle, top - 0.2), (*eaves, rise * 0.85), _pick(rng, _ROOFS), Material.TILES
        )
        b.around(
            Kind.BOX, (*(middle + half * 0.4), top), (0.35, 0.35, rise * 0.9), (0.50, 0.32, 0.26)
        )
        return
    for _ in range(1 + int(rng.random() * 3)):  # lifts, vents, plant rooms
        at = middle + (rng.random(2) - 0.5) * half
        size = 0.6 + 1.2 * rng.random(2)
        b.around(
            Kind.BOX, (*at, top), (*size, 0.8 + 1.6 * rng.random()), _pick(rng, [(0.6, 0.6, 0.6)])
        )


def _houses(b: _Builder, rng: Generator, lo: Float, hi: Float) -> None:
    columns, rows = 4, 2
    lot = (hi - lo) / [columns, rows]
    for i in range(columns):
        for j in range(rows):
            corner = lo + lot * [i, j]
            size = np.array([8.0, 9.0]) + rng.random(2) * [3.0, 3.0]
            at = corner + lot / 2 + (rng.random(2) - 0.5) * [1.5, 3.0]
            _building(b, rng, at - size / 2, at + size / 2, 1 + int(rng.random() * 2.5), gable=True)
            for _ in range(2):
                x, y = corner + [1.6, 1.8] + rng.random(2) * (lot * [0.0, 1.0] - [0.0, 3.6])
                _tree(b, rng, x, y, CURB)


def _perimeter(b: _Builder, rng: Generator, lo: Float, hi: Float) -> None:
    depth = 12.0
    for row in (0, 1):
        x = lo[0]
        while hi[0] - x > 9.0:
            width = min(11.0 + 8.0 * rng.random(), hi[0] - x)
            if hi[0] - x - width < 9.0:
                width = hi[0] - x
            y = lo[1] if row == 0 else hi[1] - depth
            back = depth - 2.0 * rng.random()
            y0, y1 = (y, y + back) if row == 0 else (y + depth - back, y + depth)
            storeys = 2 + int(rng.random() * 5)
            _building(
                b, rng, np.array([x, y0]), np.array([x + width, y1]), storeys, rng.random() < 0.35
            )
            x += width
    for _ in range(9):
        x, y = lo + [3, depth + 2.5] + rng.random(2) * (hi - lo - [6, 2 * depth + 5])
        _tree(b, rng, x, y, CURB)


def _tower(b: _Builder, rng: Generator, lo: Float, hi: Float) -> None:
    podium = (lo + 5.0, hi - 5.0)
    _building(b, rng, *podium, 1 + int(rng.random() * 2), gable=False)
    roof = b.hi[[i for i, m in enumerate(b.materials) if m == Material.FACADE][-1]][2]
    size = np.array([16.0, 14.0]) + 6 * rng.random(2)
    middle = (lo + hi) / 2 + (rng.random(2) - 0.5) * [12.0, 4.0]
    storeys, storey = 7 + int(rng.random() * 6), 3.2
    corner, opposite = middle - size / 2, middle + size / 2
    windows = (2.0 + rng.random(), storey, 0.72, 0.62, 0.0)
    top = roof + storeys * storey + 0.8
    b.add(
        Kind.BOX,
        (*corner, roof - 0.1),
        (*opposite, top),
        _pick(rng, _WALLS[2:6]),
        Material.FACADE,
        windows,
    )
    b.around(Kind.BOX, (*middle, top), (3.0, 2.4, 2.6), (0.6, 0.6, 0.6))
    b.around(
        Kind.CYLINDER,
        (middle[0] + 1.5, middle[1] + 0.5, top + 2.6),
        (0.08, 0.08, 5.0),
        (0.75, 0.2, 0.15),
    )
    for x in np.arange(lo[0] + 2.5, hi[0] - 2, 6.0):
        for y in (lo[1] + 2.2, hi[1] - 2.2):
            _tree(b, rng, x, y, CURB)


def _park(b: _Builder, rng: Generator, lo: Float, hi: Float) -> None:
    middle = (lo + hi) / 2
    b.around(Kind.CYLINDER, (*middle, CURB), (4.5, 4.5, 0.45), (0.62, 0.60, 0.56))
    b.around(Kind.CYLINDER, (*middle, CURB), (4.1, 4.1, 0.5), (0.24, 0.38, 0.44))
    b.around(Kind.CYLINDER, (*middle, CURB), (0.5, 0.5, 2.2), (0.66, 0.64, 0.60))
    for k in range(34):
        x, y = lo + 2 + rng.random(2) * (hi - lo - 4)
        if np.hypot(*((x, y) - middle)) > 8 and min(abs(x - middle[0]), abs(y - middle[1])) > 3.5:
            _tree(b, rng, x, y, CURB)
        if k % 6 == 0:
            bench = middle + np.array([2.4, 0.0]) + [0.0, (k / 6 - 2.5) * 5 or 7.0]
            b.around(Kind.BOX, (*bench, CURB), (0.3, 0.9, 0.45), (0.45, 0.30, 0.18))


def _furnish(b: _Builder, rng: Generator, lo: Float, hi: Float) -> None:
    """Add trees, lamps and parked cars along the four sides of a block."""
    for axis in (0, 1):
        for edge, inwards in ((lo[1 - axis], 1.0), (hi[1 - axis], -1.0)):

            def place(
                s: float,
                inset: float,
                axis: int = axis,
                edge: float = edge,
                inwards: float = inwards,
            ) -> tuple[float, float]:
                across = edge + inwards * inset
                return (s, across) if axis == 0 else (across, s)

            towards = np.array([0.0, -inwards] if axis == 0 else [-inwards, 0.0])
            for k, s in enumerate(np.arange(lo[axis] + 4.0, hi[axis] - 3.5, 8.0)):
                if k % 3 == 1:
                    _lamp(b, *place(s, 0.6), towards)
                elif rng.random() < 0.75:
                    _tree(b, rng, *place(s + rng.random() - 0.5, 1.0), CURB)
            for s in np.arange(lo[axis] + 5.0, hi[axis] - 5.0, 5.8):
                if rng.random() < 0.5:
                    _car(b, rng, *place(s + 0.6 * rng.random(), -1.1), axis)


def _outskirts(b: _Builder, rng: Generator, reach: Float) -> None:
    """Add trees and a few houses beyond the outermost streets."""
    total = reach + MARGIN
    for _ in range(int(0.006 * 4 * (total.prod() - reach.prod()))):
        at = (2 * rng.random(2) - 1) * (total - 4)
        outside = (np.abs(at) - reach).max()
        if outside > 11:
            _tree(b, rng, at[0], at[1], 0.0)
        elif outside > 9.5 and (np.abs(at) - reach).min() < -8:
            half = np.array([4.5, 4.0]) + rng.random(2)
            away = np.where(np.abs(at) - reach > 0, np.sign(at) * half, 0.0)
            _building(
                b, rng, at + away - half, at + away + half, 1 + int(rng.random() * 2), gable=True
            )


def plan(blocks: int, seed: int) -> Layout:
    """Lay out `blocks` × `blocks` blocks; equal seeds give equal cities."""
    rng = np.random.default_rng([seed, 0])
    b = _Builder()
    reach = np.array(PITCH) * blocks / 2
    total = reach + MARGIN
    b.add(Kind.BOX, (*-total, -1.0), (*total, 0.0), (0.30, 0.30, 0.31), Material.GROUND)
    fillings = [_perimeter, _park, _tower, _houses]
    for i in range(blocks):
        for j in range(blocks):
            lo = np.array([i, j]) * PITCH - reach + ROAD
            hi = lo + np.array(PITCH) - 2 * ROAD
            n = i * blocks + j
            filling = fillings[n] if n < 4 else fillings[int(rng.random() ** 1.5 * 4) % 4]
            park = filling is _park
            grass = park or filling is _houses
            b.add(
                Kind.BOX,
                (*lo, 0.0),
                (*hi, CURB),
                (0.62, 0.60, 0.57),
                Material.BLOCK,
                (float(grass), float(park)),
            )
            filling(b, rng, lo + PAVEMENT, hi - PAVEMENT)
            _furnish(b, rng, lo, hi)
    _outskirts(b, rng, reach)
    return Layout(
        shapes=Shapes(np.array(b.kinds), np.array(b.lo, np.float64), np.array(b.hi, np.float64)),
        materials=np.array(b.materials),
        colours=np.array(b.colours, np.float32),
        parameters=np.array(b.parameters, np.float32),
        blocks=blocks,
    )
