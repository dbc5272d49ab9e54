"""Poses, what each sees of a scene by rays and small renders, and the collection of good ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import g2ard._core as _core
from g2ard.arrays import Float, Float32, Int, Mask
from g2ard.config.choices import BLACK
from g2ard.errors import require
from g2ard.poses.site import Inside, Site
from g2ard.poses.votes import Votes
from g2ard.rendering.renderer import RasterSettings, View, view_of
from g2ard.scene.cameras import Cameras
from g2ard.scene.lenses import pinhole_matrix
from g2ard.scene.reproducible import canonical_order, norms, positive, quantile, turned
from g2ard.scene.splats import Splats
from g2ard.system.cached import cached_property

_RAYS = (24, 18)
"""Columns and rows of the rays that represent a frame."""

_RAISED = 0.1
"""Share of `Site.tallness`: matter higher above the ground stands on it."""

_PATIENCE = 12
"""Most candidates judged per requested pose."""
_TOLERABLE = 0.5
"""Least score of a usable candidate; 1 is good."""
_BLOCK = 256
"""Candidates judged between two reports of progress, about a second; results do not depend on it."""

_ROWS = 12_000
"""Gaussians rendered per glance."""

SIGHT_ROWS = 24_000
"""Gaussians rendered where lines of sight matter."""

_OUTLOOK_ROWS = 80_000
"""Gaussians rendered to judge whole pictures."""

_LONGEST = 96
"""Pixels along the longer side of a glance."""

_BATCH = 32
"""Renders made together."""

_MOST_WIDENED = 4.0
"""Largest factor by which a sample of 12,000 Gaussians grows along the two longer axes, to cover for the
rest; a larger sample may grow more."""

_CROP = 32
"""Side in pixels of the part around an aim that tells whether the line of sight is clear."""

_FINE = 0.03
"""Radians: Gaussians with a smaller angular standard deviation are detail; the rest is fog and sky."""

_COARSEST = 0.9
"""Quantile of the sizes seen that counts: one tenth may be fog."""

_NEAR = 0.05
"""Near plane as a share of the distance within which matter is close."""


@dataclass(frozen=True)
class Lens:
    """Image size in pixels and horizontal field of view in degrees."""

    size: tuple[int, int] = (800, 600)
    fov: float = 50.0

    def __post_init__(self) -> None:
        wide, tall = self.size
        require("size", f"{wide}×{tall}", min(self.size) >= 1, "at least 1×1 pixels")
        require("fov", self.fov, 0 < self.fov < 180, "degrees between 0 and 180")

    @property
    def tangents(self) -> tuple[float, float]:
        """Half width and half height of the frame at distance 1."""
        half = float(np.tan(np.radians(self.fov) / 2))
        return half, half * self.size[1] / self.size[0]

    def holds(self, x: Float, y: Float, z: Float) -> Mask:
        """Return (M,) whether points, right, down and ahead of the eye, are in the frame."""
        wide, tall = self.tangents
        return (z > 0) & (np.abs(x) < wide * z) & (np.abs(y) < tall * z)

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.size[0] / 2 / self.tangents[0]

    @property
    def matrix(self) -> Float:
        """(3, 3) pinhole intrinsics in pixels."""
        width, height = self.size
        return pinhole_matrix(self.focal, self.focal, width / 2, height / 2)


@dataclass(frozen=True, eq=False)
class Poses:
    """Eyes (P, 3) and unit gazes (P, 3), upright in a site's coordinates."""

    eyes: Float
    gazes: Float

    def __len__(self) -> int:
        return len(self.eyes)

    def take(self, index: Int | Mask | slice) -> Poses:
        """Return the poses that `index` selects, in its order."""
        return Poses(self.eyes[index], self.gazes[index])

    @classmethod
    def joined(cls, parts: list[Poses]) -> Poses:
        """Concatenate the poses of all parts, in order."""
        none = np.zeros((0, 3))
        return cls(
            np.concatenate([none, *(part.eyes for part in parts)]),
            np.concatenate([none, *(part.gazes for part in parts)]),
        )

    def frames(self) -> Float:
        """Return (P, 3, 3) rotations whose rows are right, down and ahead, in the site's coordinates."""
        level = np.cross(self.gazes, [0.0, 0.0, 1.0])
        # straight down: the top of the image is the site's y
        steep = np.linalg.norm(level, axis=1) < 1e-6
        level[steep] = (1.0, 0.0, 0.0)
        right = level / np.linalg.norm(level, axis=1, keepdims=True)
        down = np.cross(self.gazes, right)
        return np.stack([right, down, self.gazes], axis=1)


