"""Starting points from photos with poses: COLMAP's sparse points, and as a fallback points along camera rays.

A point along a camera ray lies on the ray of a random pixel, at the depth where photos of nearby views agree
best on its colour (a plane sweep, one ray at a time), and within the visual hull of photos with alpha. The
points are a start for distillation, not a reconstruction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import BLACK, Colour
from g2ard.errors import G2ardError, InputError
from g2ard.io import Source, read_cloud
from g2ard.io.detect import file_format
from g2ard.io.finding import Finder
from g2ard.io.jsonfile import read_json
from g2ard.io.paths import real_path
from g2ard.io.photos import composited, load_photo
from g2ard.io.stream import PointStream
from g2ard.io.types import Cloud, Points, ViewFiles
from g2ard.jobs.inputs import Views
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.stages.lift import merged

_COARSE_VOXELS = 64
"""Voxels per side of the grid that finds the object's box."""
_FINE_VOXELS = 128
"""Voxels per side of the grid within that box."""
_EMPTY_VIEWS_SHARE = 0.02
"""Share of the views that may see a voxel as empty, because single outlines have errors."""
_SEEING_VIEWS_SHARE = 0.25
"""Least share of the views that must contain a voxel."""

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class VisualHull:
    """A grid of voxels.

    Args:
        low: (3,) corner of the grid, world units.
        side: (3,) sides of a voxel.
        filled: (X, Y, Z), whether a voxel may be occupied.
    """

    low: Float
    side: Float
    filled: Mask

    def holds(self, points: Float) -> Mask:
        """Return whether (…, 3) world points lie in filled voxels."""
        at = np.floor((points - self.low) / self.side).astype(np.int64)
        inside: Mask = np.all((at >= 0) & (at < self.filled.shape), axis=-1)
        x, y, z = np.moveaxis(np.where(inside[..., None], at, 0), -1, 0)
        inside_hull: Mask = inside & self.filled[x, y, z]
        return inside_hull

    def depths(self, cameras: Cameras, view: int, count: int) -> Float:
        """Return (count,) depths that cover the grid's box in a view, evenly spaced."""
        corners = self.low + np.indices((2, 2, 2)).reshape(3, 8).T * self.side * self.filled.shape
        depth = corners @ cameras.viewmats[view, 2, :3] + cameras.viewmats[view, 2, 3]
        return np.linspace(max(depth.min(), 1e-3 * depth.max()), depth.max(), count)


def visual_hull(cameras: Cameras, outlines: Sequence[Mask | None], middle: Float) -> VisualHull | None:
    """Carve away every voxel that photos show to be empty.

    Args:
        outlines: (H, W) pixels that show the object, per view; None for a view that does not say.
        middle: (3,) a point that the cameras look at.

    Returns None if nothing remains, or the object is not outlined in enough views.
    """
    told = [v for v, outline in enumerate(outlines) if outline is not None and not bool(outline.all())]
    if len(told) < max(3, _SEEING_VIEWS_SHARE * len(cameras)):
        return None
    half = float(np.median(np.linalg.norm(cameras.positions - middle, axis=1)))
    told = np.random.default_rng(0).permutation(told).tolist()  # other directions carve sooner
    low, size = middle - half, np.full(3, 2 * half)
    for count in (_COARSE_VOXELS, _FINE_VOXELS):
        side = size / count
        middle = low + size / 2
        views = [_outlined(cameras, view, outlines[view], middle, side) for view in told]
        filled = _carved(views, low, side, count)
        if not filled.any():
            return None
        occupied = np.argwhere(filled)
        hull = VisualHull(low, side, filled)
        low, size = low + (occupied.min(0) - 1) * side, (np.ptp(occupied, 0) + 3) * side
    return hull


def _outlined(
    cameras: Cameras, view: int, outline: Mask | None, middle: Float, side: Float
) -> tuple[Float, Mask]:
    """Return a view's (3, 4) projection to pixels, and the pixels that a voxel touching the object may have:
    the outline, grown by half the diagonal of a voxel."""
    assert outline is not None
    projection = cameras.Ks[view] @ cameras.viewmats[view, :3]
    depth = float(projection[2, :3] @ middle + projection[2, 3])
    radius = 0.5 * float(np.linalg.norm(side)) * cameras.Ks[view, 0, 0] / max(depth, side.max())
    return projection, grown(outline, int(np.ceil(radius)))


