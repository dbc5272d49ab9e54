"""Opaque matter of a scene, free of outliers, in units of the scene's own size, and a grid of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.arrays import Float, Float32, Mask, Values
from g2ard.errors import InputError
from g2ard.poses.votes import Votes
from g2ard.scene.reproducible import (
    canonical_order,
    middle,
    norms,
    positive,
    quantile,
    quantiles,
    turned,
)
from g2ard.scene.splats import Splats
from g2ard.scene.transform import rotation_matrices
from g2ard.system.cached import cached_property

_FAR = 7.0
"""Distance of floaters and a sky without a gap before it, as a multiple of the radius of two thirds of the
opacity."""

_BEYOND = 4096
"""Gaussians that represent what is not near."""

_BOX = (0.01, 0.99)
"""Quantiles along each axis that bound the box which gives the size."""

_WIDEST = 16.0
"""Largest area that counts, in median areas; otherwise a sky of a few hundred rows outweighs the rest."""

_SAMPLE = 200_000
"""Rows used for statistics; the occupancy grid uses all."""

_CELLS = (2_000_000, 6_000_000)
"""Least and most cells, with one per Gaussian in between: larger scenes get finer grids."""

_CELLS_A_ROW = 5
"""Cells per row if the rows are a sample of a larger scene."""

_OPAQUE = 0.3
"""Opacity × area per face of a cell, summed, above which hardly any light passes."""

_MURKY = 0.04
"""The same sum above which a cell holds leaves, glass or haze, and no camera may stand there."""

_LEAST_SIDE = 1 / 256
"""Least side of the box as a share of its longest, so that a flat scene has a thickness."""

_HALF_WIDTH = 1.6
"""Standard deviations from its centre within which a Gaussian fills cells, 89 % of it."""

_PARTS = 9
"""Most sample points along an axis for a Gaussian wider than a cell."""

_REACH = 12
"""Largest distance stored, in cells: enough for rays to stride through free space."""


@dataclass(frozen=True, eq=False)
class Matter:
    """Opaque Gaussians of a scene: scene = origin + size·points.

    The order of the rows depends on their values alone, and each prefix is a fair sample.

    Args:
        points: (M, 3) means.
        weights: (M,) mass: opacity × area of the two largest scales, capped; the median area counts as 1.
        scales: (M, 3) standard deviations, ascending.
        quats: (M, 4) rotations.
        order: (M, 3) the axis of the rotation that each scale belongs to.
        opacities: (M,) in (0, 1].
        origin: (3,) relative to the scene's offset.
        size: scene units per unit here: half the diagonal of the box that holds 98 % along each axis.
        represents: Gaussians per row, more than 1 in a sample.
        beyond: (F, 3) a sample of the Gaussians that are not near: sky, surroundings, floaters.
        beyond_share: share of the visible Gaussians that are not near.
        centre: (3,) the middle of the places from which people looked at the scene.
        horizon: distance from `centre` at which a sky begins; inf without one.
    """

    points: Float
    weights: Float
    scales: Float
    quats: Float32
    order: Values
    opacities: Float
    origin: Float
    size: float
    represents: float = 1.0
    beyond: Float = field(default_factory=lambda: np.zeros((0, 3)))
    beyond_share: float = 0.0
    centre: Float = field(default_factory=lambda: np.zeros(3))
    horizon: float = np.inf

    @classmethod
    def of(
        cls,
        splats: Splats,
        limit: int | None = None,
        represents: float = 1.0,
    ) -> Matter:
        """Weigh a scene's rows, drop invisible and distant ones, and normalise the rest.

        At most `limit` rows are used, as a fair sample. Each row of `splats` represents some Gaussians.

        Raises:
            InputError: nothing is visible.
        """
        rows = splats.visible_rows()
        visible = len(rows)
        rows = rows[canonical_order(splats, rows, limit)]
        represents *= visible / max(1, len(rows))
        if len(rows):
            rows = rows[splats.take(rows).finite_rows()]
        opacities = splats.opacities[rows].astype(np.float64)
        means = splats.means[rows].astype(np.float64)
        scales = np.abs(splats.scales[rows])
        order = np.argsort(scales, axis=1, kind="stable")
        scales = np.take_along_axis(scales, order, axis=1).astype(np.float64)
        areas = scales[:, 1] * scales[:, 2]
        flat_areas = areas[areas > 0]
        if not len(flat_areas):
            raise InputError(
                "the scene has no visible Gaussian with a surface, so no poses can be planned; give views"
            )
        weights = opacities * np.minimum(areas / middle(flat_areas), _WIDEST)
        votes = Votes.of(means, np.sqrt(areas), opacities, represents)
        near = _find_near(means, opacities, votes)
        some = np.flatnonzero(near)[:_SAMPLE]
        box = quantiles(means[some], weights[some], _BOX)  # (3, 2)
        diagonal = float(norms((box[:, 1] - box[:, 0])[None])[0])
        size = max(diagonal / 2, 2 * middle(scales[some, 2]))  # a single Gaussian also needs a size
        origin = box.mean(axis=1)
        return cls(
            points=(means[near] - origin) / size,
            weights=weights[near],
            scales=scales[near] / size,
            quats=splats.quats[rows[near]],
            order=order[near],
            opacities=opacities[near],
            origin=origin,
            size=size,
            represents=represents,
            beyond=(means[~near][:_BEYOND] - origin) / size,
            beyond_share=float(1 - near.mean()),
            centre=(votes.centre - origin) / size,
            horizon=votes.horizon / size,
        )

    def first(self, count: int = _SAMPLE) -> Matter:
        """Return the first rows, a fair sample."""
        names = ("points", "weights", "scales", "quats", "order", "opacities")
        return replace(self, **{name: getattr(self, name)[:count] for name in names})

    @cached_property
    def normals(self) -> Float:
        """(M, 3) unit axes of the smallest scales, sign arbitrary."""
        return self.axes(slice(None))[:, 0]

    @cached_property
    def faces(self) -> Float:
        """(M,) mass × flatness, where flatness is 1 − smallest / middle scale."""
        return self.weights * (1 - self.scales[:, 0] / positive(self.scales[:, 1]))

    def axes(self, rows: Any) -> Float:
        """Return (m, 3, 3) the unit axes of some rows, by ascending scale."""
        axes = rotation_matrices(self.quats[rows]).swapaxes(1, 2)
        return np.take_along_axis(axes, self.order[rows][:, :, None], axis=1)


def _find_near(means: Float, weights: Float, votes: Votes) -> Mask:
    """Return the rows that people look at from near: without a sky, surroundings and floaters.

    What lies beyond a gap is judged by votes. Of the rest, rows within `_FAR` typical distances of the centre
    are near, repeated after dropping the farthest. Rows are weighed by opacity alone, because a sky has few
    rows and much area.
    """
    rows = np.flatnonzero(norms(means - votes.centre) <= votes.radius)
    found = np.zeros(len(means), bool)
    means = means[rows]
    weights = weights[rows]
    near = np.ones(len(rows), bool)
    for _ in range(4):
        some = np.flatnonzero(near)[:_SAMPLE]
        centre = quantiles(means[some], weights[some], 0.5)
        distances = norms(means - centre)
        typical = quantile(distances[some], weights[some], 2 / 3)
        within = distances <= _FAR * typical
        if (within == near).all():
            break
        near = within
    found[rows[near]] = True
    return found


@dataclass(frozen=True, eq=False)
class Grid:
    """Axis-aligned cells from `low`, each of side `cell`.

    Args:
        low: (3,) corner.
        cell: side.
        opaque: (X, Y, Z) int8 king's moves to the nearest cell that stops light, at most `_REACH`.
        murky: the same, to the nearest cell that is not almost empty.
        scale: (X, Y, Z) float32, geometric mean of the two longer standard deviations of the Gaussians in a
            cell; 0 in empty cells.
    """

    low: Float
    cell: float
    opaque: NDArray[np.int8]
    murky: NDArray[np.int8]
    scale: Float32

    @classmethod
    def of(
        cls,
        low: Float,
        high: Float,
        matter: Matter,
        axes: Float,
    ) -> Grid:
        """Fill the box from `low` to `high`, along the rows of `axes`."""
        count = len(matter.points)
        cells = int(np.clip(count, *_CELLS))
        if matter.represents > 1:
            cells = _CELLS_A_ROW * count
        sides = high - low
        sides = np.maximum(sides, sides.max() * _LEAST_SIDE)
        cell = float(np.cbrt(np.prod(sides) / cells))
        shape = np.maximum(1, np.ceil(sides / cell)).astype(int)
        depth, logs = _fill_cells(low, cell, shape, matter, axes)
        scale = np.zeros(len(depth), np.float32)
        some = depth > 0
        scale[some] = np.exp(logs[some] / depth[some])
        return cls(
            low=low,
            cell=cell,
            opaque=_count_steps((depth > _OPAQUE).reshape(shape)),
            murky=_count_steps((depth > _MURKY).reshape(shape)),
            scale=scale.reshape(shape),
        )

    def distance(self, points: Float) -> Float:
        """Return (M,) distances to the nearest murky cell, or to the box if that is farther.

        Distances within the box are at most `_REACH` − 1 cells.
        """
        index, inside = self._index(points)
        steps = self.murky.ravel()[index].astype(np.float64)
        found = np.maximum(steps - 1, 0) * self.cell
        high = self.low + self.cell * np.array(self.murky.shape)
        # along each axis, negative within the box
        gaps = np.maximum(self.low - points, points - high)
        outside = norms(np.maximum(0, gaps))
        return np.where(inside, found, np.maximum(outside, found))

    def scale_at(self, points: Float) -> Float:
        """Return (M,) values of `scale` in the cells of points, 0 outside the box."""
        index, inside = self._index(points)
        return np.where(inside, self.scale.ravel()[index], 0.0)

    def _index(self, points: Float) -> tuple[Any, Mask]:
        return _index_cells(points, self.low, self.cell, np.array(self.murky.shape))

    def cast(
        self,
        eyes: Float,
        directions: Float,
        *,
        murky: bool = False,
    ) -> Float:
        """Return (M,) distances at which unit rays meet an opaque or a murky cell; inf without one."""
        if murky:
            steps = self.murky
        else:
            steps = self.opaque
        return _core.cast_rays(
            steps.ravel(),
            list(steps.shape),
            self.low.tolist(),
            self.cell,
            np.ascontiguousarray(eyes, np.float64),
            np.ascontiguousarray(directions, np.float64),
        )


def _fill_cells(
    low: Float,
    cell: float,
    shape: Values,
    matter: Matter,
    axes: Float,
) -> tuple[Float, Float]:
    """Spread the Gaussians over the cells that they cover.

    A Gaussian wider than a cell is represented by n × n points on the disc of its two longer axes.

    Returns:
        The (cells,) sums of opacity × area per face of a cell; and these sums weighted with the logarithm of
        the Gaussians' sizes.
    """
    filled = np.zeros(int(np.prod(shape)))
    logs = np.zeros(len(filled))
    points = turned(matter.points, axes)
    middle_scales = matter.scales[:, 1]
    largest = matter.scales[:, 2]
    sizes = 0.5 * np.log(positive(middle_scales * largest))
    faces = 2 * np.pi * middle_scales * largest / cell**2
    optical = matter.represents * matter.opacities * faces
    parts = np.ceil(_HALF_WIDTH * largest / cell)
    parts = np.clip(parts, 1, _PARTS).astype(np.int8)
    for count in np.unique(parts).tolist():
        rows = np.flatnonzero(parts == count)
        spans = np.zeros((1, 2, 3))
        if count > 1:
            spans = matter.axes(rows)[:, 1:] * matter.scales[rows, 1:, None]
            spans = turned(spans.reshape(-1, 3), axes).reshape(-1, 2, 3)
        offsets = _HALF_WIDTH * ((np.arange(count) + 0.5) / count * 2 - 1)
        for a, b in product(offsets, offsets):
            places = points[rows] + a * spans[:, 0] + b * spans[:, 1]
            index, inside = _index_cells(places, low, cell, shape)
            cells = index[inside]
            here = rows[inside]
            share = optical[here] / count**2
            np.add.at(filled, cells, share)
            np.add.at(logs, cells, share * sizes[here])
    return filled, logs


def _index_cells(
    points: Float,
    low: Float,
    cell: float,
    shape: Values,
) -> tuple[Any, Mask]:
    """Return flat cell indices, clamped into the box, and whether each point was in it."""
    flat = np.zeros(len(points), np.int64)
    inside = np.ones(len(points), bool)
    for axis in range(3):
        count = shape[axis]
        place = np.floor((points[:, axis] - low[axis]) / cell)
        inside &= place >= 0
        inside &= place < count
        flat *= count
        flat += np.clip(place, 0, count - 1).astype(np.int64)
    return flat, inside


def _count_steps(filled: Mask) -> NDArray[np.int8]:
    """Return king's moves to the nearest filled cell, at most `_REACH`."""
    steps = np.full(filled.shape, _REACH, np.int8)
    steps -= filled
    for _ in range(1, _REACH):
        for axis in range(3):
            wider = filled.copy()
            before = np.moveaxis(filled, axis, 0)
            after = np.moveaxis(wider, axis, 0)  # a view: what is set here is set in `wider`
            after[1:] |= before[:-1]
            after[:-1] |= before[1:]
            filled = wider
        steps -= filled
    return steps
