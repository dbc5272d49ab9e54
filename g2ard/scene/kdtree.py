"""kd-tree of tiles: median cuts, and the rows in and around each leaf."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.arrays import Float, Float32, Rows

# standard deviations by which a tile may exceed the count estimated from a sample
_SAMPLE_SIGMAS = 4.0
_HALO_SHARE = 0.03  # margin of a halo as a fraction of a tile's side
# percentiles that bound a box when its sides are measured, to ignore floaters
_BOX_PERCENTILES = 1, 99


@dataclass(frozen=True)
class KdTree:
    """A node: points with `x[axis] < at` are in `below`. A leaf has no children."""

    axis: int = -1
    at: float = 0.0
    below: KdTree | None = None
    above: KdTree | None = None

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        if self.below and self.above:
            return self.below.leaves + self.above.leaves
        return 1

    def boxes(self) -> Float:
        """Return the (leaves, 2, 3) low and high corners, infinite where nothing was cut."""
        if not (self.below and self.above):
            return np.array([[[-np.inf] * 3, [np.inf] * 3]])
        below = self.below.boxes()
        above = self.above.boxes()
        lowest = above[:, 0, self.axis]
        highest = below[:, 1, self.axis]
        np.maximum(lowest, self.at, out=lowest)
        np.minimum(highest, self.at, out=highest)
        return np.concatenate([below, above])

    def route(self, points: Float32, margin: float = 0.0) -> Iterator[tuple[Rows, Rows]]:
        """Yield per leaf, in order, the rows in its box and the rows of other boxes within `margin`.

        A point is within the margin if it lies in the box after all sides move outwards by `margin`.
        """
        core = np.arange(len(points))
        halo = np.empty(0, np.intp)
        columns = tuple(np.ascontiguousarray(points.T))
        yield from self._route(columns, core, halo, margin)

    def _route(
        self,
        columns: tuple[Float32, ...],
        core: Rows,
        halo: Rows,
        margin: float,
    ) -> Iterator[tuple[Rows, Rows]]:
        if not (self.below and self.above):
            yield core, np.sort(halo)
            return
        values = columns[self.axis][core]
        outer = columns[self.axis][halo]
        low = np.float32(self.at - margin)
        high = np.float32(self.at + margin)
        is_left = values < np.float32(self.at)
        near_left = near_right = core[:0]
        if margin > 0:
            near_left = core[~is_left & (values <= high)]
            near_right = core[is_left & (values >= low)]
        halo_left = np.concatenate([halo[outer <= high], near_left])
        halo_right = np.concatenate([halo[outer >= low], near_right])
        yield from self.below._route(columns, core[is_left], halo_left, margin)
        yield from self.above._route(columns, core[~is_left], halo_right, margin)

    def refined(self, parts: dict[int, KdTree]) -> KdTree:
        """Return the tree with some leaves, by number, replaced by trees."""
        numbers = iter(range(self.leaves))

        def build(node: KdTree) -> KdTree:
            if node.below and node.above:
                return KdTree(
                    node.axis,
                    node.at,
                    build(node.below),
                    build(node.above),
                )
            return parts.get(next(numbers), node)

        return build(self)

    def to_json(self) -> Any:
        """Return nested lists [axis, at, below, above], with null for a leaf."""
        if self.below and self.above:
            return [self.axis, self.at, self.below.to_json(), self.above.to_json()]
        return None

    @classmethod
    def from_json(cls, content: Any) -> KdTree:
        """Parse the output of `to_json`."""
        if content is None:
            return cls()
        axis, at, below, above = content
        if axis not in (0, 1, 2) or not np.isfinite(at):
            raise ValueError(f"a cut at {at!r} along {axis!r}")
        return cls(
            int(axis),
            float(at),
            cls.from_json(below),
            cls.from_json(above),
        )


def cut_tree(points: Float32, rows_each: float, most: int) -> KdTree:
    """Cut until no leaf is expected to hold more than `most` rows, unless all its points coincide.

    Each cut is along the longest side, at the quantile that gives both parts whole numbers of tiles. The
    order of the points, which are finite and stand for `rows_each` rows, does not matter.
    """
    parts = parts_of(len(points), rows_each, most)
    if parts == 1 or len(points) < 2:
        return KdTree()
    low, high = np.percentile(points, _BOX_PERCENTILES, axis=0)
    sides = high - low
    spans = np.ptp(points, axis=0)
    for axis in sorted(range(3), key=lambda a: (-sides[a], -spans[a], a)):
        values = np.sort(points[:, axis])
        rank = len(values) * (parts // 2) / parts
        at = _find_between(values, rank)
        if at is not None:
            is_below = points[:, axis] < at
            below = cut_tree(points[is_below], rows_each, most)
            above = cut_tree(points[~is_below], rows_each, most)
            return KdTree(axis, float(at), below, above)
    return KdTree()


def parts_of(points: int, rows_each: float, most: int) -> int:
    """Return the smallest number of equal parts that are expected to hold at most `most` rows each."""
    sigmas = _SAMPLE_SIGMAS if rows_each > 1 else 0.0
    parts = max(1, int(np.ceil(points * rows_each / most)))
    while parts < points:
        points_each = points / parts
        upper = points_each + sigmas * np.sqrt(points_each)
        if upper * rows_each <= most:
            break
        parts += 1
    return parts


def _find_between(values: Float32, rank: float) -> np.float32 | None:
    """Return the value, other than the minimum, whose rank is nearest to `rank`."""
    middle = values[min(int(rank), len(values) - 1)]
    cuts = [
        int(np.searchsorted(values, middle, "left")),
        int(np.searchsorted(values, middle, "right")),
    ]
    cuts = [cut for cut in cuts if 0 < cut < len(values)]
    if not cuts:
        return None
    value: np.float32 = values[min(cuts, key=lambda cut: (abs(cut - rank), cut))]
    return value


def margin_of(tree: KdTree, points: Float32) -> float:
    """Return the margin of halos: 3 % of the tiles' median √(ab), where a and b are the longer sides."""
    if tree.leaves == 1:
        return 0.0
    sizes: list[float] = []
    for core, _ in tree.route(points):
        if not len(core):
            continue
        low, high = np.percentile(points[core], _BOX_PERCENTILES, axis=0)
        _, middle, longest = np.sort(high.astype(np.float64) - low)
        sizes.append(float(np.sqrt(middle * longest)))
    if not sizes:
        return 0.0
    return _HALO_SHARE * float(np.median(sizes))