def _carved(views: Sequence[tuple[Float, Mask]], low: Float, side: Float, count: int) -> Mask:
    """Return the (count, count, count) voxels that are in sight and within the outlines."""
    steps = np.arange(count) + 0.5
    filled = np.zeros((count, count * count), bool)
    plane = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2) * side[1:] + low[1:]
    for slab, x in enumerate(low[0] + steps * side[0]):
        points, left = plane, np.arange(len(plane))
        empty, seen = np.zeros(len(plane), np.int16), np.zeros(len(plane), np.int16)
        for P, shown in views:
            ahead = points @ P[:, 1:3].T + (P[:, 0] * x + P[:, 3])
            depth = np.maximum(ahead[:, 2], 1e-9)
            u, v = (ahead[:, :2] / depth[:, None]).T
            inside = (ahead[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < shown.shape[1]) & (v < shown.shape[0])
            hit = shown[np.where(inside, v, 0).astype(np.intp), np.where(inside, u, 0).astype(np.intp)]
            seen += inside
            empty += inside & ~hit
            kept = empty <= _EMPTY_VIEWS_SHARE * len(views)
            if not kept.all():
                points, left, empty, seen = points[kept], left[kept], empty[kept], seen[kept]
        filled[slab, left] = seen >= _SEEING_VIEWS_SHARE * len(views)
    return filled.reshape(count, count, count)


def grown(mask: Mask, radius: int) -> Mask:
    """Return the pixels within `radius` of a mask's, along both axes.

    >>> grown(np.eye(4, dtype=bool)[:2], 1).astype(int).tolist()
    [[1, 1, 1, 0], [1, 1, 1, 0]]
    """
    for axis in (0, 1):
        pad = [(radius + 1, radius) if k == axis else (0, 0) for k in range(2)]
        sums = np.cumsum(np.pad(mask, pad).astype(np.int32), axis=axis)
        span = 2 * radius + 1
        first = np.arange(mask.shape[axis])
        mask = sums.take(first + span, axis) > sums.take(first, axis)
    return mask


_PIXELS_PER_GAUSSIAN = 100
"""Pixels per Gaussian, if no count is given."""
_MOST_USUAL_COUNT = 100_000
"""Most Gaussians, if no count is given."""
_SAMPLED_PHOTOS = 16
"""Photos that are looked at, if no count is given."""
_PHOTO_SIDE = 240
"""Longer side in pixels of the photos used to place points."""
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
_PATCH = np.array([(0, 0), (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])
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


def topped_up(
    points: Points | None,
    train: Cameras,
    count: int,
    *,
    background: Colour,
    seed: int,
    progress: Progress,
    say: Say,
) -> Points:
    """Add points along the camera rays of training views until there are `count`."""
    sparse = 0 if points is None else len(points)
    parts = [] if points is None else [points]
    told = [plural(sparse, "sparse point")] if sparse else []
    if (missing := count - sparse) > 0:
        small = train.fitted(_PHOTO_SIDE)
        parts.append(points_along_rays(small, missing, background=background, seed=seed, progress=progress))
        told.append(f"{plural(missing, 'point')} along camera rays")
    say(f"starting from {' and '.join(told)}")
    return Points(
        np.concatenate([part.positions for part in parts]), np.concatenate([part.colors for part in parts])
    )


def rough_points(points: Points | None, train: Cameras, count: int) -> Points:
    """Return `count` points for a dry run: those given, and others anywhere among the cameras."""
    own = points or Points(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    missing = max(0, count - len(own))
    places = train.positions if not len(own) else own.positions
    low, high = places.min(axis=0), places.max(axis=0)
    others = np.random.default_rng(0).uniform(low, high + np.ptp(places), (missing, 3))
    shades = np.full((missing, 3), 0.5, np.float32)
    return Points(np.concatenate([own.positions, others]), np.concatenate([own.colors, shades]))


def usual_count(train: Cameras, size: int | None, sparse: int, say: Say) -> int:
    """Return the Gaussians of a scene that starts from photos alone, to two digits, and say so.

    A Gaussian of SH degree 3 has 59 numbers, as many as 20 pixels. One per 100 pixels of the training photos
    has five times as many equations as unknowns. There are at most 100,000, which take about ten minutes on
    two cores, or as many as sparse points.

    Args:
        train: training views.
        size: longer side of the photos in pixels, if they are larger.
    """
    cameras, small = train.resized(size), train.resized(_PHOTO_SIDE)
    shares = [_shown_share(small, view) for view in evenly_spaced(len(small), _SAMPLED_PHOTOS)]
    pixels = float((cameras.widths.astype(np.int64) * cameras.heights).sum()) * float(np.mean(shares))
    most = max(_MOST_USUAL_COUNT, sparse)
    found = max(1, int(float(f"{min(pixels / _PIXELS_PER_GAUSSIAN, most):.2g}")))
    photos = plural(len(cameras), "photo")
    say(f"{plural(found, 'Gaussian')}, one per {pixels / found:.0f} pixels of {photos}; a count changes it")
    return found


def _shown_share(cameras: Cameras, view: int) -> float:
    """Return the share of a view's pixels that show something; 1 without a photo."""
    if cameras.image_paths[view] is None:
        return 1.0
    image, mask = load_photo(cameras, view, None)
    shown = image[..., 3] > 0.5 if image.shape[2] == 4 else np.ones(image.shape[:2], bool)
    return float((shown if mask is None else shown & mask).mean())


def distinct(points: Points) -> Points:
    """Merge points of one position, as lifting does, so that what is missing can be counted."""
    if not len(points):
        return points
    rows, colors = merged(points.positions - np.median(points.positions, axis=0), points.colors)
    if len(rows) == len(points):
        return points
    return Points(points.positions[rows], np.ascontiguousarray(colors, np.float32))


def placed_by(train: Cameras, file: Path) -> Cloud:
    """Read the points of `sparse_file` that training views see, as far as the file states who does."""
    return placed_source(Source(file), train).cloud(bare=True).whole()


def placed_source(scene: Source, train: Cameras) -> Source:
    """Return points without those that the file says fewer than two training views see."""
    if scene.format != "points3d":
        return scene
    import g2ard.io.points3d as points3d

    placed, chosen = Source(scene.path), scene.through

    def through(stream: PointStream) -> PointStream:
        seen = points3d.Stream(stream.path, train.names)
        return chosen(seen) if chosen else seen

    placed.through = through
    return placed


def is_sparse_file(scene: Source, views: Views) -> bool:
    """Return whether points are those of `sparse_file`."""
    file = sparse_file(views)
    given = (scene.kind == "views" and sparse_file(scene.path)) or scene.path
    return file is not None and real_path(given) == real_path(file)


def sparse_points(file: Path | None, say: Say = unsaid, train: Cameras | None = None) -> Cloud | None:
    """Read the points of `sparse_file`; return None, and say why, if no point is readable.

    With training views, points that these do not see are skipped.
    """
    try:
        if file is None:
            return None
        cloud = read_cloud(file, bare=True) if train is None else placed_by(train, file)
    except G2ardError as error:
        say(f"warning: no starting points from photos: {error}")
        return None
    if len(cloud.points):
        return cloud
    say(f"warning: no starting points from photos: {file}: has no points")
    return None


def sparse_file(views: Views) -> Path | None:
    """Return the file of points of a COLMAP model, of a gsplat run's, of a transforms.json's `ply_file_path`,
    or the input.ply beside INRIA's cameras.json, which may not exist; None for other views."""
    import g2ard.io.colmap as colmap
    import g2ard.io.gsplat_run as gsplat_run
    import g2ard.io.transforms as transforms

    given = views.path if isinstance(views, ViewFiles) else views
    if not isinstance(given, str | Path):
        return None
    path = Path(given)
    found, folder = file_format(path), path if path.is_dir() else path.parent
    if found == "colmap":
        return colmap.points_file(path)
    if found == "gsplat_run":
        data = gsplat_run.data_of(path)
        return data and colmap.points_file(data)
    if found == "inria":
        input_file = folder / "input.ply"
        return input_file if input_file.is_file() else None
    if found != "transforms":
        return None
    file = path if path.is_file() else next(iter(transforms.files_of(path)))
    listed = read_json(file).get("ply_file_path")
    return Finder(file.parent).photo(str(listed)) if listed else None


def points_along_rays(
    cameras: Cameras, count: int, *, background: Colour = BLACK, seed: int = 0, progress: Progress = silent
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
    bare = [name for name, path in zip(cameras.names, cameras.image_paths, strict=True) if path is None]
    if bare:
        raise InputError(
            f"view {bare[0]} has no photo", hint="pass views with photos, their {images=DIR}, or a scene"
        )
    photos, outlines = list[_Photo](), list[Mask | None]()
    for view in range(len(cameras)):
        image, mask = load_photo(cameras, view, None)
        outline = image[..., 3] > 0.5 if image.shape[2] == 4 else None
        photos.append(_Photo.of(composited(image, background), mask, outline, background))
        outlines.append(outline if outline is None or mask is None else outline | ~mask)
        progress("photos", view + 1, len(cameras))
    rng = np.random.default_rng([seed, 11])
    centre = _common_centre(cameras)
    distances = np.linalg.norm(cameras.positions - centre, axis=1)
    near = [_neighbours(cameras, i) for i in range(len(cameras))]
    hull = visual_hull(cameras, outlines, centre)
    found, tried = Points(np.zeros((0, 3)), np.zeros((0, 3), np.float32)), 0
    while len(found) < count:
        if tried > 64 * max(count, _RAYS):
            raise InputError(
                f"photos: found {plural(len(found), 'point')} that three views see, needed {count:,}",
                hint="pass a point cloud" + (", or ask for fewer Gaussians" if len(found) else ""),
            )
        view = int(rng.integers(len(cameras)))
        some = min(_RAYS, max(64, -(-count // len(cameras))))
        rows, columns = (rng.integers(side, size=some) for side in photos[view].starts.shape)
        pixels = np.stack([rows, columns])[:, photos[view].starts[rows, columns]]
        if hull is None:
            depths = distances[view] / np.linspace(1 / _NEAREST_DEPTH, 1 / _FARTHEST_DEPTH, _TRIAL_DEPTHS)
        else:
            depths = hull.depths(cameras, view, _HULL_DEPTHS)
        slack = 2.0 ** (tried // (_RAYS_PER_DOUBLING * max(count, _RAYS)))
        rays = _Rays.of(cameras, photos, view, near[view], pixels)
        xyz, rgb = _swept(rays, depths, hull, slack)
        tried += some
        found = distinct(Points(np.concatenate([found.positions, xyz]), np.concatenate([found.colors, rgb])))
        progress("points", min(len(found), count), count)
    return Points(found.positions[:count], np.ascontiguousarray(found.colors[:count]))


def _common_centre(cameras: Cameras) -> Float:
    """Return the (3,) point nearest to all optical axes, or a point ahead of the mean camera if they hardly
    cross."""
    across = np.eye(3) - cameras.forwards[:, :, None] * cameras.forwards[:, None, :]
    pull = across.sum(0)
    away = cameras.extent or 1.0
    ahead = cameras.positions.mean(0) + away * cameras.forwards.mean(0)
    if np.linalg.cond(pull) > 1e4:
        return ahead
    middle = np.linalg.solve(pull, np.einsum("cij,cj->i", across, cameras.positions))
    before = np.einsum("ci,ci->c", middle - cameras.positions, cameras.forwards) > 0
    return middle if before.mean() > 0.5 else ahead


def _neighbours(cameras: Cameras, view: int) -> NDArray[np.int64]:
    """Return the views nearest to one in position and direction."""
    away = np.linalg.norm(cameras.positions - cameras.positions[view], axis=1) / (cameras.extent or 1.0)
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

    image: NDArray[np.float32]
    valid: Mask
    starts: Mask
    step: int

    @classmethod
    def of(
        cls, image: NDArray[np.float32], mask: Mask | None, outline: Mask | None, background: Colour
    ) -> _Photo:
        step = max(1, round(max(image.shape) / _PATCH_SPACING))
        shown = np.abs(image - background).max(2) > _EMPTY_COLOUR_SLACK if outline is None else outline
        if mask is None:
            return cls(image, np.ones_like(shown), shown, step)
        return cls(image, mask, shown & ~grown(~mask, step), step)


def _swept(
    ray: _Rays, depths: Float, hull: VisualHull | None, slack: float
) -> tuple[Float, NDArray[np.float32]]:
    """Return points on rays, with colours.

    Points lie within the hull if there is one. Without one, a point must agree with other photos, and
    clearly better than most depths of its ray; `slack` multiplies both limits.
    """
    trial = np.broadcast_to(depths, (len(ray.colors), len(depths)))
    cost = ray.costs(trial)
    rows = np.arange(len(cost))
    if hull is not None:
        cost[~hull.holds(ray.at(trial))] = np.inf
        best = (cost <= cost.min(1, keepdims=True) + _EQUAL_COST_SLACK).argmax(
            1
        )  # the nearest is on the hull
        depth, least = trial[rows, best], cost[rows, best]
        kept = np.isfinite(least)
    else:
        finite = np.isfinite(cost)
        middle = np.maximum(finite.sum(1) // 2, 1) - 1
        usual = np.sort(cost, axis=1)[rows, middle]  # the median, since infinities are sorted last
        depth, least = _refined(ray, trial, cost)
        kept = finite.any(1) & (least <= slack * np.minimum(_MOST_POINT_COST, _MOST_POINT_COST_SHARE * usual))
    return ray.at(depth[:, None])[kept, 0], ray.colors[kept]


def _refined(ray: _Rays, trial: Float, cost: Float) -> tuple[Float, Float]:
    """Return the (N,) best depths and their costs, from finer trials around the best minima of each ray.

    `trial` and `cost` are (N, D); depths are evenly spaced in 1/depth. The finer trials reach three quarters
    of a spacing to both sides, past the middle between two trials.
    """
    padded = np.pad(cost, ((0, 0), (1, 1)), constant_values=np.inf)
    is_minimum = (cost <= padded[:, :-2]) & (cost <= padded[:, 2:])
    order = np.argsort(np.where(is_minimum, cost, np.inf), axis=1, kind="stable")[:, :_REFINED_DEPTHS]
    rows = np.arange(len(cost))[:, None]
    inverse_depth = 1 / trial[rows, order]
    spacing = np.abs(1 / trial[:, :1] - 1 / trial[:, 1:2])
    offsets = np.linspace(-0.75, 0.75, _FINER_DEPTHS)
    tried = inverse_depth[:, :, None] + offsets * spacing[:, :, None]
    finer = (1 / np.maximum(tried, 1e-3 * inverse_depth[:, :, None])).reshape(
        len(cost), order.shape[1] * len(offsets)
    )
    costs = ray.costs(finer)
    best = costs.argmin(1)
    return finer[rows[:, 0], best], costs[rows[:, 0], best]


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
    others: NDArray[np.int64]
    origin: Float
    aims: Float
    patches: Float

    @classmethod
    def of(
        cls,
        cameras: Cameras,
        shots: list[_Photo],
        view: int,
        others: NDArray[np.int64],
        pixels: NDArray[np.int64],
    ) -> _Rays:
        photo, pose = shots[view].image, cameras.viewmats[view]
        patch = _PATCH * shots[view].step
        rows = np.clip(pixels[0][:, None] + patch[:, 0], 0, photo.shape[0] - 1)
        columns = np.clip(pixels[1][:, None] + patch[:, 1], 0, photo.shape[1] - 1)
        seen = np.stack([columns + 0.5, rows + 0.5, np.ones(rows.shape)], -1)
        aims = seen @ np.linalg.inv(cameras.Ks[view]).T @ pose[:3, :3]
        patches = photo[rows, columns].astype(np.float64)
        return cls(cameras, shots, others, cameras.positions[view], aims, patches)

    @property
    def colors(self) -> NDArray[np.float32]:
        """Colours of the pixels, (N, 3)."""
        return self.patches[:, 0].astype(np.float32)

    def at(self, depths: Float) -> Float:
        """Return the (N, D, 3) world points of the pixels at (N, D) depths."""
        return self.origin + self.aims[:, :1] * depths[..., None]

    def costs(self, depths: Float) -> Float:
        """Return (N, D) differences of the patches to the views that agree best; ∞ if too few see them."""
        own_costs = np.full((len(self.others), *depths.shape), np.inf)
        for k, other in enumerate(self.others):
            total, inside = np.zeros(depths.shape), np.ones(depths.shape, bool)
            for p in range(self.aims.shape[1]):
                world = self.origin + self.aims[:, p : p + 1] * depths[..., None]
                color, held = self._sampled(int(other), world)
                total += np.abs(color - self.patches[:, p : p + 1]).mean(-1)
                inside &= held
            own_costs[k][inside] = total[inside] / self.aims.shape[1]
        own_costs.sort(axis=0)
        return own_costs[:_AGREEING_VIEWS].mean(0)

    def _sampled(self, view: int, world: Float) -> tuple[Float, Mask]:
        """Return the colours of world points in a photo, and whether it shows them; black if not."""
        photo, valid = self.photos[view].image, self.photos[view].valid
        pose, K = self.cameras.viewmats[view], self.cameras.Ks[view]
        local = world @ pose[:3, :3].T + pose[:3, 3]
        ahead = local[..., 2] > 0
        depth = np.where(ahead, local[..., 2], 1.0)
        u = np.floor(K[0, 0] * local[..., 0] / depth + K[0, 2])
        v = np.floor(K[1, 1] * local[..., 1] / depth + K[1, 2])
        held = ahead & (u >= 0) & (v >= 0) & (u < photo.shape[1]) & (v < photo.shape[0])
        rows, columns = np.where(held, v, 0).astype(int), np.where(held, u, 0).astype(int)
        color, held = photo[rows, columns], held & valid[rows, columns]
        return np.where(held[..., None], color, 0.0), held
