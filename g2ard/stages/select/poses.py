"""View selection by poses: a kernel between poses, representatives, and sampling weights."""

from dataclasses import dataclass, replace

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Int, Mask
from g2ard.errors import InputError
from g2ard.progress import Progress, counter, silent
from g2ard.scene.cameras import Cameras, unseeing, within_frame
from g2ard.scene.splats import Splats
from g2ard.stages.select.surfaces import Surface, core_scene, core_views, surface

_KERNEL_BANDWIDTH = 0.35
"""Bandwidth of the kernel exp(−(d/0.35)²): neighbours 20° apart on an orbit have similarity ½."""
_KERNEL_REACH = 2.0
"""Distance in bandwidths within which a chosen view represents a pose; beyond, the kernel is below 2 %."""
_SCENE_SHARE_EXPONENT = 0.25
"""Exponent of a view's share of the scene in the weight of its gain."""
_COARSE_CELLS = 20_000
"""Number of surface cells when only depths matter."""
_DEPTH_GRID = 48, 36
_HIDDEN_DEPTH_RATIO = 1.15
"""A point farther than this multiple of the nearest depth in its grid cell is hidden."""
_INSIDE_SAMPLE = 50_000
"""Largest sample of Gaussians for detecting poses inside geometry, about thirty a pixel; sampled ones are
enlarged."""
_INSIDE_RENDER_SIDE = 48
"""Longer side in pixels of the renders for that."""
_INSIDE_DEPTH_SHARE = 0.02
"""A pose is inside geometry if most of its image is nearer than this share of the median depth."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses of C candidate views.

    Args:
        alike: (C, C) from `pose_kernel`.
        weights: (C,) from `inverse_density`.
        shares: (C,) from `outlooks`.
        usable: (C,) mask of views that see the scene and are not inside geometry.
    """

    alike: Float
    weights: Float
    shares: Float
    usable: Mask


def measure_candidates(splats: Splats, cameras: Cameras, progress: Progress = silent) -> Candidates:
    """Compare the poses of views of a scene.

    Raises:
        InputError: none is usable.
    """
    coarse = surface(splats, min(_COARSE_CELLS, max(1, len(splats))))
    depths, shares = outlooks(coarse, cameras)
    alike = pose_kernel(cameras, depths)
    usable = (depths > 0) & ~inside_geometry(splats, cameras, depths, progress)
    if not usable.any():
        raise InputError(unseeing(cameras, "the scene"))
    return Candidates(alike, inverse_density(alike), shares, usable)


def outlooks(cells: Surface, cameras: Cameras) -> tuple[Float, Float]:
    """Measure what each view sees of a coarse surface.

    Returns:
        (C,) the median depth of the cells in its image, 0 if there are none; and (C,) the share of all cells
        that are visible there, by occlusion in a grid of 48 × 36.
    """
    local = cameras.recentred(cells.origin)
    depths = np.zeros(len(local))
    shares = np.zeros(len(local))
    columns, rows = _DEPTH_GRID
    for i, view in enumerate(local):
        x, y, z = view.viewmat[:3, :3] @ cells.centers.T + view.viewmat[:3, 3:]
        ahead = z > 0
        z = np.where(ahead, z, 1.0)
        (fx, _, cx), (_, fy, cy), _ = view.K
        u = fx * x / z + cx
        v = fy * y / z + cy
        inside = ahead & within_frame(u, v, view.width, view.height)
        if not inside.any():
            continue
        z = z[inside]
        row = (v[inside] * rows / view.height).astype(int)
        column = (u[inside] * columns / view.width).astype(int)
        place = row * columns + column
        nearest = np.full(columns * rows, np.inf)
        np.minimum.at(nearest, place, z)
        visible = z < _HIDDEN_DEPTH_RATIO * nearest[place]
        depths[i] = np.median(z)
        shares[i] = np.count_nonzero(visible) / len(cells.centers)
    return depths, shares


