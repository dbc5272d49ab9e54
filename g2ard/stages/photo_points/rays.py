"""Points along camera rays, each at the depth where photos of nearby views agree best on its colour.

A plane sweep, one ray of a random pixel at a time, within the visual hull of photos with alpha. The points
are a start for distillation, not a reconstruction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from g2ard.arrays import Float, Float32, Int, Mask
from g2ard.config.choices import BLACK, Colour
from g2ard.errors import InputError
from g2ard.io.photos import composite, load_photo
from g2ard.io.types import Points
from g2ard.progress import Progress, plural, silent
from g2ard.scene.cameras import Cameras, within_frame
from g2ard.scene.reproducible import merge_equal
from g2ard.stages.photo_points.hull import VisualHull, grown, visual_hull

_TRIAL_DEPTHS = 48
_HULL_DEPTHS = 96
"""Trial depths across a visual hull."""
_NEAREST_DEPTH = 0.3
"""Nearest trial depth as a multiple of the view's distance from the common centre. Trial depths are evenly
spaced in 1/z."""
_FARTHEST_DEPTH = 4.0
"""Farthest trial depth as a multiple of the same distance."""
_EMPTY_COLOUR_SLACK = 2 / 255
"""A pixel this close to the background colour is empty."""
_EQUAL_COST_SLACK = 0.01
"""Difference of costs within which depths in a hull count as equal."""
_COMPARED_VIEWS = 6
"""Number of nearby views compared."""
_AGREEING_VIEWS = 2
"""Number of compared views that agree best, whose mean counts."""
_PATCH = np.array(
    [
        (0, 0),
        (-1, -1),
        (-1, 0),
        (-1, 1),
        (0, -1),
        (0, 1),
        (1, -1),
        (1, 0),
        (1, 1),
    ]
)
_PATCH_SPACING = 120
"""Rows and columns of the compared pixels, from a ray's own, in units of this part of the photo's side."""
_REFINED_DEPTHS = 3
"""Depths of a ray that are refined."""
_FINER_DEPTHS = 5
"""Finer trials around each refined depth."""
_MOST_POINT_COST = 0.05
"""Largest cost of a point."""
_MOST_POINT_COST_SHARE = 0.25
"""Largest cost of a point as a share of the usual cost on its ray."""
_RAYS_PER_DOUBLING = 8
"""Rays per requested point after which both limits of cost are doubled."""
_RAYS = 2048
"""Rays at a time."""


def distinct(points: Points) -> Points:
    """Merge points of one position, as lifting does, so that what is missing can be counted."""
    if not len(points):
        return points
    rows, colors = merge_equal(
        points.positions - np.median(points.positions, axis=0), points.colors
    )
    if len(rows) == len(points):
        return points
    return Points(points.positions[rows], np.ascontiguousarray(colors, np.float32))


def points_along_rays(
    cameras: Cameras,
    count: int,
    *,
    background: Colour = BLACK,
    seed: int = 0,
    progress: Progress = silent,
) -> Points:
    """Place points on the rays of random pixels, where nearby photos agree best on the colour.

    z* = argmin_z of the mean difference of a patch around the pixel from those of the two nearby views that
    agree best. Points on which no photo agrees, or on whose ray many depths agree, are dropped; these limits
    are relaxed if too few points remain. If photos have alpha, only pixels that show the object count, and
    points lie in its visual hull. Masked pixels show nothing, neither the object nor that it is elsewhere.

    Args:
        cameras: C ≥ 3 views with photos, in world coordinates.
        background: RGB of empty pixels.

    Returns:
        `count` points at different positions in world coordinates, with the colour of their ray's pixel.
    """
    if len(cameras) < 3:
        raise InputError(
            f"points along camera rays need 3 training views; there are {len(cameras)}",
            hint="pass more photos, a point cloud or a scene",
        )
    bare = [
        name for name, path in zip(cameras.names, cameras.image_paths, strict=True) if path is None
    ]
    if bare:
        raise InputError(
            f"view {bare[0]} has no photo",
            hint="pass views with photos, their {images=DIR}, or a scene",
        )
    photos: list[_Photo] = []
    outlines: list[Mask | None] = []
    for view in range(len(cameras)):
        image, mask = load_photo(cameras, view, None)
        if image.shape[2] == 4:
            outline = image[..., 3] > 0.5
        else:
            outline = None
        photos.append(_Photo.of(composite(image, background), mask, outline, background))
        if outline is not None and mask is not None:
            outline = outline | ~mask  # masked pixels do not say that the object is elsewhere
        outlines.append(outline)
        progress("photos", view + 1, len(cameras))
    rng = np.random.default_rng([seed, 11])
    centre = _find_common_centre(cameras)
    distances = np.linalg.norm(cameras.positions - centre, axis=1)
    near = [_find_neighbours(cameras, i) for i in range(len(cameras))]
    hull = visual_hull(cameras, outlines, centre)
    found = Points(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    tried = 0
    while len(found) < count:
        if tried > 64 * max(count, _RAYS):
            raise InputError(
                f"photos: found {plural(len(found), 'point')} that three views see, needed {count:,}",
                hint="pass a point cloud" + (", or ask for fewer Gaussians" if len(found) else ""),
            )
        view = int(rng.integers(len(cameras)))
        some = min(_RAYS, max(64, -(-count // len(cameras))))
        starts = photos[view].starts
        rows = rng.integers(starts.shape[0], size=some)
        columns = rng.integers(starts.shape[1], size=some)
        pixels = np.stack([rows, columns])[:, starts[rows, columns]]
        if hull is None:
            depths = distances[view] / np.linspace(
                1 / _NEAREST_DEPTH, 1 / _FARTHEST_DEPTH, _TRIAL_DEPTHS
            )
        else:
            depths = hull.depths(cameras, view, _HULL_DEPTHS)
        slack = 2.0 ** (tried // (_RAYS_PER_DOUBLING * max(count, _RAYS)))
        rays = _Rays.of(cameras, photos, view, near[view], pixels)
        xyz, rgb = _sweep(rays, depths, hull, slack)
        tried += some
        positions = np.concatenate([found.positions, xyz])
        found = distinct(Points(positions, np.concatenate([found.colors, rgb])))
        progress("points", min(len(found), count), count)
    return Points(
        found.positions[:count],
        np.ascontiguousarray(found.colors[:count]),
    )


def _find_common_centre(cameras: Cameras) -> Float:
    """Return the (3,) point nearest to all optical axes, or a point ahead of the mean camera if they hardly
    cross."""
    positions = cameras.positions
    forwards = cameras.forwards
    away = cameras.extent or 1.0
    ahead = positions.mean(0) + away * forwards.mean(0)
    # Least squares over the distances to the axes: Σ (I − f·fᵀ)·(x − p) = 0.
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    pull = across.sum(0)
    if np.linalg.cond(pull) > 1e4:
        return ahead
    middle = np.linalg.solve(pull, np.einsum("cij,cj->i", across, positions))
    is_ahead = np.einsum("ci,ci->c", middle - positions, forwards) > 0
    return middle if is_ahead.mean() > 0.5 else ahead


def _find_neighbours(cameras: Cameras, view: int) -> Int:
    """Return the views nearest to one in position and direction."""
    positions = cameras.positions
    away = np.linalg.norm(positions - positions[view], axis=1) / (cameras.extent or 1.0)
    turn = 1 - cameras.forwards @ cameras.forwards[view]
    order = np.argsort(away + turn, kind="stable")
    return order[order != view][:_COMPARED_VIEWS]


@dataclass(frozen=True, eq=False)
class _Photo:
    """A photo.

    Args:
        image: (H, W, 3) colours.
        valid: (H, W) unmasked pixels.
        starts: (H, W) pixels that show anything, in a patch without masked pixels.
        step: pixels from a patch's middle to its sides.
    """

    image: Float32
    valid: Mask
    starts: Mask
    step: int

    @classmethod
    def of(
        cls,
        image: Float32,
        mask: Mask | None,
        outline: Mask | None,
        background: Colour,
    ) -> _Photo:
        step = max(1, round(max(image.shape) / _PATCH_SPACING))
        if outline is None:
            shown = np.abs(image - background).max(2) > _EMPTY_COLOUR_SLACK
        else:
            shown = outline
        if mask is None:
            return cls(image, np.ones_like(shown), shown, step)
        return cls(image, mask, shown & ~grown(~mask, step), step)


def _sweep(
    ray: _Rays,
    depths: Float,
    hull: VisualHull | None,
    slack: float,
) -> tuple[Float, Float32]:
    """Return points on rays, with colours.

    Points lie within the hull if there is one. Without one, a point must agree with other photos, and
    clearly better than most depths of its ray; `slack` multiplies both limits.
    """
    trial = np.broadcast_to(depths, (len(ray.colors), len(depths)))
    cost = ray.costs(trial)
    rows = np.arange(len(cost))
    if hull is not None:
        cost[~hull.holds(ray.at(trial))] = np.inf
        is_best = cost <= cost.min(1, keepdims=True) + _EQUAL_COST_SLACK
        nearest = is_best.argmax(1)  # the nearest is on the hull
        depth = trial[rows, nearest]
        kept = np.isfinite(cost[rows, nearest])
    else:
        finite = np.isfinite(cost)
        middle = np.maximum(finite.sum(1) // 2, 1) - 1
        usual = np.sort(cost, axis=1)[rows, middle]  # the median, since infinities are sorted last
        depth, least = _refine(ray, trial, cost)
        limit = np.minimum(_MOST_POINT_COST, _MOST_POINT_COST_SHARE * usual)
        kept = finite.any(1) & (least <= slack * limit)
    return ray.at(depth[:, None])[kept, 0], ray.colors[kept]


def _refine(ray: _Rays, trial: Float, cost: Float) -> tuple[Float, Float]:
    """Return the (N,) best depths and their costs, from finer trials around the best minima of each ray.

    `trial` and `cost` are (N, D); depths are evenly spaced in 1/depth. The finer trials reach three quarters
    of a spacing to both sides, past the middle between two trials.
    """
    padded = np.pad(cost, ((0, 0), (1, 1)), constant_values=np.inf)
    is_minimum = cost <= padded[:, :-2]
    is_minimum &= cost <= padded[:, 2:]
    minima = np.where(is_minimum, cost, np.inf)
    order = np.argsort(minima, axis=1, kind="stable")[:, :_REFINED_DEPTHS]
    rows = np.arange(len(cost))
    inverse_depth = 1 / trial[rows[:, None], order]
    inverse_depth = inverse_depth[:, :, None]
    spacing = np.abs(1 / trial[:, :1] - 1 / trial[:, 1:2])
    offsets = np.linspace(-0.75, 0.75, _FINER_DEPTHS)
    tried = inverse_depth + offsets * spacing[:, :, None]
    finer = 1 / np.maximum(tried, 1e-3 * inverse_depth)
    finer = finer.reshape(len(cost), order.shape[1] * len(offsets))  # there may be no ray
    costs = ray.costs(finer)
    best = costs.argmin(1)
    return finer[rows, best], costs[rows, best]


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays of some pixels of a view, each with the rays of its neighbours.

    Args:
        others: views to compare with.
        origin: (3,) the camera's centre.
        aims: (N, P, 3) world directions at depth 1; the pixel's own first.
        patches: (N, P, 3) colours.
    """

    cameras: Cameras
    photos: list[_Photo]
    others: Int
    origin: Float
    aims: Float
    patches: Float

    @classmethod
    def of(
        cls,
        cameras: Cameras,
        shots: list[_Photo],
        view: int,
        others: Int,
        pixels: Int,
    ) -> _Rays:
        photo = shots[view]
        pose = cameras.viewmats[view]
        height, width, _ = photo.image.shape
        patch_rows, patch_columns = (_PATCH * photo.step).T
        rows = np.clip(pixels[0][:, None] + patch_rows, 0, height - 1)
        columns = np.clip(pixels[1][:, None] + patch_columns, 0, width - 1)
        seen = np.stack(
            [
                columns + 0.5,
                rows + 0.5,
                np.ones(rows.shape),
            ],
            axis=-1,
        )
        return cls(
            cameras,
            shots,
            others,
            origin=cameras.positions[view],
            aims=seen @ np.linalg.inv(cameras.Ks[view]).T @ pose[:3, :3],
            patches=photo.image[rows, columns].astype(np.float64),
        )

    @property
    def colors(self) -> Float32:
        """Colours of the pixels, (N, 3)."""
        return self.patches[:, 0].astype(np.float32)

    def at(self, depths: Float) -> Float:
        """Return the (N, D, 3) world points of the pixels at (N, D) depths."""
        return self.origin + self.aims[:, :1] * depths[..., None]

    def costs(self, depths: Float) -> Float:
        """Return (N, D) differences of the patches to the views that agree best; ∞ if too few see them."""
        own_costs = np.full((len(self.others), *depths.shape), np.inf)
        for k, other in enumerate(self.others.tolist()):
            total = np.zeros(depths.shape)
            inside = np.ones(depths.shape, bool)
            for p in range(self.aims.shape[1]):
                world = self.origin + self.aims[:, p : p + 1] * depths[..., None]
                color, held = self._sampled(other, world)
                difference = np.abs(color - self.patches[:, p : p + 1])
                total += difference.mean(-1)
                inside &= held
            own_costs[k][inside] = total[inside] / self.aims.shape[1]
        own_costs.sort(axis=0)
        return own_costs[:_AGREEING_VIEWS].mean(0)

    def _sampled(self, view: int, world: Float) -> tuple[Float, Mask]:
        """Return the colours of world points in a photo, and whether it shows them; black if not."""
        photo = self.photos[view]
        height, width, _ = photo.image.shape
        pose = self.cameras.viewmats[view]
        (fx, _, cx), (_, fy, cy), _ = self.cameras.Ks[view]
        x, y, z = np.moveaxis(
            world @ pose[:3, :3].T + pose[:3, 3],
            -1,
            0,
        )
        ahead = z > 0
        depth = np.where(ahead, z, 1.0)
        u = np.floor(fx * x / depth + cx)
        v = np.floor(fy * y / depth + cy)
        held = ahead & within_frame(u, v, width, height)
        rows = np.where(held, v, 0).astype(int)
        columns = np.where(held, u, 0).astype(int)
        held &= photo.valid[rows, columns]
        colors = photo.image[rows, columns]
        return np.where(held[..., None], colors, 0.0), held
