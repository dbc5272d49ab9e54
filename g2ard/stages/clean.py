"""Detection of clutter: Gaussians of a trained scene that no image of it needs, by kind.

| kind | definition |
|---|---|
| invisible | no pixel changes by half an 8-bit step without it, nor the mean without all of them |
| giant | larger than the scene, with the scene's centre within 3σ: fog over everything |
| needle | ten times as long as wide, with both ends beyond the 3σ of every neighbour |
| floater | in a connected group below a thousandth of the scene, by number and by light |
| haze | on request: in front of the visible surface in most views |
| streak | on request: ten times as long as wide, with an end in front of the surface in most views |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.arrays import Float, Float32, Mask, Rows, Values
from g2ard.errors import InputError, require
from g2ard.progress import Progress, counter, silent
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera, Cameras, within_frame
from g2ard.scene.reproducible import joined
from g2ard.scene.shape import NEEDLE_LENGTH, longer_axes
from g2ard.scene.splats import DRAWN_LOGIT, Splats
from g2ard.scene.transform import rotation_matrices

KINDS = ("invisible", "giant", "needle", "floater", "haze", "streak")
FLOATING = ("haze", "streak")
"""Kinds that are found only with a strength."""

_Floating = tuple[Float, Float]

_HALF_STEP = 0.5 / 255
"""Half an 8-bit step."""
_FOOTPRINT_SIGMAS = 3.0
"""Standard deviations at which renderers cut off a footprint."""
_FLOATER_SHARE = 1e-3
"""Share of the scene's Gaussians and of its light below which a separate group is a floater."""
_NEIGHBORS = 16
"""Nearest neighbours that can touch a Gaussian."""
_BLOCK = 1 << 17
"""Gaussians that are grouped at once."""
_SURFACE_SLACK = 0.01
"""Share of the depth within which a Gaussian belongs to the visible surface, behind or in front of it."""


@dataclass(frozen=True, eq=False)
class Cleaning:
    """Kind of clutter per Gaussian.

    Args:
        kind: (N,) int8, −1 to keep, otherwise an index into `KINDS`.
    """

    kind: NDArray[np.int8]

    @property
    def keep(self) -> Mask:
        """(N,) mask of the Gaussians to keep."""
        return self.kind < 0

    @property
    def counts(self) -> dict[str, int]:
        """Number of Gaussians per kind."""
        return {name: int(np.count_nonzero(self.kind == i)) for i, name in enumerate(KINDS)}


def find_clutter(
    splats: Splats,
    seen: Any,
    unoccluded: Mask,
    pixels: int,
    kinds: tuple[str, ...] = KINDS,
    *,
    floating: _Floating | None = None,
    strength: float = 0.0,
    extent: tuple[Sequence[float], float] | None = None,
    progress: Progress = silent,
) -> Cleaning:
    """Find Gaussians to remove; one of several kinds gets the first in the order of `KINDS`.

    Args:
        splats: N Gaussians, finite.
        seen: their visibility (`g2ard.rendering.visibility.visibility`).
        unoccluded: (N,) mask from `compare_depths`: only these can be invisible, apart from α below 1/255.
        pixels: number of pixels of all views together.
        floating: from `compare_depths`; None finds neither haze nor streaks.
        strength: 0 to 1: haze and streaks float in more than 1 − `strength` of the views.
        extent: `extent_of` the whole scene, if these are a part of it.

    Raises:
        InputError: an unknown kind, or `seen` or `unoccluded` of another length.
    """
    unknown = sorted(set(kinds) - set(KINDS))
    if unknown:
        raise InputError(
            f"expected some of {', '.join(KINDS)}, got {unknown[0]!r}", parameter="kinds"
        )
    for name, rows in (("seen", seen.weight), ("unoccluded", unoccluded)):
        require(name, len(rows), len(rows) == len(splats), f"{len(splats)} rows")
    kind = np.full(len(splats), -1, np.int8)
    hidden = _mark_invisible(splats, seen, unoccluded, pixels)
    finders = {
        "invisible": lambda rest: hidden,
        "giant": lambda rest: _mark_giants(splats, *(extent or extent_of(splats))),
        "needle": lambda rest: _mark_needles(splats, rest, progress),
        "floater": lambda rest: _mark_floaters(splats, rest, seen.weight, unoccluded, progress),
    }
    if floating is not None:
        finders["haze"] = lambda rest: floating[0] > 1 - strength
        finders["streak"] = lambda rest: floating[1] > 1 - strength
    for number, name in enumerate(KINDS):
        progress("clutter", number, len(KINDS))
        if name in kinds and name in finders:
            rest = (kind < 0) & ~hidden  # invisible Gaussians support nothing either
            marked = finders[name](rest)
            kind[marked & (kind < 0)] = number
    progress("clutter", len(KINDS), len(KINDS))
    return Cleaning(kind)