def inside_geometry(
    splats: Splats,
    cameras: Cameras,
    depths: Float,
    progress: Progress,
) -> Mask:
    """Return a (C,) mask of poses inside geometry; poses of photos are never marked.

    `depths` comes from `outlooks`.
    """
    made = np.array([path is None for path in cameras.image_paths])
    known = depths > 0
    if not (made.any() and known.any()):
        return np.zeros(len(cameras), bool)
    step = -(-len(splats) // _INSIDE_SAMPLE)
    sample = splats.take(np.arange(0, len(splats), step))
    sample = replace(sample, scales=sample.scales * np.float32(np.sqrt(step)))
    scene, origin = core_scene(sample)
    small = core_views(cameras.resized(_INSIDE_RENDER_SIDE), origin, scene)
    statistics = _core.select_view_statistics(scene, small, progress=counter(progress, "poses"))
    share, near = statistics.T
    typical = np.median(np.where(near > 0, near, depths)[known])
    inside: Mask = made & (share > 0.5)
    inside &= near < _INSIDE_DEPTH_SHARE * typical
    return inside


def pose_kernel(cameras: Cameras, depths: Float) -> Float:
    """Return (C, C) exp(−(d/0.35)²) with d² = |Δposition|²/(depth·depth) + |Δdirection|²: parallax and
    rotation."""
    known = depths > 0
    usual = 1.0
    if known.any():
        usual = float(np.median(depths[known]))
    scale = np.where(known, depths, usual)
    # robust to a single far pose
    positions = cameras.positions - np.median(cameras.positions, axis=0)
    with np.errstate(over="ignore", invalid="ignore"):  # squares of 1e300 overflow to infinity
        away = np.nan_to_num(_measure_squares(positions), nan=np.inf)
        away = away / (scale[:, None] * scale)
    away += _measure_squares(cameras.forwards)
    return np.exp(-away / _KERNEL_BANDWIDTH**2)


def _measure_squares(rows: Float) -> Float:
    """Return (n, n) squared distances, exactly 0 between equal rows."""
    out = np.zeros((len(rows), len(rows)))
    for column in rows.T:
        out += (column[:, None] - column) ** 2
    return out


def inverse_density(alike: Float) -> Float:
    """Return (C,) weights inverse to the kernel density, with sum 1."""
    weights = 1 / alike.sum(1)
    return weights / weights.sum()


def facility_location(
    alike: Float,
    pose_weights: Float,
    usable: Mask,
    shares: Float,
) -> Int:
    """Order views by how well they represent all candidates: reach first, then facility location.

    From the weighted medoid, the farthest pose comes next while any pose is more than two bandwidths from all
    chosen ones, where the kernel is flat. Greedy facility location follows. A view's gain is multiplied by
    the fourth root of its share of the scene, to prefer the one that sees more among similar views.

    Args:
        alike: (C, C) from `pose_kernel`.
        pose_weights: (C,) from `inverse_density`, 0 for unusable views.
        usable: (C,) mask of views that may be chosen.
        shares: (C,) from `outlooks`.
    """
    away = bandwidths_apart(alike)
    worth = shares**_SCENE_SHARE_EXPONENT
    # likeness of each candidate to the chosen view that is most like it
    best = np.zeros(len(alike))
    left = usable.copy()
    nearest = np.where(usable, np.inf, -np.inf)  # distance to the nearest chosen view
    order: list[int] = []
    for _ in range(int(usable.sum())):
        if not order:
            spread = np.maximum(pose_weights @ away, 1e-12)
            gains = np.where(left, worth / spread, -1.0)
        elif nearest.max() > _KERNEL_REACH:
            gains = worth * np.where(nearest > _KERNEL_REACH, nearest, 0.0)
        else:
            added = pose_weights @ np.maximum(alike - best[:, None], 0.0)
            gains = np.where(left, worth * added, -1.0)
        view = int(np.argmax(gains))
        order.append(view)
        best = np.maximum(best, alike[:, view])
        nearest = np.minimum(nearest, away[view])
        left[view] = False
    return np.array(order, np.int64)


def bandwidths_apart(alike: Float) -> Float:
    """Return (C, C) distances in bandwidths of the kernel."""
    tiny = np.finfo(np.float64).tiny
    exponents = -np.log(np.maximum(alike, tiny))
    return np.asarray(np.sqrt(exponents))


def gains_of(order: Int, alike: Float, pose_weights: Float) -> Float:
    """Return the gain of each view of an order in facility location, Σ_u w_u max_{v∈S} alike_uv."""
    best = np.zeros(len(alike))
    gains = []
    for view in order:
        gains.append(float(pose_weights @ np.maximum(alike[:, view] - best, 0.0)))
        best = np.maximum(best, alike[:, view])
    return np.array(gains)


def draw_weights(order: Int, alike: Float, pose_weights: Float) -> Float:
    """Return (K,) summed weights of the poses nearest to each chosen view, with mean 1."""
    nearest = order[np.argmax(alike[:, order], axis=1)]
    nearest[order] = order  # each is its own nearest, even among equal poses
    weights = np.bincount(nearest, pose_weights, len(alike))[order]
    return weights / weights.mean()
