"""One binary kd-tree over all levels of a scene; a viewer loads each leaf at a level of its choice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from g2ard.arrays import Float, Int, Values
from g2ard.config.checks import AtLeastOne, Positive
from g2ard.config.schema import Settings
from g2ard.errors import InputError
from g2ard.io.packing import rounding
from g2ard.io.tile_store import TileStore
from g2ard.scene.splats import Splats, check_finite
from g2ard.scene.transform import rotation_matrices

Level = Splats | TileStore
"""A level of detail: a scene in memory, or rows on disk."""


_ROWS_AT_ONCE = 1 << 20  # rows processed together


@dataclass(frozen=True)
class Cut(Settings):
    """Rule for splitting a node: it holds more than `most` Gaussians of all levels, or is wider than `extent`
    and holds more than `least`. The defaults are those of PlayCanvas' writer.

    Args:
        most: maximum Gaussians of a leaf, and roughly of a file.
        extent: longest side of the box of a leaf's means, scene units.
        least: a wide node with at most this many Gaussians stays whole; otherwise sky and floaters would
            become thousands of leaves.
    """

    most: AtLeastOne = 512 * 1024
    extent: Positive = 16.0
    least: AtLeastOne = 8 * 1024


@dataclass(frozen=True, eq=False)
class Node:
    """A node of the tree: a box in space, and two children or, in a leaf, the rows in it.

    Args:
        low, high: (3,) float64 box around its Gaussians' 1σ ellipsoids, relative to the offset.
        rows: per level, the rows in a leaf; may be empty.
    """

    low: Float
    high: Float
    children: tuple[Node, ...] = ()
    rows: tuple[Int, ...] = ()

    def leaves(self) -> Iterator[Node]:
        """Yield all leaves, in tree order."""
        if not self.children:
            yield self
        for child in self.children:
            yield from child.leaves()


def aligned(levels: Sequence[Level]) -> tuple[list[Level], float, bool]:
    """Return levels with float32 means and one offset, the largest rounding, and whether offsets changed."""
    check_levels(levels)
    first = levels[0]
    offset = first.offset
    if isinstance(first, Splats):
        offset = first.narrowed().offset
    moved = bool((offset != first.offset).any())
    found = []
    error = 0.0
    for level in levels:
        near = level
        if isinstance(level, Splats) and (moved or level.means.dtype == float):
            near = level.narrowed(offset)
            error = max(error, rounding(level, near))
        found.append(near)
    return found, error, moved


def check_levels(levels: Sequence[Level]) -> None:
    """Raise an `InputError` for no levels, empty ones, different offsets, or rows that are not finite."""
    if not levels or not all(map(len, levels)):
        raise InputError("expected at least one level, none of them empty", parameter="levels")
    if any((level.offset != levels[0].offset).any() for level in levels):
        raise InputError("the levels have different offsets", parameter="levels")
    for number, level in enumerate(levels):
        if isinstance(level, Splats):
            try:
                check_finite(level, "levels")
            except InputError as error:
                raise error.at(message=f"of level {number} {error.message}") from None


def cut(
    levels: Sequence[Level],
    rule: Cut | None = None,
    scratch: Path | None = None,
) -> Node:
    """Cut space at medians of the means of all levels, along the longest side of their box.

    Args:
        levels: the same scene at several levels, finest first, with equal offsets.
        scratch: folder for unnamed temporary files of positions and row numbers. Memory then holds 4 bytes
            per row plus the rows of one leaf. None keeps everything in memory.

    >>> fine = Splats.create([[0, 0, 0], [9, 0, 0]], scales=[[1, 1, 2]] * 2)
    >>> tree = cut([fine, fine.take([0])], Cut(most=2))
    >>> [[len(rows) for rows in leaf.rows] for leaf in tree.leaves()], tree.low.tolist(), tree.high.tolist()
    ([[1, 0], [1, 1]], [-1.0, -1.0, -2.0], [10.0, 1.0, 2.0])
    """
    check_levels(levels)
    tree = _Tree(levels, rule or Cut(), scratch)
    rows = tree.room(len(tree.means))
    for at in _split_rows(len(rows)):
        rows[at] = np.arange(at.start, at.stop)
    return tree.of(rows, ())


def _split_rows(count: int) -> Iterator[slice]:
    for start in range(0, count, _ROWS_AT_ONCE):
        yield slice(start, min(start + _ROWS_AT_ONCE, count))


def _measure_reach(splats: Splats) -> Float:
    """Return the (N, 3) half extents of each Gaussian's 1σ box, |R|·s."""
    frames = rotation_matrices(splats.quats)
    return np.einsum("nij,nj->ni", np.abs(frames), splats.scales.astype(float))