class Sampler:
    """Sample of points that depends neither on their order nor on the blocks they arrive in.

    It keeps points whose hash is below a limit, and halves the limit when there are too many.
    """

    def __init__(self, count: int, size: int) -> None:
        whole = 1 << 32
        limit = size * whole // max(1, count)
        self.limit = min(whole, max(1, limit))
        self._most = 2 * size
        self._held = 0
        self._points: list[Float32] = []
        self._hashes: list[NDArray[np.uint32]] = []

    def add(self, points: Float32) -> None:
        """Sample from (N, 3) float32 points, skipping points that are not finite."""
        hashes = _hash(points)
        chosen = np.isfinite(points).all(1)
        if self.limit < 1 << 32:
            chosen &= hashes < np.uint32(self.limit)
        self._points.append(points[chosen])
        self._hashes.append(hashes[chosen])
        self._held += len(self._points[-1])
        while self._held > self._most and self.limit > 1:
            self.limit //= 2
            points = np.concatenate(self._points)
            hashes = np.concatenate(self._hashes)
            stay = hashes < np.uint32(self.limit)
            self._points = [points[stay]]
            self._hashes = [hashes[stay]]
            self._held = len(self._points[0])

    def result(self) -> tuple[Float32, float]:
        """Return (n, 3) points, and the number of rows per point."""
        if self._points:
            points = np.concatenate(self._points)
        else:
            points = np.empty((0, 3), np.float32)
        return points, (1 << 32) / self.limit


def _hash(points: Float32) -> NDArray[np.uint32]:
    """Hash each row's bits to (N,) uint32, finished like MurmurHash3."""
    bits = np.ascontiguousarray(points).view(np.uint32)
    x, y, z = bits.T
    h = x * np.uint32(0x9E3779B1)
    h ^= h >> np.uint32(15)
    h = (h + y) * np.uint32(0x85EBCA77)
    h ^= h >> np.uint32(15)
    h = (h + z) * np.uint32(0xC2B2AE3D)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    return h
