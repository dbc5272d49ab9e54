"""Pruning baselines: their scores against naive float64 twins, and exact counts."""

import numpy as np
import pytest
import torch

from benchmarks.baselines import METHODS, reduce
from benchmarks.baselines.pruning import global_significance, importance, largest_share, sample
from benchmarks.baselines.pup import _log_det, _quarter, fisher, rounds
from g2ard.config.choices import BLACK
from g2ard.errors import InputError
from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Camera
from g2ard.scene.splats import Splats
from helpers.raster_cases import NAMES, Params, oracle, scene, splats_of
from helpers.scenes import around, checkered_ball
from reference import raster as naive

VIEWS = around(3, size=(14, 11))
SETTINGS = RasterSettings(antialiased=False)


def case(n: int = 12, degree: int = 1) -> tuple[Params, Splats]:
    params = scene(5, n, degree, size=0.2)
    return params, splats_of(params)


def seen(params: Params) -> list[naive.Oracle]:
    """Return the naive render of every view."""
    return [oracle(params, VIEWS.take([i]), SETTINGS, BLACK)[0] for i in range(len(VIEWS))]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_pups_fisher_estimates_the_gram_matrix_of_autograds_jacobian(degree: int) -> None:
    params, s = case(degree=degree)
    expected = np.zeros((len(s), 6, 6))
    fixed = [torch.from_numpy(params[name].astype(np.float64)) for name in NAMES]
    for i, view in enumerate(VIEWS):

        def image(means: torch.Tensor, log_scales: torch.Tensor, i: int = i, view: Camera = view):
            tensors = [means, fixed[1], log_scales, *fixed[3:]]
            pose, K = (torch.from_numpy(array[i]) for array in (VIEWS.viewmats, VIEWS.Ks))
            return naive.render(
                *tensors, viewmat=pose, K=K, width=view.width, height=view.height
            ).image

        by_mean, by_scale = torch.autograd.functional.jacobian(
            image, (fixed[0], fixed[2]), vectorize=True
        )
        g = torch.cat([by_mean, by_scale], -1).reshape(-1, len(s), 6).numpy()
        expected += np.einsum("pni,pnj->nij", g, g)
    found = fisher(s, VIEWS, probes=4000)
    size = np.sqrt(np.einsum("nii->ni", expected))
    np.testing.assert_allclose(
        found / (size[:, :, None] * size[:, None]),
        expected / (size[:, :, None] * size[:, None]),
        atol=0.15,
    )
    assert (size > 0).all()
    np.testing.assert_allclose(_log_det(found), np.linalg.slogdet(expected)[1], atol=0.5)


def test_pup_prunes_the_singular_first_and_looks_at_a_quarter() -> None:
    _, s = case(40)
    hidden = Splats.create(s.means + np.float32([0, 0, 50]), scales=s.scales)  # beyond every view
    both = Splats.create(
        np.concatenate([hidden.means, s.means]),
        quats=np.concatenate([hidden.quats, s.quats]),
        scales=np.concatenate([hidden.scales, s.scales]),
    )
    big = around(8, size=(90, 61))
    assert _quarter(big).widths[0] == 23
    assert _quarter(big).heights[0] == 16
    np.testing.assert_array_equal(reduce("pup", both, 30, big).means[:, 2] > 25, False)
    np.testing.assert_array_equal(_log_det(np.stack([np.ones((6, 6)), np.eye(6)])), [-np.inf, 0])
    assert rounds(90, 9) == [18, 9]
    assert rounds(1000, 33)[-1] == 33


def test_lightgaussians_significance_equals_the_twins() -> None:
    params, s = case(10)
    volume = s.scales.astype(float).prod(1)
    expected = s.opacities * sum(out.before.sum(1).numpy() for out in seen(params))
    expected *= (volume / sorted(volume, reverse=True)[9]) ** 0.1
    np.testing.assert_allclose(global_significance(s, VIEWS), expected, rtol=1e-4)


@pytest.mark.parametrize("indoor", [True, False])
def test_mini_splattings_importance_equals_the_twins(indoor: bool) -> None:
    params, s = case(14)
    expected, leads = np.zeros(len(s)), np.zeros(len(s))
    for out in seen(params):
        w = out.weight.numpy()
        lead = np.bincount(w.argmax(0)[w.max(0) > 0], minlength=len(s))
        leads += lead
        area = (w > 0).sum(1)
        share = w.sum(1) / np.maximum(area, 1)
        expected += w.sum(1) if indoor else np.where(lead > 0, share, 0)
    expected[leads == 0] = 0
    assert (expected == 0).any()
    np.testing.assert_allclose(importance(s, VIEWS, indoor=indoor), expected, rtol=1e-4)


def test_the_coresets_shares_equal_the_twins() -> None:
    params, s = case(14)
    light = np.stack([out.weight.numpy().sum(1) for out in seen(params)])
    np.testing.assert_allclose(
        largest_share(s, VIEWS), (light / light.sum(1, keepdims=True)).max(0), rtol=1e-4
    )


def test_sampling_follows_the_weights() -> None:
    weights = np.array([1.0, 2.0, 0.0, 5.0])
    first = np.zeros(4)
    for seed in range(4000):
        first[sample(weights, 1, seed=seed)] += 1
    np.testing.assert_allclose(first / 4000, weights / 8, atol=0.03)
    assert first[2] == 0
    assert sample(weights, 4).tolist() == [0, 1, 2, 3]
    # Second draws follow the weights of those left: P(both of 0, 1) = 1/8·2/7 + 2/8·1/6.
    pairs = [tuple(sample(weights, 2, seed=seed)) for seed in range(4000)]
    assert pairs.count((0, 1)) / 4000 == pytest.approx(1 / 28 + 1 / 24, abs=0.015)


@pytest.mark.parametrize("method", METHODS)
def test_every_baseline_keeps_exactly_the_budget(method: str) -> None:
    ball, views = checkered_ball(600), around(4)
    for budget in (1, 37, 600):
        assert len(reduce(method, ball, budget, views)) == budget
    again = [reduce(method, ball, 50, views, seed=3).fingerprint() for _ in range(2)]
    assert again[0] == again[1]
    for budget in (0, 601):
        with pytest.raises(InputError, match="budget"):
            reduce(method, ball, budget, views)
    with pytest.raises(InputError, match="expected one of"):
        reduce("magic", ball, 3, views)
