"""Scenes, views and checks that the tests of simplification share."""

import numpy as np
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.scene.prepared import finite_rows_of
from g2ard.scene.splats import ARRAYS, Splats, unit_quats
from g2ard.stages.simplify import SimplifyConfig


def scene(n=2000, rest=3, seed=0, dtype=np.float32):
    """Discs on a wavy surface, smooth in colour on one half, noisy on the other, on a dyadic lattice."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-4, 4, (2, n))
    means = np.stack([x, y, 0.3 * np.sin(x)], 1)
    color = np.stack([0.1 * x, 0.1 * y, 0 * x], 1) + (x > 0)[:, None] * rng.normal(size=(n, 3))
    return Splats.create(
        (np.round(means * 2**12) / 2**12).astype(dtype),
        quats=rng.normal(size=(n, 4)),
        scales=np.exp(rng.normal(-2.5, 0.3, (n, 3))) * [1, 1, 0.2],
        logit_opacities=rng.normal(0, 2, n),
        sh0=color[:, None],
        shN=rng.normal(0, 0.1, (n, rest, 3)),
    )


def assert_sound(result, count, budget, least=1e-45):
    """Check what holds for every result, whatever the input; no scale is below `least`."""
    out = result.splats
    assert len(out) == budget
    assert np.isfinite(out.logit_opacities).all()
    assert out.finite_rows().all()
    assert (out.scales >= least).all()
    assert result.parents.shape == (count,)
    assert result.parents.dtype == np.int64
    used = np.unique(result.parents[result.parents >= 0])
    np.testing.assert_array_equal(used, np.arange(budget))
    assert result.protected.shape == (budget,)
    assert result.report.output_count == budget


class Views:
    """Visibility with given values, as `g2ard.rendering.visibility` returns it."""

    def __init__(self, weight, pixel_size):
        self.weight, self.pixel_size = np.asarray(weight), np.asarray(pixel_size)


def opaque_wall():
    """1,600 opaque discs, thin along z, that overlap into a wall; a view of it."""
    from g2ard.scene.cameras import Cameras, look_at

    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], 1)
    wall = Splats.create(
        points, scales=np.tile([0.04, 0.04, 0.002], (1600, 1)), logit_opacities=np.full(1600, 6)
    )
    eyes = [[0, 0, -3], [0.5, 0.2, -3], [-0.4, 0.3, -2.8]]
    pose = [look_at(eye, [0, 0, 0], up=(0, -1, 0)) for eye in eyes]
    K = [[150, 0, 40], [0, 150, 30], [0, 0, 1]]
    return wall, Cameras.from_lists(pose, [K] * 3, [(80, 60)] * 3, ["a", "b", "c"])


def all_alike(splats):
    """Visibility from views that see every Gaussian alike."""
    return Views(np.ones(len(splats)), np.full(len(splats), 0.01))


def assert_kept(prior, row, out, at):
    """Check that a row that merged with no other is unchanged, except that its quaternion has length 1."""
    for name in ARRAYS:
        before = getattr(prior, name)[row]
        before = before if name != "quats" else unit_quats(before[None])[0]
        np.testing.assert_array_equal(getattr(out, name)[at], before, err_msg=name)


def flag(splats: Splats, budget: int, config: SimplifyConfig | None = None) -> NDArray[np.bool_]:
    """Return which Gaussians `paper` protects for a final budget: p_i = 1[E_c(i) > ε_h] (eq. `frequency`)."""
    scene, finite = finite_rows_of(splats)
    paper = (config or SimplifyConfig()).turned("paper").resolved()
    flags = np.zeros(len(splats), bool)
    flags[finite] = _core.simplify_flags(scene.core, budget, paper)
    return flags
