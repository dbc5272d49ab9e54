"""The lift of scans: their lines give as good a prior as even points, and thin things stay thin."""

import numpy as np
import pytest

from g2ard import Renderer
from g2ard.scene.cameras import Camera
from g2ard.stages.lift import _choose_anchor, lift
from helpers.clouds import lines, surface
from helpers.similarities import turn
from reference.lift import discs

SIZE, FOCAL = (96, 48), 70.0


class Box:
    """A room: distances of its walls, floor and ceiling from the scanner."""

    sides = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1], [0, 0, 1]])

    def __init__(self, height):
        self.room = np.array([6, 7, 5, 6, height, 9.0])

    def cast(self, origin, d):
        """Return the points that rays hit, and normals."""
        far = (self.room - origin @ self.sides.T) / np.maximum(d @ self.sides.T, 1e-9)
        far = np.where(d @ self.sides.T > 0, far, np.inf)
        return origin + d * far.min(-1)[..., None], self.sides[far.argmin(-1)]


class Tube:
    """A vertical cylinder, such as a silo, with a floor."""

    def __init__(self, height, radius=5.0):
        self.height, self.radius = height, radius

    def cast(self, origin, d):
        a, b, c = (
            (d[..., :2] ** 2).sum(-1),
            d[..., :2] @ origin[:2],
            origin[:2] @ origin[:2] - self.radius**2,
        )
        wall = (-b + np.sqrt(b * b - a * c)) / np.maximum(a, 1e-9)
        floor = np.where(
            d[..., 2] < 0, (self.height + origin[2]) / np.maximum(-d[..., 2], 1e-9), np.inf
        )
        p = origin + d * np.minimum(wall, floor)[..., None]
        out = np.where((wall < floor)[..., None], p * (1, 1, 0), (0, 0, -1.0))
        return p, out / np.linalg.norm(out, axis=-1, keepdims=True)


def directions(up, around):
    up, around = np.radians(up), np.radians(around)
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1)


def tilted(degrees):
    """A rotation by which a scanner leans."""
    a = np.radians(degrees)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


class Scan:
    """Rings of points on a shape, seen from the origin, with 5 mm of noise."""

    def __init__(self, shape, count, turns, lean=0.0, low=-30.0, high=10.0):
        self.shape, self.low, self.high, self.lean = shape, low, high, tilted(lean)
        up, around = np.meshgrid(
            np.linspace(low, high, count), np.arange(turns) * 360 / turns, indexing="ij"
        )
        self.points, self.normals = self._hit(directions(up.ravel(), around.ravel()))

    def _hit(self, d):
        p, n = self.shape.cast(np.zeros(3), d @ self.lean.T)
        return p + d @ self.lean.T * np.random.default_rng(0).normal(0, 0.005, (len(p), 1)), n

    def even(self):
        """Random points of the same number on the part of the shape that the rings cover."""
        rng = np.random.default_rng(1)
        u = rng.uniform(*np.sin(np.radians([self.low, self.high])), 15 * len(self.points))
        d = directions(np.degrees(np.arcsin(u)), rng.uniform(0, 360, len(u)))
        p, n = self.shape.cast(np.zeros(3), d @ self.lean.T)
        area = np.linalg.norm(p, axis=1) ** 3 / np.abs((p * n).sum(1))
        pick = rng.choice(len(d), len(self.points), replace=False, p=area / area.sum())
        return self._hit(d[pick])[0]

    def score(self, points):
        """PSNR of the lifted points, where rings cover the shape, in four views around the scanner."""
        renderer, errors = Renderer(lift(points, tint(points))), []
        for i in range(4):
            origin = np.array([0.3 * np.cos(i), 0.3 * np.sin(i), 0.1])
            ahead = directions(-10, 90 * i + 20) @ self.lean.T
            camera = Camera.facing(origin, origin + ahead, width=SIZE[0], height=SIZE[1])
            v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
            rays = (
                np.stack([u, v, np.ones_like(u)], -1)
                @ np.linalg.inv(camera.K).T
                @ camera.viewmat[:3, :3]
            )
            p = self.shape.cast(origin, rays)[0]
            up = np.degrees(np.arcsin((p @ self.lean)[..., 2] / np.linalg.norm(p, axis=-1)))
            inside = (up > self.low + 2) & (up < self.high - 2)
            errors.append((renderer.render(camera).image - tint(p))[inside] ** 2)
        return -10 * np.log10(np.concatenate(errors).mean())