def _mark_invisible(splats: Splats, seen: Any, unoccluded: Mask, pixels: int) -> Mask:
    """Mark Gaussians that no renderer draws, and the weakest ones that change no pixel by half an 8-bit step.

    The latter are taken in order of light until together they would change the mean pixel by half a step.
    """
    faint = splats.logit_opacities < DRAWN_LOGIT
    small = np.flatnonzero(unoccluded & ~faint & (seen.peak < _HALF_STEP))
    order = small[np.argsort(seen.weight[small], kind="stable")]
    total = np.cumsum(seen.weight[order], dtype=np.float64)
    out: Mask = faint.copy()
    out[order[total <= _HALF_STEP * pixels]] = True
    return out


def compare_depths(
    splats: Splats, cameras: Cameras, *, floating: bool = True, progress: Progress = silent
) -> tuple[Mask, _Floating | None]:
    """Compare the Gaussians' depths in each view with those of the visible surface.

    The surface is where half of a pixel's light is blocked. A mean is unoccluded if it is in the frame of a
    view and at most 1 % of the depth behind the surface. Gaussians deeper in all views, behind a wall or in
    an unseen corner, may be visible from elsewhere.

    Means can float, and both ends of Gaussians ten times as long as wide. A point floats in a view if it is
    nearer than the surface by more than its Gaussian's standard deviation along the ray plus 1 % of the
    depth. Views that do not show the point, or show no surface behind it, do not count. One more view counts
    as not floating, so that few views are weak evidence.

    Returns:
        The (N,) mask of unoccluded means, and if wanted two (N,) shares of the views in which a Gaussian
        floats: with its mean, and with that of its ends (2σ) which floats more often, 0 without ends.
    """
    count = len(splats)
    points = splats.means.astype(np.float64)
    owners = np.arange(len(splats))
    if floating:
        long, mean_to_end = _find_elongated(splats, owners)
        points = np.concatenate(
            [
                points,
                points[long] - mean_to_end,
                points[long] + mean_to_end,
            ]
        )
        owners = np.concatenate([owners, long, long])
    points += splats.offset
    unoccluded = np.zeros(count, bool)
    views = np.ones(len(points))
    floats = np.zeros(len(points))
    renderer = Renderer(splats)
    for done, camera in enumerate(cameras, 1):
        depths = renderer.render(camera, median=True).median
        assert depths is not None
        rows, z, surface = _find_in_frame(points, camera, depths)
        shown = z < (1 + _SURFACE_SLACK) * surface
        seen = rows[shown | (surface == 0)]
        unoccluded[seen[seen < count]] = True
        if floating:
            views[rows[shown]] += 1
            front = z < (1 - _SURFACE_SLACK) * surface
            rows = rows[front]
            z = z[front]
            surface = surface[front]
            rays = points[rows] - camera.position
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            owner = owners[rows]
            frames = rotation_matrices(splats.quats[owner])
            along = np.einsum("nji,nj->ni", frames, rays)
            del frames
            along = np.linalg.norm(along * splats.scales[owner], axis=1)
            floats[rows] += z + along < (1 - _SURFACE_SLACK) * surface
        progress("depths", done, len(cameras), {})
    if not floating:
        return unoccluded, None
    shares = floats / views
    ends = np.zeros(count)
    ends[long] = shares[count:].reshape(2, -1).max(axis=0)
    return unoccluded, (shares[:count], ends)


def _find_in_frame(points: Float, camera: Camera, depths: Float32) -> tuple[Rows, Float, Float32]:
    """Return the rows of points in the frame, their depths, and the surface's depths at their pixels."""
    x, y, z = camera.viewmat[:3, :3] @ points.T + camera.viewmat[:3, 3:]
    (fx, _, cx), (_, fy, cy), _ = camera.K
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor(fx * x / z + cx)
        v = np.floor(fy * y / z + cy)
    inside = within_frame(u, v, camera.width, camera.height)
    inside &= z > 0
    rows = np.flatnonzero(inside)
    row = v[rows].astype(int)
    column = u[rows].astype(int)
    return rows, z[rows], depths[row, column]


def extent_of(splats: Splats) -> tuple[list[float], float]:
    """Return the median of the means, and the radius around it that holds 99 % of them."""
    means = splats.means.astype(np.float64)
    middle = np.median(means, axis=0)
    away = np.linalg.norm(means - middle, axis=1)
    return middle.tolist(), float(np.percentile(away, 99))


