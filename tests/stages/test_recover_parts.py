"""Schedules, anchors, regularisers, presets and checkpoints, against the paper or a naive twin."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from g2ard.errors import InputError
from g2ard.scene.shape import effective_rank, needle_share
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import (
    PAPER_REGULARIZERS,
    REGULARIZERS,
    Anchors,
    Regularizers,
    choose_regularizers,
    drift95,
    measure_view_consistency,
)
from g2ard.stages.recover.config import PAPER, TUNED, Schedule
from g2ard.stages.recover.losses import anchor_loss, regularization, shape_loss
from g2ard.stages.recover.torch_engine import SelectiveAdam
from helpers.scenes import around, checkered_ball
from reference.rotations import rotations


def random_splats(n: int = 40, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats.create(
        rng.normal(size=(n, 3)),
        quats=rng.normal(size=(n, 4)),
        scales=np.exp(rng.normal(-2, 1, size=(n, 3))),
        logit_opacities=rng.normal(size=n),
        sh0=rng.normal(size=(n, 1, 3)),
    )


def test_tuned_rates_fall_to_one_percent() -> None:
    first, half, last = (TUNED.at(t, final=True) for t in (0, 0.5, 1))
    assert first == replace(TUNED.rates, finest=TUNED.finest, momentum=TUNED.momentum)
    assert half.means == pytest.approx(TUNED.rates.means * 0.505)
    assert last.shN == pytest.approx(TUNED.rates.shN * 0.01)


def test_paper_decays_appearance_only_and_differently_in_rounds() -> None:
    end_of_round, end = PAPER.at(1, final=False), PAPER.at(1, final=True)
    assert end_of_round.means == end.means == 9.2e-4
    assert end_of_round.sh0 == pytest.approx(0.36 * 2.5e-3)
    assert end.logit_opacities == pytest.approx(0.1 * 5e-3)
    with pytest.raises(InputError, match="schedule"):
        Schedule.named("hasty")


def test_anchor_frames_put_the_thinnest_axis_last() -> None:
    splats = random_splats()
    anchors = Anchors.of(splats)
    for i in range(len(splats)):
        R, order = rotations(splats.quats[i]), np.argsort(-splats.scales[i])
        np.testing.assert_allclose(anchors.frames[i], R[:, order], atol=1e-6)
        s = splats.scales[i][order]
        assert anchors.r_perp[i] == s[2]
        assert anchors.r_parallel[i] == pytest.approx(1.5 * (s[0] + s[1]), rel=1e-6)


def test_drift_is_counted_in_thicknesses_along_the_normal() -> None:
    splats = random_splats(200)
    anchors = Anchors.of(splats)
    tangent = anchors.means + 5 * anchors.r_perp[:, None] * anchors.frames[:, :, 0]
    normal = anchors.means + 5 * anchors.r_perp[:, None] * anchors.frames[:, :, 2]
    assert drift95(anchors, tangent) < 0.05
    assert drift95(anchors, normal) == pytest.approx(5, rel=1e-2)
    assert drift95(anchors, anchors.means) == 0


def test_effective_rank_and_needle_share() -> None:
    scales = np.array([[1, 1, 1], [1, 1, 1e-6], [1, 1e-3, 1e-3]], np.float32)
    assert effective_rank(scales) == pytest.approx([3, 2, 1], abs=0.02)
    assert needle_share(scales) == pytest.approx(1 / 3)


def naive_losses(
    splats: Splats, means: np.ndarray, log_scales: np.ndarray, quats: np.ndarray
) -> tuple[float, float]:
    """`eq:anchor` and `eq:shape`, one Gaussian at a time in float64."""
    anchor = shape = 0.0
    for i in range(len(splats)):
        frame, s0 = rotations(splats.quats[i]), splats.scales[i].astype(np.float64)
        t1, t2, n = np.argsort(-s0)
        d = frame.T @ (means[i] - splats.means[i].astype(np.float64))
        parallel, perp = 3 * (s0[t1] + s0[t2]) / 2, s0[n]
        excess = (d[t1] ** 2 + d[t2] ** 2) / parallel**2 + d[n] ** 2 / perp**2 - 1
        anchor += math.log1p(max(0.0, excess))
        s, R = np.exp(log_scales[i]), rotations(quats[i])
        thick = math.sqrt(frame[:, n] @ R @ np.diag(s**2) @ R.T @ frame[:, n])
        q = s / s.sum()
        rank = math.exp(-(q * np.log(q)).sum())
        shape += max(0.0, -math.log(rank - 1 + 1e-6)) + max(0.0, math.log(thick) - math.log(perp))
    return anchor / len(splats), shape / len(splats)


def moved(splats: Splats, seed: int = 1) -> list[torch.Tensor]:
    rng = np.random.default_rng(seed)
    means = (
        splats.means + rng.normal(size=splats.means.shape) * splats.scales.max(1, keepdims=True) * 2
    )
    log_scales = splats.log_scales + rng.normal(size=splats.scales.shape)
    quats = splats.quats + 0.3 * rng.normal(size=splats.quats.shape)
    return [
        torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in (means, log_scales, quats)
    ]


def test_regularisers_equal_their_naive_twins() -> None:
    splats = random_splats()
    means, log_scales, quats = moved(splats)
    anchors = Anchors.of(splats)
    anchor, shape = naive_losses(splats, *(t.detach().numpy() for t in (means, log_scales, quats)))
    assert anchor_loss(means, anchors).item() == pytest.approx(anchor, rel=1e-4)
    assert shape_loss(
        log_scales, quats, anchors, Regularizers(0.5, 0.25, effective_rank=True)
    ).item() == pytest.approx(shape, rel=1e-4)
    both = regularization(
        means, quats, log_scales, anchors, Regularizers(0.5, 0.25, effective_rank=True)
    )
    assert both.item() == pytest.approx(0.5 * anchor + 0.25 * shape, rel=1e-4)


def test_inside_the_trust_region_nothing_pulls() -> None:
    splats = random_splats()
    anchors = Anchors.of(splats)
    inside = splats.means.astype(float) + 0.5 * anchors.r_perp[:, None] * anchors.frames[:, :, 2]
    assert anchor_loss(torch.from_numpy(inside), anchors).item() == 0


def test_auto_preset_tells_lift_trained_and_noisy_apart() -> None:
    trained = random_splats()
    lift = Splats.create(trained.means, scales=np.tile([1.0, 1.0, 0.1], (40, 1)))
    noisy = Splats.create(
        trained.means,
        scales=np.tile([1.0, 1e-3, 1e-3], (40, 1)),
        logit_opacities=trained.logit_opacities,
    )
    round_ = Splats.create(
        trained.means, scales=np.ones((40, 3)), logit_opacities=trained.logit_opacities
    )
    assert choose_regularizers("auto", lift)[0] == REGULARIZERS["lift"]
    assert choose_regularizers("auto", noisy)[0] == REGULARIZERS["noisy"]
    assert choose_regularizers("auto", round_)[0] == REGULARIZERS["trained"]
    weights, why, measured = choose_regularizers("lift", noisy)
    assert weights == REGULARIZERS["lift"]
    assert why == "lift (as requested)"
    assert (
        choose_regularizers("auto", lift, paper=True)[0]
        == PAPER_REGULARIZERS["lift"]
        == Regularizers(1e-3, 1e-4, True)
    )
    assert measured.needle == 1
    assert measured.consistency is None
    with pytest.raises(InputError, match="preset"):
        choose_regularizers("gentle", trained)


def test_views_that_see_through_each_other_s_surfaces_make_a_prior_noisy() -> None:
    ball, views = checkered_ball(), around(40, (96, 72))
    rng = np.random.default_rng(0)
    strewn = ball.means.copy()
    rows = rng.permutation(len(ball))[:1200]
    strewn[rows] = rng.normal(0, 0.8, (1200, 3))
    foggy = replace(ball, means=strewn, logit_opacities=np.full(len(ball), 3, np.float32))
    sound, loose = measure_view_consistency(ball, views), measure_view_consistency(foggy, views)
    assert loose < 0.92 < 0.97 < sound
    assert choose_regularizers("auto", ball, views)[0] == REGULARIZERS["trained"]
    weights, why, _ = choose_regularizers("auto", foggy, views)
    assert weights == REGULARIZERS["noisy"]
    assert "of the surface agrees between neighbouring views" in why
    far = np.array([447_000.0, 5_411_000.0, 130.0])
    moved = measure_view_consistency(replace(ball, offset=ball.offset + far), views.recentred(-far))
    assert moved == pytest.approx(sound, abs=0.01)
    assert measure_view_consistency(ball, views.take([0])) is None


@pytest.mark.parametrize(
    ("ratio", "agree"), [(1, 1), (1.04, 1), (1.06, 0), (1.3, 0), (0.96, 1), (0.94, 0)]
)
def test_depths_agree_within_a_twentieth(
    ratio: float, agree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two views from one place, one of which sees everything `ratio` times as far."""
    views = around(2, (32, 24))
    views = replace(views, viewmats=views.viewmats[[0, 0]])
    depths = iter([2.0, 2 * ratio, 2 * ratio, 2.0])

    class Renders:
        def __init__(self, *_: object, **__: object) -> None: ...

        def render(self, view: object, median: bool) -> SimpleNamespace:
            return SimpleNamespace(median=np.full((24, 32), next(depths)))

    monkeypatch.setattr("g2ard.stages.recover.anchors.Renderer", Renders)
    assert measure_view_consistency(checkered_ball(10), views) == agree