def tint(p):
    return 0.5 + 0.4 * np.sin(1.4 * p + 0.9 * np.roll(p, 1, -1))


def normals(splats):
    w, x, y, z = splats.quats.T.astype(np.float64)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)


SCANS = {
    "room": (Box(1.7), 32, 1800),
    "room of 16 rings": (Box(1.7), 16, 1800),
    "room of 64 rings": (Box(1.7), 64, 600),
    "low room": (Box(0.8), 32, 900),
    "leaning in a room": (Box(1.7), 32, 900, 12),
    "much leaning in a room": (Box(1.7), 40, 900, 35),
    "silo": (Tube(1.7), 32, 900),
    "leaning in a silo": (Tube(2.5), 32, 900, 20),
    "yard": (Tube(2.0, 40), 32, 900, 0, -40, -6),
    "leaning over a yard": (Tube(5.0, 40), 48, 900, 10, -50, -18),
}


@pytest.mark.parametrize("name", SCANS)
def test_rings_lift_as_well_as_even_points(name):
    scan = Scan(*SCANS[name])
    got = lift(scan.points, tint(scan.points))
    off = np.degrees(np.arccos(np.clip(np.abs((normals(got) * scan.normals).sum(1)), 0, 1)))
    assert np.median(off) < 2
    assert scan.score(scan.points) > scan.score(scan.even())


def wire(start, end, count=300, thick=0.005, seed=0):
    """Points along a wire."""
    start, end = np.array(start, float), np.array(end, float)
    t = np.linspace(0, 1, count)[:, None]
    return start + t * (end - start) + np.random.default_rng(seed).normal(0, thick, (count, 3))


def ground(kind):
    """Points of 10 × 10 units at z = 0: at random, in lines, or of a scanner's rings."""
    rng = np.random.default_rng(3)
    if kind == "random":
        x, y = rng.uniform(-5, 5, (2, 4000))
    elif kind == "grid":
        x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-5, 5, 63)] * 2))
    elif kind == "lines":
        x, y = (v.ravel() for v in np.meshgrid(np.linspace(-5, 5, 400), np.linspace(-5, 5, 21)))
    else:
        r, a = (
            v.ravel() for v in np.meshgrid(np.geomspace(0.8, 6, 14), np.linspace(0, 2 * np.pi, 600))
        )
        x, y = r * np.cos(a), r * np.sin(a)
    return np.column_stack([x, y, rng.normal(0, 0.005, len(x))])


WIRES = {
    "along": [wire((-5, 0.1, 3), (5, 0.1, 3))],
    "low": [wire((-5, 0.1, 1), (5, 0.1, 1))],
    "high": [wire((-5, 0.1, 8), (5, 0.1, 8))],
    "across": [wire((0.2, -5, 2), (0.2, 5, 2))],
    "rising": [wire((-5, -3, 1.5), (5, 2, 4))],
    "mast": [wire((0.3, 0.2, 0.3), (0.3, 0.2, 6))],
    "leaning mast": [wire((0.3, 0.2, 0.3), (1.3, 0.7, 6))],
    "pair": [wire((-5, y, 4), (5, y, 4), seed=i) for i, y in enumerate((0, 0.5))],
    "one over the other": [wire((-5, 0, z), (5, 0, z), seed=i) for i, z in enumerate((3, 3.4))],
    "bundle": [
        wire((-5, y, z), (5, y, z), seed=i)
        for i, (y, z) in enumerate([(0, 4), (0.5, 4), (0.25, 4.4)])
    ],
    "crossing": [wire((-5, 0, 3), (5, 0, 3)), wire((0, -5, 3.5), (0, 5, 3.5), seed=1)],
}


