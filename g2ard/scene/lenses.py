"""Lenses of photos that pinhole views are resampled from: fisheyes, panoramas and rational lenses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from g2ard.arrays import Float, Mask

_SINGLE_FOCAL = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")

_PLANAR = ("FULL_OPENCV", "FOV")
"""Models that distort the pinhole plane, not angles."""

PARAMETERS = {
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EQUIRECTANGULAR": 0,
}
"""Number of parameters of each model, in COLMAP's order; 0 for a panorama."""

FACES: dict[str, Float] = {
    "front": np.eye(3),
    "right": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "back": np.diag([-1.0, 1, -1]),
    "left": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "up": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "down": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""Faces of a cube: rotations from a face's camera axes to the photo's."""

_ONE_VIEW = np.radians(50)
"""Largest angle from the axis to the middle of an edge of a photo that one pinhole view shows."""
_LEAST_SEEN = 0.05  # least share of a face that the photo must hold


_CORNER = np.radians(95)
"""Largest angle in the corners of photos without an image circle: beyond it, and beyond the middle of each
edge, fisheyes see nothing."""


Face = tuple[str, Float, Float, tuple[int, int]]
"""A pinhole view of a photo: name, empty if it is the only one, rotation as in `FACES`, K and size."""


@dataclass(frozen=True)
class PhotoLens:
    """Lens of a photo, and the rotation of a pinhole view that is resampled from it.

    Args:
        model: a key of `PARAMETERS`.
        size: width and height that the parameters refer to, pixels.
        params: focal lengths, principal point and coefficients as COLMAP orders them.
        turn: 9 numbers, row by row: rotation from the view's camera axes to the photo's.
    """

    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

    @property
    def focal(self) -> tuple[float, float]:
        """Pixels per radian, or per unit of the pinhole plane, in the middle."""
        if self.model == "EQUIRECTANGULAR":
            return self.size[0] / (2 * np.pi), self.size[1] / np.pi
        return (self.params[0], self.params[0 if self.model in _SINGLE_FOCAL else 1])

    @property
    def _centre_and_rest(self) -> tuple[float, float, tuple[float, ...]]:
        first = 1 if self.model in _SINGLE_FOCAL else 2
        return self.params[first], self.params[first + 1], self.params[first + 2 :]

    def turned(self, turn: Float) -> PhotoLens:
        return replace(self, turn=tuple(turn.ravel().tolist()))

    def project(self, rays: Float) -> tuple[Float, Mask]:
        """Map (N, 3) rays in the view's axes to (N, 2) pixels, and say which of them the photo holds."""
        x, y, z = np.array(self.turn).reshape(3, 3) @ rays.T
        across = np.hypot(x, y)
        width, height = self.size
        if self.model == "EQUIRECTANGULAR":
            u = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width
            v = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height
            return np.stack([u, v], 1), np.ones(len(u), bool)
        if self.model in _PLANAR:
            inside = across < np.tan(_find_end(self)) * z
            ahead = np.where(inside, z, 1.0)
            u = np.where(inside, x / ahead, 0.0)
            v = np.where(inside, y / ahead, 0.0)
        else:
            angle = np.arctan2(across, z)
            inside = angle < _find_end(self)
            away = np.where(inside, angle, 0.0)
            aim = np.where(across > 0, across, 1.0)
            u = x / aim * away
            v = y / aim * away
        u, v = self._bent(u, v)
        cx, cy, _ = self._centre_and_rest
        fx, fy = self.focal
        u = fx * u + cx
        v = fy * v + cy
        inside &= (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
        return np.stack([u, v], 1), inside

    def _plane_radius(self, angle: Float) -> Float:
        """Return the radius before distortion: the angle of fisheyes, otherwise its tangent."""
        return np.tan(angle) if self.model in _PLANAR else angle

    def _bent(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Distort points by the lens: radially, tangentially (p1, p2), and by a thin prism (s1, s2)."""
        _, _, rest = self._centre_and_rest
        r2 = u * u + v * v
        if self.model == "FOV":
            return _bend_by_fov(u, v, r2, rest[0])
        p1 = p2 = s1 = s2 = 0.0
        k = rest
        if self.model == "FULL_OPENCV":
            k1, k2, p1, p2, *higher = rest
            k = (k1, k2, *higher)
        elif self.model == "THIN_PRISM_FISHEYE":
            k1, k2, p1, p2, k3, k4, s1, s2 = rest
            k = (k1, k2, k3, k4)
        k = (*k, *[0.0] * (6 - len(k)))
        if self.model == "FULL_OPENCV":
            above = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
            radial = above / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))
        else:
            radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * k[3])))
        return (
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s1 * r2,
            v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + s2 * r2,
        )

    def _measure_edges(self, radii: Float, angles: Float) -> Float:
        """Return the (4,) angles of the middles of the left, right, upper and lower edge."""
        cx, cy, _ = self._centre_and_rest
        width, height = self.size
        pixels = np.array([cx, width - cx, cy, height - cy])
        return np.interp(pixels / np.repeat(self.focal, 2), radii, angles)

    def faces(self, scale: float = 1.0) -> list[Face]:
        """Return the pinhole views of a photo of `scale` times the size: one of a narrow lens, otherwise the
        faces of a cube that it holds enough of."""
        if self.model == "FULL_OPENCV":
            fx, fy, cx, cy = (scale * value for value in self.params[:4])
            size = (round(self.size[0] * scale), round(self.size[1] * scale))
            return [("", np.eye(3), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size)]
        focal = scale * float(np.sqrt(self.focal[0] * self.focal[1]))
        if self.model != "EQUIRECTANGULAR":
            angles = np.linspace(0, _find_end(self), 20001)[:-1]
            radii = np.hypot(*self._bent(self._plane_radius(angles), np.zeros(len(angles))))
            edges = self._measure_edges(radii, angles)
            if edges.max() <= _ONE_VIEW:
                left, right, top, bottom = (focal * np.tan(edge) for edge in edges)
                K = np.array([[focal, 0, left], [0, focal, top], [0, 0, 1]])
                size = (max(1, round(left + right)), max(1, round(top + bottom)))
                return [("", np.eye(3), K, size)]
        side = max(2, round(2 * focal))
        K = np.array([[side / 2, 0, side / 2], [0, side / 2, side / 2], [0, 0, 1]])
        steps = (np.arange(32) + 0.5) / 16 - 1
        x, y = np.meshgrid(steps, steps)
        grid = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
        found: list[Face] = []
        for name, turn in FACES.items():
            _, held = self.turned(turn).project(grid)
            if held.mean() >= _LEAST_SEEN:
                found.append((name, turn, K, (side, side)))
        return found


def _bend_by_fov(u: Float, v: Float, r2: Float, omega: float) -> tuple[Float, Float]:
    """Distort points by the model of a wide lens with one parameter."""
    if abs(omega) < 1e-6:
        return u, v
    r = np.sqrt(r2)
    slope = np.tan(omega / 2)
    wide = np.arctan(2 * r * slope) / omega
    factor = np.where(r > 1e-9, wide / np.maximum(r, 1e-9), 2 * slope / omega)
    return u * factor, v * factor


@lru_cache(maxsize=64)
def _find_end(lens: PhotoLens) -> float:
    """Return the angle from the axis where a lens ends: its radius stops growing, or the corners of a
    photo that shows the whole image circle begin."""
    planar = lens.model in _PLANAR
    angles = np.linspace(0, np.pi / 2 if planar else np.pi, 20001)[:-1]
    radii, _ = lens._bent(lens._plane_radius(angles), np.zeros(len(angles)))
    falls = np.flatnonzero(np.diff(radii) <= 0)
    most = int(falls[0]) + 1 if len(falls) else len(angles)
    end = float(angles[most - 1])
    if planar:
        return end
    edge = float(lens._measure_edges(radii[:most], angles[:most]).max())
    return min(end, max(edge, _CORNER))


def panorama_rays(width: int, height: int, rows: slice) -> Float:
    """Return unit rays (N, 3) of the pixels in some rows of a panorama, in its camera's axes."""
    v, u = np.mgrid[rows, 0:width] + 0.5
    around = 2 * np.pi * (u / width - 0.5)
    down = np.pi * (v / height - 0.5)
    level = np.cos(down)
    rays = np.stack([np.sin(around) * level, np.sin(down), np.cos(around) * level], axis=-1)
    return rays.reshape(-1, 3)


def photo_of(name: str) -> str:
    """Return the name of the photo that a view of several was made from.

    >>> photo_of("a.jpg#left"), photo_of("b#1.jpg")
    ('a.jpg', 'b#1.jpg')
    """
    photo, _, face = name.rpartition("#")
    return photo if face in FACES else name