def test_a_scaled_schedule_keeps_its_proportions() -> None:
    small = Schedule.named("paper").scaled(3000)
    assert (small.steps, small.round_steps) == (3000, 800)
    assert small.rates == PAPER.rates
    assert Schedule.named("fast").scaled(50).round_steps == 0


@torch.no_grad()
def _step_in_torch(
    adam: SelectiveAdam, rates: dict[str, float], shares: dict[str, torch.Tensor]
) -> None:
    """Take the kernel's step with torch's operations."""
    parameters, moments = adam._parameters, adam.moments
    grads = {name: p.grad for name, p in parameters.items()}
    flat = [grad.flatten().view(len(grad), -1) for grad in grads.values()]
    touched = torch.stack([(grad != 0).any(1) for grad in flat]).any(0)
    sound = torch.stack([(grad.abs() <= 1e18).all(1) for grad in flat]).all(0)
    adam.skipped += int((touched & ~sound).sum())
    rows = (touched & sound).nonzero()[:, 0]
    adam.counts[rows] += 1
    for name in grads:
        grad, m, v = grads[name][rows], moments[f"m.{name}"], moments[f"v.{name}"]
        steps = adam.counts[rows].double().reshape(-1, *[1] * (grad.ndim - 1))
        momentum = rates["momentum"]
        bias1, bias2 = ((1 / (1 - beta**steps)).to(grad.dtype) for beta in (momentum, 0.999))
        m[rows] = m[rows].lerp_(grad, 1 - momentum)
        v[rows] = v[rows].mul_(0.999).addcmul_(grad, grad, value=0.001)
        step = (m[rows] * bias1) / ((v[rows] * bias2).sqrt_() + 1e-15)
        parameters[name][rows] -= rates[name] * step * (shares[name][rows] if name in shares else 1)


