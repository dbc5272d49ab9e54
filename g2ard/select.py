"""Which views are worth having: an order of the candidates, what each adds, and how often to draw it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.cameras import Cameras
from g2ard.errors import InputError
from g2ard.progress import Progress, counter, silent
from g2ard.splats import Splats

__all__ = [
    "POLICIES",
    "CoverageOptions",
    "Selection",
    "Surface",
    "Visible",
    "select",
    "surface",
    "visible_cells",
]

POLICIES = ("auto", "directional", "coverage", "pose-diverse", "random", "uniform")

Float = NDArray[np.float64]
Order = NDArray[np.int64]

_BANDWIDTH = 0.35
"""Of the kernel exp(−(d/0.35)²) between poses: neighbours 20° apart on an orbit are half alike."""
_COARSE = 20_000
"""Cells that stand for the scene where only distances to it matter."""


@dataclass(frozen=True)
class CoverageOptions:
    """Of the policies that look at surfaces (main text, eq. 2; `tab:s_avs`).

    Args:
        cells: surface cells M; adaptive voxels.
        kappa: sharpness of the observation kernel and of the targets.
        alpha: exponent of the fair utility u(x) = x^(1−α)/(1−α).
        offset: g(x) = u(offset + x); the paper's λ.
        lazy: look again only at the view that leads (CELF): the same views, fewer evaluations.
    """

    cells: int = 300_000
    kappa: float = 20.0
    alpha: float = 2.0
    offset: float = 1.0
    lazy: bool = True


@dataclass(frozen=True, eq=False)
class Surface:
    """M cells of surface, in coordinates about `origin`.

    Args:
        centers: (M, 3) float64.
        normals: (M, 3) float64 unit, unoriented.
        confidence: (M,) float64 in [0, 1], planarity (λ₂ − λ₃)/λ₁.
        weights: (M,) float64, footprint areas capped at their 99th percentile, summing to 1.
        size: edge of a cell, scene units.
        origin: (3,) float64 world coordinates.
    """

    centers: Float
    normals: Float
    confidence: Float
    weights: Float
    size: float
    origin: Float

    @property
    def parts(self) -> tuple[Float, Float, Float, Float, float]:
        """As `_core` takes them."""
        return self.centers, self.normals, self.confidence, self.weights, self.size


@dataclass(frozen=True, eq=False)
class Visible:
    """Which cells each of C views sees: view v's are cells[starts[v]:starts[v + 1]], ascending."""

    starts: NDArray[np.uint64]
    cells: NDArray[np.uint32]

    def of(self, view: int) -> NDArray[np.uint32]:
        return self.cells[int(self.starts[view]) : int(self.starts[view + 1])]


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen views, best first.

    Args:
        policy: how they were chosen.
        order: (K,) indices into the candidates.
        gains: (K,) what each added to the policy's objective when it was chosen, as a share of what the whole
            pool reaches.
        weights: (K,) how often to draw each, mean 1: the share of the pool that it stands for, with crowded
            poses counted less.
        left_out: what the candidates not chosen would have added, as a share of the whole.
        refused: indices of candidates that see nothing of the scene.
        evaluations: how often a view's gain was computed; 0 where a policy computes none.
        seconds: by stage.
    """

    policy: str
    order: Order
    gains: Float
    weights: Float
    left_out: float
    refused: Order
    evaluations: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


def select(
    splats: Splats,
    cameras: Cameras,
    k: int | Literal["auto"],
    *,
    policy: str = "auto",
    seed: int = 0,
    options: CoverageOptions | None = None,
    progress: Progress = silent,
) -> Selection:
    """Choose `k` of the candidate views.

    Args:
        splats: the raw prior; what the views see of it counts, not what they show.
        cameras: C candidates, in world coordinates.
        k: how many; C or more takes them all, in order of worth. "auto" stops where the curve of gains bends,
            at the K farthest above the straight line from none to all.
        policy: one of `POLICIES`. auto is facility location on poses: it picks the views that best represent
            all candidates, crowded ones counted less, Σ_u w_u max_{v∈S} exp(−(d_uv/0.35)²). directional is
            the paper's; coverage counts cells seen at all; pose-diverse takes the farthest pose next; random
            and uniform (evenly along the candidates' order) look at nothing.
        seed: of random.
        options: of directional and coverage.
        progress: told of the views rasterised.

    Returns:
        A `Selection`.

    Raises:
        InputError: `k` is not positive, an unknown policy, no candidates, or none that sees the scene.

    >>> from g2ard.cameras import look_at
    >>> ball = Splats.create(np.random.default_rng(0).normal(size=(500, 3)), scales=np.full((500, 3), 0.1))
    >>> around = [look_at([4 * np.cos(a), 4 * np.sin(a), 0], [0, 0, 0]) for a in (0.0, 0.1, 0.2, 3.1)]
    >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
    >>> views = Cameras.from_lists(around, [K] * 4, [(64, 64)] * 4, list("abcd"))
    >>> select(ball, views, 2).order.tolist()
    [1, 3]
    """
    if policy not in POLICIES:
        raise InputError(f"policy: expected {', '.join(POLICIES)}, got {policy!r}")
    if k != "auto" and k < 1:
        raise InputError(f"k: expected at least 1 view, got {k}")
    if not len(cameras):
        raise InputError("no candidate views to select from")
    began = time.perf_counter()
    seconds: dict[str, float] = {}
    coarse = surface(splats, min(_COARSE, max(1, len(splats))))
    depths = _viewing_distances(coarse, cameras)
    alike = _likeness(cameras, depths)
    wanted = _demand(alike)
    seconds["poses"] = time.perf_counter() - began
    usable = depths > 0
    evaluations = 0
    if policy in ("directional", "coverage"):
        order, gains, evaluations, usable = _by_surface(splats, cameras, policy, options, progress, seconds)
    elif policy == "pose-diverse":
        order, gains = _farthest(alike, usable)
    elif policy == "auto":
        order, gains = _represent(alike, wanted, usable)
    else:
        order = _blind(policy, np.flatnonzero(usable), k, seed)
        gains = _gains_of(order, alike, wanted)
    if not len(order):
        raise InputError(f"none of the {len(cameras)} candidate views sees the scene")
    count = _knee(gains) if k == "auto" else min(k, len(order))
    share = gains / total if (total := gains.sum()) > 0 else np.full(len(gains), 1 / len(gains))
    seconds["total"] = time.perf_counter() - began
    return Selection(
        policy=policy,
        order=order[:count],
        gains=share[:count],
        weights=_draw_weights(order[:count], alike, wanted),
        left_out=float(share[count:].sum()),
        refused=np.flatnonzero(~usable),
        evaluations=evaluations,
        seconds=seconds,
    )


def surface(splats: Splats, cells: int = 300_000) -> Surface:
    """Partition a prior into about `cells` cells of surface.

    Raises:
        InputError: the scene is empty or not finite.
    """
    if cells < 1:
        raise InputError(f"cells: expected at least 1, got {cells}")
    scene, origin = _scene(splats)
    found = _core.select_surface(scene, cells)
    return Surface(
        found["centers"], found["normals"], found["confidence"], found["weights"], found["size"], origin
    )


def visible_cells(
    splats: Splats, cells: Surface, cameras: Cameras, *, progress: Progress = silent
) -> Visible:
    """Rasterise the prior's median depth into every view and compare: ν_jv.

    A cell is visible where its centre falls on the image within max(cell size, 1 % of depth) of the median
    depth (by gsplat's conventions) in that pixel. Pixels without a cell are not worked out.

    Args:
        splats: the prior that `cells` came from.
        cells: see `surface`.
        cameras: C views in world coordinates.
        progress: told of the views done.

    Returns:
        A `Visible`.
    """
    scene, origin = _scene(splats)
    starts, seen = _core.select_visible(
        scene, cells.parts, _views(cameras, origin), progress=counter(progress, "visibility")
    )
    return Visible(starts, seen)


def _scene(splats: Splats) -> tuple[tuple[Any, ...], Float]:
    """What `_core` takes, and the world point it is centred about."""
    if not len(splats):
        raise InputError("the scene is empty")
    means = splats.means.astype(np.float64)
    middle = np.median(means, axis=0)
    arrays = (means - middle, splats.quats, splats.scales, splats.opacities)
    return tuple(np.ascontiguousarray(a) for a in arrays), middle + splats.offset


def _views(cameras: Cameras, origin: Float) -> list[tuple[Any, ...]]:
    local = cameras.recentred(origin)
    return [
        (
            local.viewmats[i].tolist(),
            [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            (int(local.widths[i]), int(local.heights[i])),
            0.01,
        )
        for i, K in enumerate(local.Ks)
    ]


def _by_surface(
    splats: Splats,
    cameras: Cameras,
    policy: str,
    options: CoverageOptions | None,
    progress: Progress,
    seconds: dict[str, float],
) -> tuple[Order, Float, int, NDArray[np.bool_]]:
    """The whole pool in the greedy's order; views that see no cell are left out."""
    options = options or CoverageOptions()
    began = time.perf_counter()
    cells = surface(splats, options.cells)
    seconds["surface"] = time.perf_counter() - began
    began = time.perf_counter()
    seen = visible_cells(splats, cells, cameras, progress=progress)
    seconds["visibility"] = time.perf_counter() - began
    usable = np.diff(seen.starts.astype(np.int64)) > 0
    began = time.perf_counter()
    order, gains, evaluations = _core.select_greedy(
        cells.parts,
        seen.starts,
        seen.cells,
        np.ascontiguousarray(cameras.recentred(cells.origin).positions),
        len(cameras),
        directional=policy == "directional",
        kappa=options.kappa,
        alpha=options.alpha,
        lambda_=options.offset,
        lazy=options.lazy,
        progress=counter(progress, "select"),
    )
    seconds["greedy"] = time.perf_counter() - began
    keep = usable[order]
    return order.astype(np.int64)[keep], gains[keep], evaluations, usable


def _viewing_distances(cells: Surface, cameras: Cameras) -> Float:
    """(C,) each view's median depth of the cells within its image, 0 where there is none."""
    local = cameras.recentred(cells.origin)
    step = max(1, len(cells.centers) // _COARSE)
    points = cells.centers[::step]
    out = np.zeros(len(local))
    for i in range(len(local)):
        x, y, z = local.viewmats[i, :3, :3] @ points.T + local.viewmats[i, :3, 3:]
        ahead = z > 0.01
        z = np.where(ahead, z, 1.0)
        K = local.Ks[i]
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        inside = ahead & (u >= 0) & (u < local.widths[i]) & (v >= 0) & (v < local.heights[i])
        out[i] = np.median(z[inside]) if inside.any() else 0.0
    return out


def _likeness(cameras: Cameras, depths: Float) -> Float:
    """(C, C) exp(−(d/0.35)²): d² = |Δposition|²/(depth·depth) + |Δdirection|²: parallax and turn."""
    seen = depths[depths > 0]
    scale = np.where(depths > 0, depths, np.median(seen) if len(seen) else 1.0)
    positions = cameras.positions - cameras.positions.mean(0)
    away = _squares(positions) / (scale[:, None] * scale)
    return np.exp(-(away + _squares(cameras.forwards)) / _BANDWIDTH**2)


def _squares(rows: Float) -> Float:
    """(n, n) squared distances; exactly 0 between equal rows."""
    out = np.zeros((len(rows), len(rows)))
    for column in rows.T:
        out += (column[:, None] - column) ** 2
    return out


def _demand(alike: Float) -> Float:
    """(C,) how much each pose asks to be represented: less the more poses are like it; sums to 1."""
    weights = 1 / alike.sum(1)
    return weights / weights.sum()


def _represent(alike: Float, wanted: Float, usable: NDArray[np.bool_]) -> tuple[Order, Float]:
    """Greedy facility location: Σ_u w_u max_{v∈S} alike_uv."""
    wanted = np.where(usable, wanted, 0.0)
    best, left = np.zeros(len(alike)), usable.copy()
    order, gains = [], []
    for _ in range(int(usable.sum())):
        gain = wanted @ np.maximum(alike - best[:, None], 0.0)
        view = int(np.argmax(np.where(left, gain, -1.0)))
        order.append(view)
        gains.append(float(gain[view]))
        best = np.maximum(best, alike[:, view])
        left[view] = False
    return np.array(order, np.int64), np.array(gains)


def _gains_of(order: Order, alike: Float, wanted: Float) -> Float:
    """What each view of a given order adds to the facility location."""
    best, gains = np.zeros(len(alike)), []
    for view in order:
        gains.append(float(wanted @ np.maximum(alike[:, view] - best, 0.0)))
        best = np.maximum(best, alike[:, view])
    return np.array(gains)


def _farthest(alike: Float, usable: NDArray[np.bool_]) -> tuple[Order, Float]:
    """Farthest pose next, from the one most like all others; gains are distances to the nearest chosen."""
    if not usable.any():
        return np.zeros(0, np.int64), np.zeros(0)
    away = np.sqrt(-np.log(np.maximum(alike, np.finfo(np.float64).tiny)))
    first = int(np.argmax(np.where(usable, alike[:, usable].sum(1), -1.0)))
    order, gains = [first], [float(away[usable, first].max())]
    nearest = np.where(usable, away[first], -1.0)
    nearest[first] = -1.0
    for _ in range(int(usable.sum()) - 1):
        view = int(np.argmax(nearest))
        order.append(view)
        gains.append(float(nearest[view]))
        nearest = np.where(nearest >= 0, np.minimum(nearest, away[view]), -1.0)
        nearest[view] = -1.0
    return np.array(order, np.int64), np.array(gains)


def _blind(policy: str, rows: Order, k: int | Literal["auto"], seed: int) -> Order:
    if k == "auto":
        raise InputError(f"k: 'auto' needs a policy that measures what views add, not {policy!r}")
    if policy == "random":
        return np.random.default_rng([seed, 7]).permutation(rows)
    count = min(k, len(rows))
    chosen = np.floor((np.arange(count) + 0.5) * len(rows) / max(count, 1)).astype(np.int64)
    return np.concatenate([rows[chosen], np.delete(rows, chosen)])


def _knee(gains: Float) -> int:
    """The count at which the curve of summed gains lies farthest above its chord.

    >>> _knee(np.array([5.0, 4.0, 3.0, 0.1, 0.1, 0.1, 0.1]))
    3
    """
    total = gains.sum()
    if not total > 0:
        return len(gains)
    above = np.cumsum(gains) / total - np.arange(1, len(gains) + 1) / len(gains)
    return int(np.argmax(above)) + 1


def _draw_weights(order: Order, alike: Float, wanted: Float) -> Float:
    """(K,) the demand of the poses that each chosen view is nearest to, mean 1."""
    nearest = order[np.argmax(alike[:, order], axis=1)]
    nearest[order] = order  # each stands for itself, equals included
    weights = np.bincount(nearest, wanted, len(alike))[order]
    return weights / weights.mean()
