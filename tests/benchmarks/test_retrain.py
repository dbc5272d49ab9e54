"""Training by MCMC, over g2ard's rasteriser and stand-ins for gsplat, and by methods that thin a scene."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from benchmarks.baselines import fastgs, mcmc
from benchmarks.baselines.gaussianspa import GaussianSpa
from benchmarks.baselines.thinning import Training
from g2ard.errors import InputError
from g2ard.rendering.targets import TeacherRenders
from g2ard.rendering.visibility import visibility
from g2ard.scene.transform import transform
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover import losses
from helpers.raster_cases import gsplat_rasterization
from helpers.scenes import around, checkered_ball
from helpers.studies import ball_of, measured

BALL, VIEWS = checkered_ball(400), around(6, (24, 18))
TARGETS = TeacherRenders(BALL, VIEWS)


class Strategy:
    """Stand-in for gsplat's MCMCStrategy that records its calls; its noise has the covariance's units."""

    made: ClassVar[list["Strategy"]] = []

    def __init__(self, cap_max: int, refine_stop_iter: int, **others: float) -> None:
        assert set(others) <= {"noise_lr", "refine_start_iter", "refine_every", "min_opacity"}
        self.cap_max, self.refine_stop_iter = cap_max, refine_stop_iter
        self.rates: list[float] = []
        Strategy.made.append(self)

    def check_sanity(self, params: Any, optimizers: dict[str, torch.optim.Optimizer]) -> None:
        assert set(params.keys()) == set(optimizers) >= {"means", "scales", "quats", "opacities"}
        for name, optimizer in optimizers.items():
            (group,) = optimizer.param_groups
            (parameter,) = group["params"]
            assert parameter is params[name]

    def initialize_state(self) -> dict[str, Any]:
        return {"steps": []}

    def step_post_backward(
        self, params: Any, optimizers: Any, state: dict[str, Any], step: int, info: Any, lr: float
    ) -> None:
        state["steps"].append(step)
        assert state["steps"] == list(range(step + 1))
        assert len(params["means"]) <= self.cap_max
        assert all(parameter.grad is None for parameter in params.values())
        self.rates.append(lr)
        with torch.no_grad():
            params["means"] += 5e5 * lr * 1e-3 * (2 * params["scales"]).exp()


@pytest.fixture
def gsplat(monkeypatch: pytest.MonkeyPatch) -> list[Strategy]:
    stand_in = SimpleNamespace(rasterization=gsplat_rasterization, MCMCStrategy=Strategy)
    monkeypatch.setitem(sys.modules, "gsplat", stand_in)
    monkeypatch.setattr(mcmc, "has_gsplat", lambda: True)
    monkeypatch.setattr(mcmc, "DEVICE", "cpu")
    monkeypatch.setattr(Strategy, "made", [])
    return Strategy.made


def test_the_study_scores_training_like_recovery(tmp_path: Path) -> None:
    options = {"ratios": "10", "steps": "30", "protocol": "pool", "size": "40"}
    rows = measured("retrain", ball_of(tmp_path, 400), tmp_path / "run", **options)
    assert [row.get("error") for row in rows if row["variant"] == "g2ard"][-1] is None
    trained = [row for row in rows if row["variant"] == "mcmc@30"]
    assert [(row["step"], row["count"], row["final"]) for row in trained] == [
        (25, 40, 0),
        (30, 40, 1),
    ]
    assert 0 < trained[0]["seconds"] <= trained[1]["seconds"]


@pytest.mark.parametrize("method", ["gaussianspa", "fastgs"])
def test_thinning_ends_at_the_same_count(tmp_path: Path, method: str) -> None:
    options = {"ratios": "10", "steps": "60", "protocol": "pool", "size": "40", "methods": method}
    rows = measured("retrain", ball_of(tmp_path, 400), tmp_path / "run", **options)
    assert [(row["variant"], row["step"], row["final"]) for row in rows] == [
        (f"{method}@60", 25, 0),
        (f"{method}@60", 50, 0),
        (f"{method}@60", 60, 1),
    ]
    assert rows[0]["count"] > rows[1]["count"] == rows[2]["count"] == 40
    assert rows[2]["psnr"] > rows[1]["psnr"]


def test_the_scene_returns_where_it_was() -> None:
    training = Training(BALL, TARGETS, 1)
    done = training.splats()
    np.testing.assert_allclose(done.means + done.offset, BALL.means + BALL.offset, atol=1e-5)
    np.testing.assert_allclose(done.scales, BALL.scales, rtol=1e-4)
    assert evaluate(done, TARGETS).psnr > 50


def test_projection_draws_the_faint_to_zero_and_leaves_the_others() -> None:
    """After two projections of the same opacities, z − λ is −2α for the faint half and α for the other."""
    logits = np.where(np.arange(400) < 200, -2, 0.5).astype(np.float32)
    training, strategy = (
        Training(replace(BALL, logit_opacities=logits), TARGETS, 1),
        GaussianSpa(200, 1000),
    )
    first = strategy.penalty(training)
    strategy._project(training)
    alpha = 1 / (1 + np.exp(-logits))
    np.testing.assert_allclose(
        strategy._goal.numpy(), np.where(logits < 0, -2 * alpha, alpha), rtol=1e-5
    )
    second = strategy.penalty(training)
    assert second.item() == pytest.approx(9 / 4 * first.item(), rel=1e-5)
    second.backward()
    gradients = training.values["logit_opacities"].grad.numpy()
    assert (gradients[:200] > 0).all()
    np.testing.assert_allclose(gradients[200:], 0, atol=1e-9)


def test_the_footprint_counts_pixels() -> None:
    """Over all pixels, it is what `visibility` counts with the same conventions."""
    training = Training(BALL, TARGETS, 1)
    pixels = torch.ones(18, 24)
    touched = visibility(BALL, VIEWS.take([0]), settings=fastgs._FOOTPRINT).hits
    found = fastgs.footprint(training, 0, pixels).numpy()
    assert np.corrcoef(found, touched)[0, 1] > 0.99
    pixels[:, :12] = 0
    assert (fastgs.footprint(training, 0, pixels).numpy() <= found).all()


def test_gsplat_is_called_as_documented(gsplat: list[Strategy]) -> None:
    """Only the rasteriser differs, given the same noise and no relocation."""
    first, _ = mcmc.train(BALL, 30, TARGETS, 1, gsplat=True)
    done, seconds = mcmc.train(BALL, 30, TARGETS, 18, gsplat=True)
    assert (gsplat[-1].cap_max, gsplat[-1].refine_stop_iter) == (30, 15)
    assert (len(done), done.sh_degree) == (30, 3)
    assert seconds > 0
    assert evaluate(done, TARGETS).psnr > evaluate(first, TARGETS).psnr
    rates = gsplat[-1].rates
    assert rates[-1] == pytest.approx(0.01 * 1.76e-4)
    assert np.allclose(np.diff(np.log(rates)), np.log(0.01) / 18)


def test_the_loss_in_plain_torch_is_the_fused_one() -> None:
    torch.manual_seed(0)
    target = torch.rand(37, 53, 3)
    mixed = 0.7 * target + 0.3 * torch.rand(37, 53, 3)
    found = []
    for loss in (losses.l1_ssim, mcmc.l1_ssim):
        image = mixed.clone().requires_grad_()
        value = loss(image, target, 0.3)
        value.backward()
        found.append((value.detach(), image.grad))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=1e-6)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-3, atol=1e-8)


def test_gsplat_without_a_gpu_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcmc, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="gsplat needs an NVIDIA GPU"):
        mcmc.train(BALL, 30, TARGETS, 1, gsplat=True)


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_relocated_copies_take_the_light_of_one(copies: int, opacity: float) -> None:
    """One behind another, they absorb at the centre and summed over a line what the one did."""
    table = mcmc._Strategy(0).initialize_state()["coefficients"]
    found, shrink = mcmc.relocated(torch.tensor([opacity]), torch.tensor([copies]), table)
    x = np.linspace(-12, 12, 20_001)
    one = opacity * np.exp(-(x**2) / 2)
    many = 1 - (1 - found.item() * np.exp(-((x / shrink.item()) ** 2) / 2)) ** copies
    assert many.max() == pytest.approx(opacity, rel=1e-5)
    assert many.sum() == pytest.approx(one.sum(), rel=1e-3)


def test_dead_gaussians_move_onto_living_ones() -> None:
    start = {
        "opacities": torch.tensor([-9.0, 2.0, -9.0]),
        "scales": torch.zeros(3, 3),
        "means": torch.eye(3),
    }
    values = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value) for name, value in start.items()}
    )
    optimizers = {name: torch.optim.Adam([value]) for name, value in values.items()}
    sum(value.sum() for value in values.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()
    strategy = mcmc._Strategy(9999)
    with torch.no_grad():
        mcmc._relocate(values, optimizers, strategy.initialize_state()["coefficients"])
        assert values["means"].detach().numpy().tolist() == [values["means"][1].tolist()] * 3
    assert torch.all(values["opacities"] == values["opacities"][0])
    moments = optimizers["means"].state[values["means"]]["exp_avg"]
    assert moments[1].abs().sum() == 0
    assert moments[0].abs().sum() > 0


class Fixed(TeacherRenders):
    """Targets of other cameras with the images of `TARGETS`."""

    def __getitem__(self, view: int) -> Any:
        return TARGETS[view]


@pytest.mark.parametrize(
    ("scale", "shift"), [(8.0, (40.0, -24.0, 16.0)), (1 / 64, (0.0, 1.0, 0.0))]
)
def test_it_is_the_same_at_any_place_and_scale(
    scale: float, shift: tuple[float, float, float]
) -> None:
    """Rates, noise and weights of MCMC are for cameras within a unit sphere."""
    world = np.diag([scale, scale, scale, 1.0])
    world[:3, 3] = shift
    viewmats = VIEWS.viewmats.copy()
    viewmats[:, :3, 3] = scale * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ world[:3, 3]
    there = transform(BALL, world)
    here, _ = mcmc.train(BALL, 30, TARGETS, 4)
    done, _ = mcmc.train(there, 30, Fixed(there, replace(VIEWS, viewmats=viewmats)), 4)
    expected = scale * here.means.astype(np.float64) + world[:3, 3]
    np.testing.assert_allclose(done.means + done.offset, expected, rtol=0, atol=1e-3 * scale)
    np.testing.assert_allclose(done.scales, scale * here.scales, rtol=1e-3)


def test_the_start_is_points_and_colours_alone() -> None:
    wild = replace(BALL, scales=BALL.scales * 3, logit_opacities=BALL.logit_opacities - 2)
    a, b = (mcmc.train(scene, 50, TARGETS, 2)[0] for scene in (BALL, wild))
    np.testing.assert_array_equal(a.means, b.means)
    with pytest.raises(InputError, match="count: expected 1 to 400"):
        mcmc.train(BALL, 401, TARGETS, 2)