def _mark_giants(splats: Splats, middle: Sequence[float], radius: float) -> Mask:
    """Mark Gaussians larger than the scene, with its middle within 3σ."""
    large = np.flatnonzero(splats.scales.max(axis=1) > radius)
    offsets = np.asarray(middle) - splats.means.astype(np.float64)[large]
    local = np.einsum("nji,nj->ni", rotation_matrices(splats.quats[large]), offsets)
    local /= np.maximum(splats.scales[large].astype(np.float64), 1e-30)  # in standard deviations
    within = np.linalg.norm(local, axis=1) <= _FOOTPRINT_SIGMAS
    out = np.zeros(len(splats), bool)
    out[large[within]] = True
    return out


def _mark_needles(splats: Splats, rest: Mask, progress: Progress) -> Mask:
    """Mark long, thin Gaussians of `rest` with both ends (2σ) beyond 3σ of their nearest neighbours.

    Neighbours count as spheres of their largest scale: by their true shape eight times as many were needles
    on a clean scene, many of them its fine lines.
    """
    out = np.zeros(len(splats), bool)
    rows = np.flatnonzero(rest)
    long, mean_to_end = _find_elongated(splats, rows)
    if not len(long) or len(rows) <= 2 * _NEIGHBORS:
        return out
    means = splats.means.astype(np.float64)
    ends = np.concatenate(
        [
            means[long] - mean_to_end,
            means[long] + mean_to_end,
        ]
    )
    points = np.concatenate([means[rows], ends])
    found = _core.knn(np.ascontiguousarray(points), _NEIGHBORS, counter(progress, "neighbours"))
    near = found[len(rows) :].astype(np.int64)  # of the ends
    is_mean = near < len(rows)
    other = rows[np.where(is_mean, near, 0)]
    own = np.tile(long, 2)[:, None]
    away = np.linalg.norm(means[other] - ends[:, None], axis=2)
    reach = _FOOTPRINT_SIGMAS * splats.scales[other].max(axis=2)
    covers = is_mean & (other != own)
    covers &= away <= reach
    covered = covers.any(axis=1)  # per end
    isolated = ~covered.reshape(2, -1).any(axis=0)
    out[long[isolated]] = True
    return out


def _find_elongated(splats: Splats, rows: Rows) -> tuple[Rows, Float]:
    """Return those of `rows` that are ten times as long as wide, and (n, 3) vectors from mean to end (2σ)."""
    width, length = longer_axes(splats.scales[rows].astype(np.float64)).T
    long = rows[length > NEEDLE_LENGTH * np.maximum(width, 1e-30)]
    axis = np.argmax(splats.scales[long], axis=1)
    frames = rotation_matrices(splats.quats[long])
    longest = np.take_along_axis(frames, axis[:, None, None], axis=2)[:, :, 0]
    sigmas = splats.scales[long, axis].astype(np.float64)
    return long, 2 * sigmas[:, None] * longest


def _mark_floaters(
    splats: Splats,
    rest: Mask,
    weight: Values,
    unoccluded: Mask,
    progress: Progress = silent,
) -> Mask:
    """Mark small groups of touching Gaussians of `rest` (3σ spheres meet), some of them unoccluded."""
    out = np.zeros(len(splats), bool)
    rows = np.flatnonzero(rest)
    if len(rows) <= _NEIGHBORS:
        return out
    means = splats.means[rows].astype(np.float64)
    reach = _FOOTPRINT_SIGMAS * splats.scales[rows].max(axis=1).astype(np.float64)
    near = _core.knn(means, _NEIGHBORS, counter(progress, "neighbours"))
    group = np.arange(len(rows))
    for first in range(0, len(rows), _BLOCK):
        progress("groups", first, len(rows))
        block = slice(first, first + _BLOCK)
        other = near[block]
        squares = sum((axis[other] - axis[block, None]) ** 2 for axis in means.T)
        touching = np.sqrt(squares) <= reach[block, None] + reach[other]
        a, b = np.nonzero(touching)
        group = joined(group, a + first, other[a, b])
    progress("groups", len(rows), len(rows))
    count = np.bincount(group, minlength=len(rows))
    light = np.bincount(group, weight[rows], minlength=len(rows))
    shown = np.bincount(group, unoccluded[rows], minlength=len(rows))
    small = count <= _FLOATER_SHARE * len(rows)
    small &= light <= _FLOATER_SHARE * light.sum()
    small &= shown > 0
    out[rows[small[group]]] = True
    return out
