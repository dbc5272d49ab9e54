"""A small scene and views of it, for tests of whole stages."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.splats import ARRAYS, Splats


def assert_same_bits(a: Splats, b: Splats) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def checkered_ball(n: int = 3000, seed: int = 0) -> Splats:
    """Discs on a unit sphere, coloured in squares, nearly opaque; view-dependent a little."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    squares = (np.floor(3 * normals[:, 0]) + np.floor(3 * normals[:, 1])) % 2
    color = np.where(squares[:, None] > 0, [0.9, 0.5, 0.1], [0.1, 0.3, 0.7])
    # z axis → normal
    half = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(n)], 1)
    size = 1.6 * np.sqrt(4 * np.pi / n) / 2
    return Splats.create(
        normals.astype(np.float32),
        quats=half,
        scales=np.tile([size, size, size / 10], (n, 1)),
        logit_opacities=rng.normal(2.5, 0.5, n),
        sh0=((color - 0.5) / 0.28209479)[:, None],
        shN=rng.normal(0, 0.03, (n, 3, 3)),
    )


def _at(places: ArrayLike, opacity: ArrayLike = 2.0) -> Splats:
    """Return round Gaussians of several colours at some places, far from the origin."""
    count = len(np.asarray(places))
    return Splats.create(
        np.asarray(places, np.float32),
        offset=(300.0, -20.0, 7.0),
        scales=np.full((count, 3), 0.05),
        logit_opacities=np.broadcast_to(opacity, count),
        sh0=np.random.default_rng(count).normal(size=(count, 1, 3)),
    )


def degenerate_scenes() -> dict[str, Splats]:
    """Return scenes without an extent along some axes, or of next to nothing, by name."""
    spread = np.random.default_rng(0).normal(size=(60, 3))
    line = np.linspace(0, 1, 30)[:, None]
    return {
        **{f"{count}": _at(spread[:count]) for count in range(1, 6)},
        **{f"{count} in one place": _at(np.zeros((count, 3))) for count in (2, 50)},
        "nearly in one place": _at(1e-3 * spread),
        "one visible": _at(spread, np.where(np.arange(60) == 7, 2.0, -9.0)),
        "on a line": _at(line * [1.0, 2.0, 3.0]),
        "on an axis": _at(line * [0.0, 1.0, 0.0]),
        "on a plane": _at(spread * [1.0, 0.0, 1.0]),
        "on a slope": _at(spread[:, :2] @ [[1.0, 0.0, 0.3], [0.0, 1.0, 0.7]]),
    }


def under_a_sky(scene: Splats, count: int = 300, seed: int = 0) -> Splats:
    """Surround a scene with `count` faint layers, each wider than the scene and almost flat."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    layers = Splats.create(
        towards * rng.uniform(20, 60, (count, 1)),
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(np.log([12, 6, 1e-9]), 0.3, (count, 3))),
        logit_opacities=rng.normal(-2, 1, count),
        sh0=rng.normal(0, 0.6, (count, 1, 3)),
    ).with_sh_degree(scene.sh_degree)
    return replace(
        scene,
        **{name: np.concatenate([getattr(scene, name), getattr(layers, name)]) for name in ARRAYS},
    )


def around(count: int = 16, size: tuple[int, int] = (64, 48), distance: float = 3.0) -> Cameras:
    """Views on a Fibonacci sphere that face its centre."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    eyes = distance * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], 1)
    return views_at([look_at(eye, [0, 0, 0]) for eye in eyes], size, size[0])


def views_at(
    poses: Sequence[ArrayLike], size: tuple[int, int] = (64, 48), focal: float = 60.0
) -> Cameras:
    """Views at poses, (4, 4) camera_from_world, with one size and focal length in pixels."""
    (width, height), count = size, len(poses)
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    names = [f"view_{k:03d}" for k in range(count)]
    return Cameras.from_lists(poses, [K] * count, [size] * count, names)


def in_units(scene: Splats, cameras: Cameras, unit: float) -> tuple[Splats, Cameras]:
    """Return a scene and its views with all lengths multiplied."""
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, 3] *= unit
    factor = scene.means.dtype.type(unit)
    small = replace(scene, means=scene.means * factor, scales=scene.scales * np.float32(unit))
    return small, replace(cameras, viewmats=viewmats)
