"""PSNR that `simplify` has reached, in views that it has not seen."""

import numpy as np
import pytest
from numpy.typing import NDArray

import g2ard
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.scene.splats import Splats
from g2ard.stages.lift import lift

FLOORS = {
    ("layers", None): {"far": 28.40, "near": 25.11},
    ("lifted", None): {"far": 28.02, "near": 21.14},
    ("lifted", 2.5): {"far": 28.17, "near": 21.21},
}
"""dB by scene and `max_growth`, which `simplify` chooses if None. Raise a floor when a change earns it."""

TOLERANCE = 0.1
"""dB. Results of other processors differ by less."""


def pattern(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return colours of places: waves and squares."""
    waves = np.sin(places @ [[9, 2, -3], [-4, 11, 5], [6, -7, 8]])
    return 0.5 + 0.22 * waves + 0.2 * np.sign(np.sin(7 * places) * np.sin(5 * places[:, [1, 2, 0]]))


def layers(count: int = 15_000) -> Splats:
    """Return a bumpy ball as training leaves it: faint and opaque discs, many behind each other."""
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    x, y, z = towards.T
    radii = (1 + 0.12 * np.sin(5 * x) * np.sin(4 * y) * np.sin(6 * z)) * (
        1 - 0.2 * rng.random(count) ** 1.5
    )
    colors = pattern(towards) + rng.normal(0, 0.04, (count, 3))
    size = 1.2 * np.sqrt(4 * np.pi / count)
    return Splats.create(
        towards * radii[:, None],
        quats=np.stack([1 + z, -y, x, 0 * x], 1) + rng.normal(0, 0.08, (count, 4)),
        scales=size * np.exp(rng.normal(0, 0.4, (count, 3))) * [1, 1, 0.2],
        logit_opacities=np.where(
            rng.random(count) < 0.6, rng.normal(3.5, 1, count), rng.normal(-1, 1, count)
        ),
        sh0=((colors - 0.5) / 0.28209479)[:, None],
        shN=rng.normal(0, 0.04, (count, 3, 3)),
    )


def lifted(count: int = 15_000) -> Splats:
    """Return a lifted survey of one layer: waves of ground, and roofs."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (count, 3))
    block, within = np.divmod(2.5 * points[:, :2], 1)
    roof = 0.08 + 0.12 * np.abs(np.sin(block @ [3, 5]))
    points[:, 2] = np.where(
        (np.abs(within - 0.5) < 0.28).all(1), roof, 0.03 * np.sin(4 * points[:, 0])
    )
    return lift(points, np.clip(pattern(points) + rng.normal(0, 0.05, (count, 3)), 0, 1))


def views(scene: str) -> dict[str, list[Camera]]:
    """Return views of the whole scene, small, and of parts, large."""
    step = np.arange(6)
    z = np.linspace(-0.8 if scene == "layers" else 0.35, 0.9, 6)
    flat, angle = np.sqrt(1 - z * z), 2.4 * step + 0.5
    sides = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
    spots = np.stack([0.6 * np.cos(3 * step), 0.6 * np.sin(5 * step), np.full(6, 0.1)], 1)
    close = sides if scene == "layers" else spots
    return {
        "far": [
            Camera.facing(4 * side, [0, 0, 0], width=160, height=160, fov=45) for side in sides
        ],
        "near": [
            Camera.facing(spot + 0.7 * side, spot, width=400, height=400, fov=45)
            for spot, side in zip(close, sides, strict=True)
        ],
    }


@pytest.mark.parametrize(("scene", "growth"), FLOORS)
def test_a_tenth_of_the_gaussians_looks_as_good_as_before(scene: str, growth: float | None) -> None:
    dense = {"layers": layers, "lifted": lifted}[scene]()
    small = g2ard.simplify(
        dense, ratio=10, settings={} if growth is None else {"max_growth": growth}
    ).splats
    before, after = Renderer(dense), Renderer(small)
    reached = {
        name: float(np.mean([psnr(after.clipped(view), before.clipped(view)) for view in some]))
        for name, some in views(scene).items()
    }
    floors = FLOORS[scene, growth]
    assert all(reached[name] > floors[name] - TOLERANCE for name in floors), reached