@pytest.mark.parametrize("name", WIRES)
@pytest.mark.parametrize("kind", ["random", "grid", "lines", "rings"])
def test_wires_stay_thin(name, kind):
    """No disc of a wire reaches the next wire or the ground, and discs of the ground do not change."""
    wires, below = np.concatenate(WIRES[name]), ground(kind)
    got, alone = (lift(p, np.full(p.shape, 0.5)) for p in (np.concatenate([below, wires]), below))
    assert got.scales[len(below) :].max() < 0.15
    assert (got.scales[: len(below)] == alone.scales).all(1).mean() > 0.99


@pytest.mark.parametrize("gap", [0.2, 0.5, 1.0])
def test_wires_in_one_plane_are_no_wider_than_their_distance(gap):
    """Several wires of a fence cannot be told from lines on a wall."""
    fence = np.concatenate(
        [wire((-5, 0, z), (5, 0, z), seed=i) for i, z in enumerate(gap * np.arange(1, 6))]
    )
    got = lift(np.concatenate([ground("random"), fence]), np.full((4000 + len(fence), 3), 0.5))
    assert got.scales[4000:].max() < max(0.6 * gap, 0.15)


CLOUDS = {
    "surface": surface(),
    **{
        f"{n} lines": lines(n, each)[0] @ turn(n).T
        for n, each in ((12, 30), (9, 60), (6, 150), (5, 240))
    },
    "wire over points": np.concatenate([ground("random")[::6], *WIRES["along"]]),
    "wires over rings": np.concatenate([ground("rings")[::6], *WIRES["pair"]]),
    "rings in a room": Scan(Box(1.7), 12, 180).points,
}


@pytest.mark.parametrize("name", CLOUDS)
def test_discs_are_the_naive_twin_s(name):
    points = CLOUDS[name]
    got = lift(points, np.full_like(points, 0.25))
    want_normals, want_scales = discs(points - _choose_anchor(points))
    np.testing.assert_allclose(got.scales, want_scales, rtol=1e-4)
    np.testing.assert_allclose(np.abs((normals(got) * want_normals).sum(1)), 1, atol=1e-4)


@pytest.mark.parametrize("ratio", [3, 10, 34, 60])
@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_discs_of_scan_lines_lie_along_the_surface(ratio, noise):
    """Their width is that of the distance of lines. Noise is a share of the spacing within lines."""
    points, gap = lines(24, 23 * ratio + 1, noise * 6 / (23 * ratio))
    rotation = turn(ratio)
    got = lift(points @ rotation.T, np.full_like(points, 0.5))
    off = np.degrees(np.arccos(np.clip(np.abs(normals(got) @ rotation[:, 2]), 0, 1)))
    assert np.percentile(off, 95) < 12
    assert 0.25 < np.median(got.scales[:, 0]) / gap < 0.6
    assert np.percentile(got.scales[:, 0], 99) < 0.8 * gap


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("kind", ["grid", "random"])
def test_even_points_keep_their_own_discs(kind, noise):
    """Points in a line by chance are not widened: a tenth of the discs of random points is narrow."""
    rng, below = np.random.default_rng(4), ground(kind)
    below[:, 2] = rng.normal(0, noise, len(below))
    got = lift(below, np.full_like(below, 0.5))
    d2 = ((below[:, None, :2] - below[:400, :2]) ** 2).sum(-1) + (
        below[:, None, 2] - below[:400, 2]
    ) ** 2
    near = below[np.argsort(d2, 0, kind="stable")[:11].T]
    around = near - near.mean(1, keepdims=True)
    values = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", around, around) / 11)
    wide = 0.94 * np.sqrt(values[:, 2])
    narrow = np.maximum(0.94 * np.sqrt(values[:, 1]), wide / 4)
    np.testing.assert_allclose(got.scales[:400, :2], np.stack([wide, narrow], 1), rtol=1e-4)