@pytest.mark.parametrize(("rows", "momentum"), [(1, 0.9), (16, 0.0), (50, 0.6), (50, 0.9)])
def test_adam_by_rows_in_rust_is_that_in_torch(rows: int, momentum: float) -> None:
    rng, broken = np.random.default_rng(0), slice(7, 8)
    shapes = {"means": (rows, 3), "logits": (rows,), "shN": (rows, 8, 3)}
    adams = []
    for _ in range(2):
        leaves = {name: torch.ones(shape).requires_grad_() for name, shape in shapes.items()}
        adams.append((leaves, SelectiveAdam(leaves)))
    for _ in range(5):
        grads = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
        still = rng.random(rows) < 0.3
        for grad in grads.values():
            grad[still] = 0
        grads["means"][broken] = np.nan
        for leaves, _ in adams:
            for name, leaf in leaves.items():
                leaf.grad = torch.from_numpy(grads[name].copy())
        rates = dict.fromkeys(shapes, 0.1) | {"momentum": momentum}
        shares = {
            "means": torch.linspace(0.1, 1, rows)[:, None],
            "shN": torch.linspace(0, 1, 24 * rows).reshape(rows, 8, 3),
        }
        adams[0][1].step(rates, shares)
        _step_in_torch(adams[1][1], rates, shares)
    (rust, kernel), (naive, twin) = adams
    assert kernel.skipped == twin.skipped == 5 * (rows > 7)
    assert torch.equal(kernel.counts, twin.counts)
    for name in shapes:
        torch.testing.assert_close(rust[name], naive[name], rtol=1e-5, atol=1e-6)
        assert bool((rust[name][broken] == 1).all())