class _Tree:
    """Rows of all levels, numbered consecutively; the rows of a node are in ascending order."""

    def __init__(
        self,
        levels: Sequence[Level],
        rule: Cut,
        scratch: Path | None,
    ) -> None:
        self.levels = levels
        self.rule = rule
        self.scratch = scratch
        self.starts = np.cumsum([0, *map(len, levels)])
        count = int(self.starts[-1])
        at = 0
        self.kept = self.room(count)
        self.filled = 0
        wide = any(isinstance(level, Splats) and level.means.dtype == float for level in levels)
        self.means = self.room((count, 3), float if wide else np.float32)
        for number, level in enumerate(levels):
            if isinstance(level, Splats):
                blocks = iter([level.means])
            else:
                blocks = level.positions()
            for block in blocks:
                if not np.isfinite(block).all():
                    raise InputError(f"a mean of level {number} is not finite", parameter="levels")
                self.means[at : at + len(block)] = block
                at += len(block)

    def room(self, shape: int | tuple[int, int], dtype: type[Any] = np.int64) -> Values:
        """Allocate an array in memory, or in a temporary file that is removed with it."""
        if self.scratch is None or np.prod(shape) < _ROWS_AT_ONCE:
            return np.empty(shape, dtype)
        with TemporaryFile(dir=self.scratch) as file:
            return np.memmap(file, dtype, "w+", shape=shape)

    def of(self, rows: Int, axes: tuple[int, ...]) -> Node:
        """Build the node of these rows; `axes` are the axes of its ancestors' cuts, outermost first."""
        count = len(rows)
        low, high = self._box(rows)
        sides = high - low
        is_wide = sides.max() > self.rule.extent and count > self.rule.least
        if count < 2 or not (is_wide or count > self.rule.most):
            return self._leaf(rows)
        axis = int(sides.argmax())
        below, above = self._halves(rows, axis, axes)
        one = self.of(below, (*axes, axis))
        other = self.of(above, (*axes, axis))
        return Node(
            np.minimum(one.low, other.low),
            np.maximum(one.high, other.high),
            (one, other),
        )

    def _box(self, rows: Int) -> tuple[Float, Float]:
        boxes = []
        for at in _split_rows(len(rows)):
            part = self.means[rows[at]]
            boxes.append((part.min(axis=0), part.max(axis=0)))
        low, high = np.array(boxes, float).swapaxes(0, 1)
        return low.min(axis=0), high.max(axis=0)

    def _halves(
        self,
        rows: Int,
        axis: int,
        axes: tuple[int, ...],
    ) -> tuple[Int, Int]:
        """Split rows at the median of `axis`; ties go by earlier cuts' axes, last first, then by row."""
        middle = len(rows) // 2
        values = np.empty(len(rows), self.means.dtype)
        for at in _split_rows(len(rows)):
            values[at] = self.means[rows[at], axis]
        values.partition(middle)
        limit = values[middle]
        short = middle - int(np.count_nonzero(values < limit))
        del values
        ties = []
        for at in _split_rows(len(rows)):
            part = rows[at]
            ties.append(part[self.means[part, axis] == limit])
        tied = np.concatenate(ties)
        if axes:
            tied = tied[np.lexsort([self.means[tied, a] for a in axes])]
        lower = np.sort(tied[:short])
        below = self.room(middle)
        above = self.room(len(rows) - middle)
        done = 0
        for at in _split_rows(len(rows)):
            part = rows[at]
            inside = self.means[part, axis] < limit
            inside |= np.isin(part, lower, assume_unique=True)
            some = part[inside]
            rest = part[~inside]
            begin = at.start - done
            below[done : done + len(some)] = some
            above[begin : begin + len(rest)] = rest
            done += len(some)
        return below, above

    def _leaf(self, rows: Int) -> Node:
        """Build the leaf of these rows: its rows per level, and the box of their Gaussians' 1σ extents."""
        ends = np.searchsorted(rows, self.starts)
        parts = []
        low = np.full(3, np.inf)
        high = np.full(3, -np.inf)
        for number, level in enumerate(self.levels):
            own = rows[ends[number] : ends[number + 1]]
            count = len(own)
            part = self.kept[self.filled : self.filled + count]
            part[:] = own - self.starts[number]
            parts.append(part)
            self.filled += count
            if count:
                some = level.take(part)
                means = some.means.astype(float)
                reach = _measure_reach(some)
                low = np.minimum(low, (means - reach).min(axis=0))
                high = np.maximum(high, (means + reach).max(axis=0))
        return Node(low, high, rows=tuple(parts))
