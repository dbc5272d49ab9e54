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
    "right": np.array(
        [
            [0.0, 0, 1],
            [0, 1, 0],
            [-1, 0, 0],
        ]
    ),
    "back": np.diag([-1.0, 1, -1]),
    "left": np.array(
        [
            [0.0, 0, -1],
            [0, 1, 0],
            [1, 0, 0],
        ]
    ),
    "up": np.array(
        [
            [1.0, 0, 0],
            [0, 0, -1],
            [0, 1, 0],
        ]
    ),
    "down": np.array(
        [
            [1.0, 0, 0],
            [0, 0, 1],
            [0, -1, 0],
        ]
    ),
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


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Float:
    """Return the (3, 3) intrinsics of focal lengths and a principal point in pixels."""
    return np.array(
        [
            [fx, 0.0, cx],
            [0.0, fy, cy],
            [0.0, 0.0, 1.0],
        ]
    )


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
        width, height = self.size
        if self.model == "EQUIRECTANGULAR":
            return width / (2 * np.pi), height / np.pi
        if self.model in _SINGLE_FOCAL:
            return self.params[0], self.params[0]
        return self.params[0], self.params[1]

    @property
    def _centre_and_rest(self) -> tuple[float, float, tuple[float, ...]]:
        if self.model in _SINGLE_FOCAL:
            cx, cy, *rest = self.params[1:]
        else:
            cx, cy, *rest = self.params[2:]
        return cx, cy, tuple(rest)

    def turned(self, turn: Float) -> PhotoLens:
        return replace(self, turn=tuple(turn.ravel().tolist()))

    def project(self, rays: Float) -> tuple[Float, Mask]:
        """Map (N, 3) rays in the view's axes to (N, 2) pixels, and say which of them the photo holds."""
        x, y, z = np.array(self.turn).reshape(3, 3) @ rays.T
        width, height = self.size
        if self.model == "EQUIRECTANGULAR":
            longitude = np.arctan2(x, z)
            latitude = np.arctan2(y, np.hypot(x, z))
            u = (longitude / (2 * np.pi) + 0.5) * width
            v = (latitude / np.pi + 0.5) * height
            return np.stack([u, v], 1), np.ones(len(u), bool)
        across = np.hypot(x, y)
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
        inside &= (u >= 0) & (u <= width)
        inside &= (v >= 0) & (v <= height)
        return np.stack([u, v], 1), inside

    def _plane_radius(self, angle: Float) -> Float:
        """Return the radius before distortion: the angle of fisheyes, otherwise its tangent."""
        if self.model in _PLANAR:
            return np.tan(angle)
        return angle

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
        k1, k2, k3, k4, k5, k6, *_ = (*k, *[0.0] * 6)
        if self.model == "FULL_OPENCV":
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        else:
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        bent_u = u * radial + 2 * p1 * u * v
        bent_u = bent_u + p2 * (r2 + 2 * u * u)
        bent_v = v * radial + 2 * p2 * u * v
        bent_v = bent_v + p1 * (r2 + 2 * v * v)
        return bent_u + s1 * r2, bent_v + s2 * r2

    def _measure_edges(self, radii: Float, angles: Float) -> Float:
        """Return the (4,) angles of the middles of the left, right, upper and lower edge."""
        cx, cy, _ = self._centre_and_rest
        fx, fy = self.focal
        width, height = self.size
        plane_edges = np.array(
            [
                cx / fx,
                (width - cx) / fx,
                cy / fy,
                (height - cy) / fy,
            ]
        )
        return np.interp(plane_edges, radii, angles)

    def faces(self, scale: float = 1.0) -> list[Face]:
        """Return the pinhole views of a photo of `scale` times the size: one of a narrow lens, otherwise the
        faces of a cube that it holds enough of."""
        if self.model == "FULL_OPENCV":
            K = pinhole_matrix(*(scale * value for value in self.params[:4]))
            width, height = self.size
            return [("", np.eye(3), K, (round(width * scale), round(height * scale)))]
        fx, fy = self.focal
        focal = scale * float(np.sqrt(fx * fy))
        if self.model != "EQUIRECTANGULAR":
            angles = np.linspace(0, _find_end(self), 20001)[:-1]
            plane_radii = self._plane_radius(angles)
            radii = np.hypot(*self._bent(plane_radii, np.zeros(len(angles))))
            edges = self._measure_edges(radii, angles)
            if edges.max() <= _ONE_VIEW:
                left, right, top, bottom = (focal * np.tan(edge) for edge in edges)
                K = pinhole_matrix(focal, focal, left, top)
                width = max(1, round(left + right))
                height = max(1, round(top + bottom))
                return [("", np.eye(3), K, (width, height))]
        side = max(2, round(2 * focal))
        half = side / 2  # a face spans 90°, so this is also its focal length
        K = pinhole_matrix(half, half, half, half)
        steps = (np.arange(32) + 0.5) / 16 - 1
        x, y = np.meshgrid(steps, steps)
        grid = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
        found: list[Face] = []
        for name, turn in FACES.items():
            _, held = self.turned(turn).project(grid)
            if held.mean() >= _LEAST_SEEN:
                found.append((name, turn, K, (side, side)))
        return found


def _bend_by_fov(
    u: Float,
    v: Float,
    r2: Float,
    omega: float,
) -> tuple[Float, Float]:
    """Distort points by the model of a wide lens with one parameter."""
    if abs(omega) < 1e-6:
        return u, v
    r = np.sqrt(r2)
    slope = np.tan(omega / 2)
    wide = np.arctan(2 * r * slope) / omega
    factor = np.where(
        r > 1e-9,
        wide / np.maximum(r, 1e-9),
        2 * slope / omega,
    )
    return u * factor, v * factor


@lru_cache(maxsize=64)
def _find_end(lens: PhotoLens) -> float:
    """Return the angle from the axis where a lens ends: its radius stops growing, or the corners of a
    photo that shows the whole image circle begin."""
    planar = lens.model in _PLANAR
    widest = np.pi
    if planar:
        widest = np.pi / 2
    angles = np.linspace(0, widest, 20001)[:-1]
    plane_radii = lens._plane_radius(angles)
    radii, _ = lens._bent(plane_radii, np.zeros(len(angles)))
    falls = np.flatnonzero(np.diff(radii) <= 0)
    if len(falls):
        angles = angles[: falls[0] + 1]
        radii = radii[: falls[0] + 1]
    end = float(angles[-1])
    if planar:
        return end
    edge = float(lens._measure_edges(radii, angles).max())
    return min(end, max(edge, _CORNER))


def panorama_rays(width: int, height: int, rows: slice) -> Float:
    """Return unit rays (N, 3) of the pixels in some rows of a panorama, in its camera's axes."""
    v, u = np.mgrid[rows, 0:width] + 0.5
    around = 2 * np.pi * (u / width - 0.5)
    down = np.pi * (v / height - 0.5)
    level = np.cos(down)
    x = np.sin(around) * level
    y = np.sin(down)
    z = np.cos(around) * level
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def photo_of(name: str) -> str:
    """Return the name of the photo that a view of several was made from.

    >>> photo_of("a.jpg#left"), photo_of("b#1.jpg")
    ('a.jpg', 'b#1.jpg')
    """
    photo, _, face = name.rpartition("#")
    return photo if face in FACES else name
