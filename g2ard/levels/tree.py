"""One binary kd-tree over all levels of a scene: a viewer loads its leaves, each at a level of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError, require
from g2ard.splats import Splats
from g2ard.stages.recover.anchors import rotation_matrices

__all__ = ["Cut", "Leaf", "Node", "cut"]

Float = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Cut:
    """When a node is split: it holds more than `most` Gaussians of all levels, or it is wider than `extent`
    and holds more than `least`. The defaults are those of PlayCanvas' writer.

    Args:
        most: Gaussians of a leaf; also about what one file holds.
        extent: longest side of the box of a leaf's means, scene units.
        least: Gaussians below which a wide node stays whole: sky and floaters would be thousands of leaves.

    Raises:
        InputError: a value out of range.
    """

    most: int = 512 * 1024
    extent: float = 16.0
    least: int = 8 * 1024

    def __post_init__(self) -> None:
        require("most", self.most, self.most >= 1, "at least 1")
        require("extent", self.extent, self.extent > 0, "more than 0")
        require("least", self.least, self.least >= 1, "at least 1")


@dataclass(frozen=True, eq=False)
class Leaf:
    """A part of space.

    Args:
        low, high: (3,) float64 box about all its Gaussians to one standard deviation, relative to the offset.
        rows: of each level the rows that lie here, maybe none.
    """

    low: Float
    high: Float
    rows: tuple[Rows, ...]


@dataclass(frozen=True, eq=False)
class Node:
    """Two parts of space, and the box of both."""

    low: Float
    high: Float
    children: tuple[Node | Leaf, Node | Leaf]

    def leaves(self) -> Iterator[Leaf]:
        """All below, in the order of the tree."""
        for child in self.children:
            if isinstance(child, Leaf):
                yield child
            else:
                yield from child.leaves()


def cut(levels: Sequence[Splats], rule: Cut | None = None) -> Node | Leaf:
    """Cut space at medians of the means of all levels, along the longer side of their box.

    Args:
        levels: the same scene, the finest first, all of one offset.
        rule: when to split; None means `Cut()`.

    Returns:
        The tree; a leaf alone where nothing is split.

    Raises:
        InputError: no level, an empty one, or offsets that differ.

    >>> fine = Splats.create([[0, 0, 0], [9, 0, 0]], scales=[[1, 1, 2]] * 2)
    >>> tree = cut([fine, fine.take([0])], Cut(most=2))
    >>> [[len(rows) for rows in leaf.rows] for leaf in tree.leaves()], tree.low.tolist(), tree.high.tolist()
    ([[1, 0], [1, 1]], [-1.0, -1.0, -2.0], [10.0, 1.0, 2.0])
    """
    if not levels or not all(len(level) for level in levels):
        raise InputError("levels: expected at least one, and none of them empty")
    if any((level.offset != levels[0].offset).any() for level in levels):
        raise InputError("levels: their offsets differ")
    means = np.concatenate([level.means for level in levels]).astype(np.float64)
    reach = np.concatenate([_reach(level) for level in levels])
    starts = np.cumsum([0, *(len(level) for level in levels)])
    return _Tree(means, means - reach, means + reach, starts, rule or Cut()).of(np.arange(len(means)))


def _reach(splats: Splats) -> Float:
    """(N, 3) half sides of the box about each Gaussian's own: |R|·s."""
    frames = rotation_matrices(splats.quats)
    return np.einsum("nij,nj->ni", np.abs(frames), splats.scales.astype(np.float64))


@dataclass(frozen=True, eq=False)
class _Tree:
    means: Float
    lows: Float
    highs: Float
    starts: Rows
    rule: Cut

    def of(self, rows: Rows) -> Node | Leaf:
        means = self.means[rows]
        sides = np.ptp(means, axis=0)
        wide = sides.max() > self.rule.extent and len(rows) > self.rule.least
        if len(rows) < 2 or not (wide or len(rows) > self.rule.most):
            return self._leaf(np.sort(rows))
        order = rows[np.argsort(means[:, sides.argmax()], kind="stable")]
        middle = len(order) // 2
        one, other = self.of(order[:middle]), self.of(order[middle:])
        return Node(np.minimum(one.low, other.low), np.maximum(one.high, other.high), (one, other))

    def _leaf(self, rows: Rows) -> Leaf:
        ends = np.searchsorted(rows, self.starts)
        parts = [rows[a:b] - start for a, b, start in zip(ends, ends[1:], self.starts, strict=False)]
        return Leaf(self.lows[rows].min(axis=0), self.highs[rows].max(axis=0), tuple(parts))