class Glance:
    """Small renders of a sample of a scene, sky and floaters included.

    Args:
        splats: the scene, or a fair sample of it.
        represents: Gaussians of the scene per row of `splats`.
        limit: largest number of Gaussians to render.
    """

    def __init__(
        self,
        splats: Splats,
        represents: float = 1.0,
        limit: int = _ROWS,
    ) -> None:
        rows = splats.visible_rows()
        some = rows[canonical_order(splats, rows, limit)]
        sample = splats.take(some[splats.take(some).finite_rows()])
        _, middle_scales, largest = np.sort(sample.scales.astype(np.float64), axis=1).T
        self.sizes = np.sqrt(middle_scales * largest)
        self.opacities = sample.opacities
        self._middle = sample.offset + np.median(sample.means.astype(np.float64), axis=0)
        self._means = sample.positions - self._middle
        self.points = self._means + self._middle
        self._antialiased = sample.antialiased
        self._colors = np.clip(sample.colors.astype(np.float64), 0, 1)
        # the sample covers as much as the scene, but for the axis along which Gaussians are flat
        most = _MOST_WIDENED * limit / _ROWS
        represented = represents * len(rows) / max(1, len(some))
        widen = min(most, np.sqrt(represented))
        shortest = np.argmin(sample.scales, axis=1)
        is_shortest = np.arange(3) == shortest[:, None]
        logs = np.log(np.maximum(sample.scales, np.finfo(np.float32).tiny))
        arrays = (
            self._means,
            sample.quats,
            np.where(is_shortest, logs, logs + np.log(widen)),
            np.clip(sample.logit_opacities, -80, 80),
            sample.sh0,
            np.zeros((len(self._means), 0, 3)),
        )
        self._arrays = tuple(np.ascontiguousarray(array, np.float32) for array in arrays)

    def of(self, cameras: Cameras, reach: Float | None = None) -> Float:
        """Look through C cameras, and measure how much matter each sees, and how sharply.

        Returns:
            (3, C): mean α of the image; the part of it from Gaussians whose angular standard deviation is
            under 0.03 rad; and the 90th percentile of these deviations, weighted by αT. Fog, sky and matter
            too close to the camera have large ones. Matter beyond `reach`, (C,), counts only for the first.
        """
        figures = np.zeros((3, len(cameras)))
        near = self._near_of(cameras)
        for i, (sums, depth, view) in enumerate(self._renders(cameras, near)):
            weight = sums["weight"] / np.prod(view[2])
            seen = weight > 0
            if reach is not None:
                seen &= depth <= reach[i]
            covered = weight.sum()
            fine = 0.0
            coarsest = np.inf
            if seen.any():
                angle = self.sizes[seen] / positive(depth[seen])
                seen_weight = weight[seen]
                fine = seen_weight[angle < _FINE].sum()
                coarsest = float(quantile(angle, seen_weight, _COARSEST))
            figures[:, i] = covered, fine, coarsest
        return figures

    def _near_of(self, cameras: Cameras) -> float | None:
        """Return a near plane in proportion to how far the cameras stand; None leaves it to the renderer."""
        if not len(cameras):
            return None
        away = norms(cameras.positions - self._middle)
        return 1e-3 * float(np.median(away)) or None

    def sights(self, cameras: Cameras) -> tuple[Float, Float, Float, Float, Float32]:
        """Look through C cameras, and tell what each sees of every Gaussian.

        Returns:
            (C,) mean α; (C,) the part of it from Gaussians under 0.03 rad; (C,) mean difference of
            neighbouring pixels; (C,) standard deviation of the Gaussians' colours; and (C, N) mean
            transmittances in front of the Gaussians, 0 out of frame.
        """
        covered, fine, detail, spread = np.zeros((4, len(cameras)))
        seen = np.zeros((len(cameras), len(self.points)), np.float32)
        near = self._near_of(cameras)
        rasterizer = _core.Rasterizer()
        settings = RasterSettings(antialiased=self._antialiased, near=near)
        for i, (sums, depth, view) in enumerate(self._renders(cameras, near)):
            image = rasterizer.image(self._arrays, view, settings, list(BLACK))
            image = np.clip(image, 0, 1)
            weight = sums["weight"] / image[..., 0].size
            covered[i] = weight.sum()
            fine[i] = weight[self.sizes < _FINE * depth].sum()
            seen[i] = sums["transmittance"] / np.maximum(1, sums["hits"])
            for axis in (0, 1):
                differences = np.abs(np.diff(image, axis=axis))
                detail[i] += differences.mean(dtype=np.float64)
            shown = sums["weight"].astype(np.float64)
            variances = [_measure_variance(channel, shown) for channel in self._colors.T]
            spread[i] = np.sqrt(sum(variances))
        return covered, fine, detail, spread, seen

    def clear(self, cameras: Cameras, aims: Int, close: float) -> Float:
        """Return the (C,) mean transmittances in front of what C views have in the middle, over its pixels.

        Args:
            aims: (C,) rows of `points` in the middle.
            close: distance within which matter is close, scene units.
        """
        found = np.zeros(len(cameras))
        for i, (sums, _, _) in enumerate(self._renders(cameras, _NEAR * close, crop=True)):
            aim = aims[i]
            found[i] = sums["transmittance"][aim] / max(1, sums["hits"][aim])
        return found

    def murk(self, cameras: Cameras, close: float) -> Float:
        """Return the (C,) shares of the images that show matter nearer than `close`, scene units."""
        shares = np.zeros(len(cameras))
        for i, (sums, depth, view) in enumerate(self._renders(cameras, _NEAR * close)):
            is_close = depth < close
            shares[i] = sums["weight"][is_close].sum() / np.prod(view[2])
        return shares

    def _renders(
        self,
        cameras: Cameras,
        near: float | None,
        crop: bool = False,
    ) -> Iterator[tuple[dict[str, Any], Float, View]]:
        """Yield each camera's sums, the distances to the Gaussians, and the view as kernels take it."""
        if not len(cameras):
            return
        here = cameras.resized(_LONGEST).recentred(self._middle)
        if crop:
            sizes = np.stack([here.widths, here.heights], axis=1)
            here = here.cropped(
                np.maximum(0, (sizes - _CROP) // 2),
                np.minimum(sizes, (sizes + _CROP) // 2),
            )
        settings = RasterSettings(antialiased=self._antialiased, near=near)
        for first in range(0, len(here), _BATCH):
            batch = range(first, min(first + _BATCH, len(here)))
            views = [view_of(here, i, settings) for i in batch]
            results = _core.accumulate_each(self._arrays, views, settings)
            for i, view, sums in zip(batch, views, results, strict=True):
                yield sums, norms(self._means - here.positions[i]), view


def _measure_variance(values: Float, weights: Float) -> float:
    total = max(weights.sum(), 1e-30)
    mean = (weights * values).sum() / total
    squares = (values - mean) ** 2
    return float((weights * squares).sum()) / total


@dataclass(frozen=True, eq=False)
class Survey:
    """A scene and the lens to show it with, as planners need them.

    Args:
        splats: the scene, or a fair sample of it.
        represents: Gaussians of the scene per row of `splats`.
        site: the scene, upright.
        lens: lens of the poses.
        seed: seed of the placement.
        tell: called with the number of good poses so far, and of those requested.
    """

    splats: Splats
    represents: float
    site: Site
    lens: Lens = Lens()
    seed: int = 0
    tell: Callable[[int, int], None] = lambda done, total: None

    @cached_property
    def inside(self) -> Inside:
        """Places within rooms."""
        return self.site.inside(self.seed)

    @cached_property
    def votes(self) -> Votes:
        """Votes of the scene's Gaussians for places in the site's coordinates."""
        site = self.site
        glance = self.glance
        points = (glance.points - site.origin) / site.size
        return Votes.of(
            turned(points, site.axes),
            glance.sizes / site.size,
            glance.opacities.astype(np.float64),
        )

    @cached_property
    def glance(self) -> Glance:
        """Small renders of the scene."""
        return Glance(self.splats, self.represents)

    @cached_property
    def outlook(self) -> Glance:
        """Small renders that show what hides what."""
        return Glance(self.splats, self.represents, _OUTLOOK_ROWS)

    def cameras(self, poses: Poses) -> Cameras:
        """Return cameras in world coordinates, named in order."""
        count = len(poses)
        digits = max(4, len(str(count - 1)))
        rotations = poses.frames() @ self.site.axes
        eyes = self.site.globalize(poses.eyes)
        viewmats = np.tile(np.eye(4), (count, 1, 1))
        viewmats[:, :3, :3] = rotations
        viewmats[:, :3, 3] = -np.einsum("pij,pj->pi", rotations, eyes)
        return Cameras.from_lists(
            list(viewmats),
            [self.lens.matrix] * count,
            [self.lens.size] * count,
            [f"pose_{i:0{digits}d}" for i in range(count)],
        )


class Rays:
    """A coarse frame of rays from each of P poses, and what they meet in the site's grid, as (P,) arrays."""

    def __init__(self, survey: Survey, poses: Poses) -> None:
        wide, tall = survey.lens.tangents
        columns, rows = _RAYS
        x = wide * ((np.arange(columns) + 0.5) / columns * 2 - 1)
        y = tall * ((np.arange(rows) + 0.5) / rows * 2 - 1)
        rays = np.stack([np.tile(x, rows), np.repeat(y, columns), np.ones(columns * rows)], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        directions = np.einsum("ri,pij->prj", rays, poses.frames())
        self._site = survey.site
        self._shape = (len(poses), len(rays))
        self._eyes = np.repeat(poses.eyes, len(rays), axis=0)
        self._directions = directions.reshape(-1, 3)

    @cached_property
    def _stopped(self) -> Float:
        return self._site.grid.cast(self._eyes, self._directions)

    @cached_property
    def _met(self) -> Float:
        met = self._site.grid.cast(self._eyes, self._directions, murky=True)
        return np.sort(met.reshape(self._shape), axis=1)

    @property
    def covered(self) -> Float:
        """Share of the rays that opaque matter stops."""
        return np.isfinite(self._stopped).reshape(self._shape).mean(axis=1)

    @property
    def standing(self) -> Float:
        """Share of the rays stopped by matter that stands on the ground; all of it without a ground."""
        hit = np.isfinite(self._stopped)
        points = self._eyes[hit] + self._stopped[hit, None] * self._directions[hit]
        heights = self._site.above_ground(points)
        hit[hit] = heights > _RAISED * self._site.tallness
        return hit.reshape(self._shape).mean(axis=1)

    @property
    def close(self) -> Float:
        """Distance at which a tenth of the rays have met something, even if only leaves or haze."""
        return self._met[:, self._shape[1] // 10]

    @property
    def median(self) -> Float:
        """Median distance of the rays that meet anything; inf if none does."""
        halfway = np.isfinite(self._met).sum(axis=1) // 2
        return self._met[np.arange(len(halfway)), halfway]


def gather(
    survey: Survey,
    count: int,
    tried: Callable[[int, int], tuple[Poses, Float]],
    *,
    patience: int = _PATIENCE,
) -> Poses:
    """Return the first `count` good poses of an endless even sequence, topped up with usable ones.

    Args:
        tried: returns the candidates from one index of the sequence to another, and their scores; a score of
            at least 1 is good.
        patience: candidates tried per requested pose, at most.
    """
    parts = [Poses.joined([])]
    scores = np.zeros(0)
    asked = 0
    good = 0
    while good < count and asked < patience * count:
        more = min(max(count - good, 16), patience * count - asked, _BLOCK)
        poses, judged = tried(asked, asked + more)
        parts.append(poses)
        scores = np.concatenate([scores, judged])
        asked += more
        survey.tell(min(good, count - 1), count)
        good = int((scores >= 1).sum())
    survey.tell(count, count)
    scores = np.minimum(scores, 1.0)
    best = np.argsort(-scores, kind="stable")[:count]
    usable = best[scores[best] >= _TOLERABLE]
    return Poses.joined(parts).take(np.sort(usable))
