"""Procedural city: point clouds, photos and ray casts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.synth.layout import plan
from benchmarks.synth.lidar import scan
from benchmarks.synth.paint import Painter
from benchmarks.synth.shapes import Float, cast
from benchmarks.synth.trajectories import trajectories
from g2ard.errors import InputError
from g2ard.scene.cameras import Cameras

__all__ = ["City", "CityConfig", "Scan", "city"]

_TILE = 32
_BEAM = 0.01, 4e-4
"""Width of the laser at the scanner, metres, and divergence, radians."""
_CHUNK = 1 << 16


@dataclass(frozen=True)
class CityConfig:
    """Configuration of a city.

    Args:
        points: laser returns in the point cloud.
        views: photos in all four splits, at least 8.
        size: (width, height) of a photo, pixels.
        blocks: city blocks per side; one is 72 m × 58 m, including streets.
        seed: random seed.
        noise: standard deviation of the laser's range, metres.
        sky: colour in [0, 1] of rays without a hit; the default is exact in 8 bits.
        offset: (3,) world coordinates of the city's centre, such as UTM coordinates.

    Raises:
        InputError: a value is out of range.
    """

    points: int = 500_000
    views: int = 120
    size: tuple[int, int] = (800, 600)
    blocks: int = 3
    seed: int = 0
    noise: float = 0.015
    sky: tuple[float, float, float] = (0.6, 0.8, 1.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name, value, least, most in (
            ("points", self.points, 1, 10**9),
            ("views", self.views, 8, 10**5),
            ("width", self.size[0], 1, 2**14),
            ("height", self.size[1], 1, 2**14),
            ("blocks", self.blocks, 1, 40),
            ("seed", self.seed, 0, 2**63),
            ("noise", self.noise, 0, 10),
        ):
            if not least <= value <= most:
                raise InputError(f"city: {name} must lie between {least} and {most}, got {value}")
        if not all(0 <= c <= 1 for c in self.sky):
            raise InputError(f"city: sky must be three numbers between 0 and 1, got {self.sky}")
        if not np.isfinite(self.offset).all():
            raise InputError(f"city: offset must be finite, got {self.offset}")


@dataclass(frozen=True, eq=False)
class Scan:
    """n laser returns.

    Args:
        positions: (n, 3) float64 world coordinates with range noise.
        colors: (n, 3) float32 in [0, 1].
        primitives: (n,) indices of the surfaces.
    """

    positions: Float
    colors: NDArray[np.float32]
    primitives: NDArray[np.int64]


class City:
    """Procedural city; build it with `city`."""

    def __init__(self, config: CityConfig) -> None:
        self.config = config
        self.layout = plan(config.blocks, config.seed)
        self._paint = Painter(self.layout, config.seed)
        self._offset = np.asarray(config.offset, np.float64)
        local = trajectories(self.layout, config.views, config.size)
        self.views: dict[str, Cameras] = {k: v.recentred(-self._offset) for k, v in local.items()}

    def points(self, count: int | None = None) -> Scan:
        """Return a laser scan of `count` points (default: the configuration's), coloured like photos."""
        parts = list(self.scans(count))
        positions, colors, primitives = zip(
            *((p.positions, p.colors, p.primitives) for p in parts), strict=True
        )
        return Scan(np.concatenate(positions), np.concatenate(colors), np.concatenate(primitives))

    def scans(self, count: int | None = None) -> Iterator[Scan]:
        """Yield the scan of `points` in blocks of about two million."""
        config = self.config
        rng = np.random.default_rng([config.seed, 2])
        for returns in scan(self.layout, config.points if count is None else count, config.seed):
            for i in range(0, len(returns.ranges), _CHUNK):
                part = returns.take(np.arange(i, min(i + _CHUNK, len(returns.ranges))))
                o, d, t = part.origins, part.directions, part.ranges
                color = self._shade(o, d, t, part.primitives, _BEAM[0] + _BEAM[1] * t)
                noisy = o + d * (t + config.noise * rng.standard_normal(len(t)))
                yield Scan(noisy.T + self._offset, color.T, part.primitives)

    def photo(self, cameras: Cameras, index: int) -> NDArray[np.float32]:
        """Return the (H, W, 3) colours of a view in [0, 1], the mean of four rays per pixel."""
        view = cameras.take([index]).recentred(self._offset)
        width, height = int(view.widths[0]), int(view.heights[0])
        image = np.empty((height, width, 3), np.float32)
        for row in range(0, height, _TILE):
            rows = min(_TILE, height - row)
            order, o, d, scale = _pixel_rays(view, row, rows)
            t, hit = cast(self.layout.shapes, o, d)
            flat = np.empty((rows * width, 3), np.float32)
            flat[order] = self._pixels(o, d, t, hit, scale, len(order))
            image[row : row + rows] = flat.reshape(rows, width, 3)
        return image

    def _pixels(
        self, o: Float, d: Float, t: Float, hit: NDArray[np.int64], scale: float, count: int
    ) -> NDArray[np.float32]:
        """Return the (count, 3) colours of pixels with n/count consecutive rays each.

        Patterns are averaged in closed form: a pixel whose rays all hit one face is painted once, at their
        mean. Only pixels on edges are painted per ray.
        """
        each = d.shape[1] // count
        hits = hit.reshape(count, each)
        one = (hits == hits[:, :1]).all(1) & (hits[:, 0] >= 0)
        one[one] = self._flat(o, d, t, hit, np.flatnonzero(one) * each, each)
        color = np.empty((count, 3), np.float32)
        mean = (d * np.where(hit >= 0, t, 0.0)).reshape(3, count, each)[:, one].mean(2)
        depth = np.linalg.norm(mean, axis=0)
        color[one] = self._shade(o, mean / depth, depth, hits[one, 0], scale * depth).T
        rays = np.repeat(~one, each)
        rest = self._color(o, d[:, rays], t[rays], hit[rays], scale / np.sqrt(each))
        color[~one] = rest.T.reshape(-1, each, 3).mean(1)
        return color

    def _flat(
        self,
        o: Float,
        d: Float,
        t: Float,
        hit: NDArray[np.int64],
        first: NDArray[np.int64],
        each: int,
    ) -> NDArray[np.bool_]:
        """Return whether the first and the last of `each` rays from `first` hit the same face."""
        last = first + each - 1
        normals = [self.layout.shapes.normals(o + d[:, i] * t[i], hit[i]) for i in (first, last)]
        return (normals[0] * normals[1]).sum(0) > 0.9

    def _color(
        self, o: Float, d: Float, t: Float, hit: NDArray[np.int64], scale: float
    ) -> NDArray[np.float32]:
        color = np.empty(d.shape, np.float32)
        color[:] = np.asarray(self.config.sky, np.float32)[:, None]
        found = np.flatnonzero(hit >= 0)
        if len(found):
            color[:, found] = self._shade(o, d[:, found], t[found], hit[found], scale * t[found])
        return color

    def _shade(
        self, o: Float, d: Float, t: Float, hit: NDArray[np.int64], width: Float
    ) -> NDArray[np.float32]:
        p = o + d * t
        return self._paint(p, self.layout.shapes.normals(p, hit), d, hit, width)


def city(config: CityConfig | None = None, **options: object) -> City:
    """Build a small procedural city: ground with road markings, facades, roofs, trees, lamps, cars.

    Equal configurations give equal bits.

    Args:
        config: its configuration; None means `CityConfig()`.
        options: fields of `CityConfig` that override `config`.

    >>> town = city(blocks=1, points=1000, views=8, size=(32, 24))
    >>> town.points().positions.shape, town.photo(town.views["train"], 0).shape
    ((1000, 3), (24, 32, 3))
    """
    return City(replace(config or CityConfig(), **options))  # type: ignore[arg-type]


def _pixel_rays(
    view: Cameras, row: int, rows: int
) -> tuple[NDArray[np.int64], Float, Float, float]:
    """Return rays through 2 × 2 samples per pixel in `rows` rows from `row`, ordered by tile and pixel.

    Returns:
        (n/4,) raster indices of pixels; (3, 1) origin; (3, n) unit directions; pixel width at distance 1.
    """
    width = int(view.widths[0])
    R, K = view.viewmats[0, :3, :3], view.Ks[0]
    place = np.arange(rows * width).reshape(rows, width)
    order = np.concatenate([place[:, c : c + _TILE].ravel() for c in range(0, width, _TILE)])
    y, x = np.divmod(order, width)
    x = (x[:, None] + [0.25, 0.75, 0.25, 0.75]).ravel()
    y = (row + y[:, None] + [0.25, 0.25, 0.75, 0.75]).ravel()
    camera = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones(len(x))])
    d = R.T @ camera
    return order, view.positions.T, d / np.linalg.norm(d, axis=0), 1.0 / float(K[0, 0])
