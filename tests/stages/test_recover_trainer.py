"""The fused trainer, on CPU and GPU, does what rasterize + l1_ssim + torch's Adam do, sparsely."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.rendering.renderer import RasterSettings, view_of
from g2ard.scene.cameras import Cameras
from g2ard.stages.recover.anchors import Anchors, Regularizers
from g2ard.stages.recover.config import Rates
from g2ard.stages.recover.engine import Photometric
from g2ard.stages.recover.losses import l1_ssim, measure_extents, regularization, share_of_rate
from g2ard.stages.recover.rasterize import rasterize
from g2ard.system import devices
from helpers.gpus import skip_without_gpu
from helpers.raster_cases import NAMES, Params, camera, scene, splats_of, tensors_of

RATES = {
    "means": 2e-3,
    "quats": 1e-2,
    "log_scales": 2e-2,
    "logit_opacities": 5e-2,
    "sh0": 2e-2,
    "shN": 2e-3,
}
BACKGROUND = (0.1, 0.2, 0.3)
SETTINGS = RasterSettings(antialiased=False)


def arrays(p: Params) -> tuple[NDArray[np.float32], ...]:
    return tuple(p[k] for k in NAMES)


CPU = _core.instruction_sets()[0]
every_isa = pytest.mark.parametrize("on", [*_core.instruction_sets(), "gpu"])
on_both = pytest.mark.parametrize("on", [CPU, "gpu"])


@pytest.fixture(scope="module", autouse=True)
def gpu() -> Iterator[None]:
    """Use the GPU for trainers without an instruction set."""
    devices.use("gpu")
    yield
    assert devices.notes() == [] or not devices.adapters()
    devices.use("cpu")


def trainer_of(p: Params, units: NDArray[np.float32] | None = None, on: str = CPU) -> _core.Trainer:
    """A trainer on the GPU, or on the CPU by an instruction set."""
    if on == "gpu":
        skip_without_gpu()
    isa = None if on == "gpu" else on
    return _core.Trainer(arrays(p), Photometric(SETTINGS, BACKGROUND, 0.2), units, isa)


def step(
    trainer: _core.Trainer,
    v: Cameras,
    target: Any,
    regularizers: Any = None,
    reach: float | None = None,
    finest: float = 0.0,
    momentum: float = 0.9,
) -> tuple[float, int]:
    view = view_of(v, 0, SETTINGS)
    share = math.inf if reach is None else reach / max(target.shape)
    rates = Rates(**RATES, reach=share, finest=finest, momentum=momentum)
    return trainer.step(view, target, rates, regularizers)


def problem(
    n: int = 200, degree: int = 3, views: int = 3
) -> tuple[Params, list[Cameras], list[Any]]:
    rng = np.random.default_rng(1)
    p = scene(7, n, degree, size=0.15, spread=0.5)
    cameras = [camera(56, 40, seed=s) for s in range(views)]
    targets = [rng.random((40, 56, 3)).astype(np.float32) for _ in cameras]
    return p, cameras, targets


def naive_shares(
    p: dict[str, NDArray[Any]], cameras: Cameras, reach: float, finest: float = 0.0
) -> dict[str, NDArray[Any]]:
    """σ²/(σ² + finest²) / (1 + (σ/reach)¹⁶) in float64: σ by the eigenvalues of J W R S Sᵀ Rᵀ Wᵀ Jᵀ."""

    def share(sizes: Any) -> Any:
        return (sizes**2 / (sizes**2 + finest**2) if finest else 1.0) / (1 + (sizes / reach) ** 16)

    W, K = cameras.viewmats[0], cameras.Ks[0]
    size = np.array([cameras.widths[0], cameras.heights[0]])
    focal = np.array([K[0, 0], K[1, 1]])
    low, high = (-K[:2, 2] - 0.15 * size) / focal, (size - K[:2, 2] + 0.15 * size) / focal
    whole, own = np.ones((len(p["means"]), 1)), np.ones((len(p["means"]), 3))
    for i in range(len(whole)):
        x, y, z = W[:3, :3] @ p["means"][i] + W[:3, 3]
        if z < SETTINGS.near_of(0):
            continue
        u, v = np.clip([x / z, y / z], low, high)
        J = np.array([[focal[0] / z, 0, -focal[0] * u / z], [0, focal[1] / z, -focal[1] * v / z]])
        a, b, c, d = p["quats"][i] / np.linalg.norm(p["quats"][i])
        q = np.array([[0, -d, c], [d, 0, -b], [-c, b, 0]])
        R = np.eye(3) + 2 * a * q + 2 * q @ q
        M = J @ W[:3, :3] @ R @ np.diag(np.exp(p["log_scales"][i]))
        whole[i] = share(np.sqrt(np.linalg.eigvalsh(M @ M.T)[1]))
        own[i] = share(np.linalg.norm(M, axis=0))
    return {"means": whole, "quats": whole, "log_scales": own}


class Twin:
    """Torch's step, but only for rows with a gradient, each with its own count: Adam in float64."""

    def __init__(self, p: Params, units: NDArray[np.float32] | None = None) -> None:
        self.p = {k: v.astype(np.float64) for k, v in p.items()}
        self.m = {k: np.zeros_like(v) for k, v in self.p.items()}
        self.v = {k: np.zeros_like(v) for k, v in self.p.items()}
        self.t = np.zeros(len(p["means"]))
        self.units = np.ones(len(self.t)) if units is None else units.astype(np.float64)

    def step(
        self,
        cameras: Cameras,
        target: Any,
        extra: Any = None,
        reach: float = math.inf,
        finest: float = 0.0,
        momentum: float = 0.9,
    ) -> float:
        shares = naive_shares(self.p, cameras, reach, finest)
        mine = tensors_of({k: v.astype(np.float32) for k, v in self.p.items()})
        image, _, _ = rasterize(*mine, cameras, 0, background=BACKGROUND, settings=SETTINGS)
        loss = l1_ssim(image, torch.from_numpy(target), 0.2)
        total = loss if extra is None else loss + extra(dict(zip(NAMES, mine, strict=True)))
        total.backward()
        grads = {
            k: m.grad.double().numpy()
            for k, m in zip(NAMES, mine, strict=True)
            if m.grad is not None
        }
        rows = np.zeros(len(self.t), bool)
        for g in grads.values():
            rows |= (g.reshape(len(g), -1) != 0).any(1) if g.size else False
        self.t += rows
        for k, g in grads.items():
            r = rows.reshape(-1, *[1] * (g.ndim - 1))
            t = np.maximum(self.t, 1).reshape(r.shape)
            self.m[k] = np.where(r, momentum * self.m[k] + (1 - momentum) * g, self.m[k])
            self.v[k] = np.where(r, 0.999 * self.v[k] + 0.001 * g * g, self.v[k])
            m, v = self.m[k] / (1 - momentum**t), self.v[k] / (1 - 0.999**t)
            unit = self.units.reshape(r.shape) if k == "means" else 1.0
            unit = unit * shares.get(k, 1.0)
            self.p[k] = np.where(
                r, self.p[k] - RATES[k] * unit * m / (np.sqrt(v) + 1e-15), self.p[k]
            )
        return loss.item()


def assert_close(
    got: list[NDArray[np.float32]], want: dict[str, NDArray[Any]], start: Params, to: float
) -> None:
    for name, a in zip(NAMES, got, strict=True):
        if not a.size:
            continue
        moved = np.linalg.norm(want[name] - start[name])
        # Adam turns a gradient lost in rounding into a full step: a few rows may differ, most may not.
        close = np.abs(a - want[name]) <= to * np.maximum(
            np.abs(want[name] - start[name]), RATES[name]
        )
        assert close.mean() > 0.99, f"{name}: {1 - close.mean():.4f} of the values differ"
        assert np.linalg.norm(a - want[name]) < 0.1 * moved, name


@every_isa
@pytest.mark.parametrize(("degree", "momentum"), [(0, 0.9), (2, 0.0), (3, 0.6)])
def test_steps_are_torch_s(degree: int, momentum: float, on: str) -> None:
    p, cameras, targets = problem(degree=degree)
    units = np.exp(p["log_scales"]).max(1)
    trainer, twin = trainer_of(p, units, on), Twin(p, units)
    for i in range(6):
        loss, updated = step(trainer, cameras[i % 3], targets[i % 3], momentum=momentum)
        want = twin.step(cameras[i % 3], targets[i % 3], momentum=momentum)
        assert abs(loss - want) < 1e-4
        assert 0 < updated <= len(p["means"])
    assert_close(trainer.arrays(), twin.p, p, to=2e-2)
    assert trainer.skipped == 0


@on_both
@pytest.mark.parametrize(("reach", "finest"), [(3.0, 0.0), (6.0, 2.0), (math.inf, 2.0)])
def test_what_a_view_shows_too_large_or_cannot_resolve_moves_less(
    on: str, reach: float, finest: float
) -> None:
    p, cameras, targets = problem()
    p["log_scales"][::7] += 2
    p["log_scales"][::7, 1] -= 9
    sizes = {"reach": None if math.isinf(reach) else reach, "finest": finest}
    shares = naive_shares(p, cameras[0], reach, finest)
    assert all(np.ptp(np.quantile(share, [0.05, 0.95])) > 0.5 for share in shares.values())
    trainer, twin = trainer_of(p, on=on), Twin(p)
    for i in range(6):
        step(trainer, cameras[i % 3], targets[i % 3], **sizes)
        twin.step(cameras[i % 3], targets[i % 3], reach=reach, finest=finest)
    assert_close(trainer.arrays(), twin.p, p, to=2e-2)
    free = trainer_of(p, on=on)
    step(free, cameras[0], targets[0])
    limited = trainer_of(p, on=on)
    step(limited, cameras[0], targets[0], **sizes)
    for name, a, b in zip(NAMES, limited.arrays(), free.arrays(), strict=True):
        if name in shares:  # the first step of Adam is the rate itself
            want = shares[name] * (b - p[name])
            assert np.abs(a - p[name] - want).max() < 5e-4 * RATES[name] + 1e-6, name
        else:
            assert np.array_equal(a, b), name


def test_sizes_on_the_screen_are_the_naive_ones() -> None:
    p, cameras, _ = problem()
    p["means"][::9] *= 20  # some far off the image, some behind the camera
    p["log_scales"][::5, 2] = -25
    tensors = [torch.from_numpy(p[k].astype(np.float64)) for k in ("means", "quats", "log_scales")]
    largest, axes = measure_extents(*tensors, cameras[0], 0, SETTINGS.near_of(0))
    want = naive_shares(p, cameras[0], 3.0)
    np.testing.assert_allclose(
        share_of_rate(largest, 3.0)[:, None], want["means"], rtol=1e-4, atol=1e-12
    )
    np.testing.assert_allclose(share_of_rate(axes, 3.0), want["log_scales"], rtol=1e-4, atol=1e-12)
    want, ahead = naive_shares(p, cameras[0], 3.0, 1.0), largest > 0
    found = share_of_rate(axes, 3.0, 1.0)
    np.testing.assert_allclose(
        found[ahead], want["log_scales"][ahead.numpy()], rtol=1e-4, atol=1e-12
    )


@on_both
def test_untouched_gaussians_do_not_move(on: str) -> None:
    p, cameras, targets = problem()
    p["means"][:50] += 100
    trainer = trainer_of(p, on=on)
    for _ in range(3):
        _, updated = step(trainer, cameras[0], targets[0])
        assert updated <= 150
    for name, a in zip(NAMES, trainer.arrays(), strict=True):
        assert np.array_equal(a[:50], p[name][:50])
    assert not np.array_equal(trainer.arrays()[0][50:], p["means"][50:])


@on_both
def test_relative_steps_descend_the_logarithm_of_the_loss(on: str) -> None:
    p, (view, *_), (target, *_) = problem()
    plain, relative = trainer_of(p, on=on), trainer_of(p, on=on)
    loss, _ = plain.step(view_of(view, 0, SETTINGS), target, Rates(**RATES))
    assert (
        relative.step(view_of(view, 0, SETTINGS), target, Rates(**RATES), relative=0.02)[0] == loss
    )
    want = plain.state()["first"] * np.float32(0.02 / loss)
    np.testing.assert_allclose(
        relative.state()["first"], want, rtol=1e-3, atol=1e-3 * np.abs(want).max()
    )


@pytest.mark.parametrize(
    "weights",
    [
        Regularizers(5.0, 0.0, False),
        Regularizers(0.0, 3.0, False),
        Regularizers(0.0, 3.0, True),
        Regularizers(5, 3, True),
        Regularizers(5, 3, True, thickness=0.2, rank_offset=1e-2),
        Regularizers(0, 3, True, thickness=0.0),
    ],
)
@on_both
def test_regularizers_are_torch_s(weights: Regularizers, on: str) -> None:
    """The step follows the summed gradient, from a scene with needles that has left its anchors."""
    p, cameras, targets = problem(n=100, degree=0)
    anchors = Anchors.of(splats_of(p))
    rng = np.random.default_rng(3)
    p["means"] += (0.3 * rng.normal(size=p["means"].shape)).astype(np.float32)
    p["log_scales"] += rng.normal(size=p["log_scales"].shape).astype(np.float32)
    p["log_scales"][::5, 1:] -= 6
    p["quats"] += (0.3 * rng.normal(size=p["quats"].shape)).astype(np.float32)

    def extra(q: dict[str, torch.Tensor]) -> torch.Tensor:
        return regularization(q["means"], q["quats"], q["log_scales"], anchors, weights)

    trainer, twin = trainer_of(p, on=on), Twin(p)
    trainer.anchor(
        anchors.means, np.ascontiguousarray(anchors.frames), anchors.r_parallel, anchors.r_perp
    )
    for i in range(3):
        step(trainer, cameras[i], targets[i], weights)
        twin.step(cameras[i], targets[i], extra)
    assert_close(trainer.arrays(), twin.p, p, to=3e-2)
    # The moments hold the gradients themselves: they show the scale that Adam's steps hide.
    first = trainer.state()["first"].reshape(100, -1)
    for name, columns in (
        ("means", slice(0, 3)),
        ("quats", slice(3, 7)),
        ("log_scales", slice(7, 10)),
    ):
        error = np.linalg.norm(first[:, columns] - twin.m[name]) / np.linalg.norm(twin.m[name])
        assert error < 2e-3, f"{name}: {error}"


@on_both
def test_gradients_that_are_not_finite_are_skipped_and_counted(on: str) -> None:
    p, cameras, targets = problem(n=50)
    target = targets[0].copy()
    target[20, 28] = np.nan
    trainer = trainer_of(p, on=on)
    _, updated = step(trainer, cameras[0], target)
    assert trainer.skipped > 0
    assert updated + trainer.skipped <= 50
    assert all(np.isfinite(a).all() for a in trainer.arrays())


@on_both
def test_bad_input_is_named(on: str) -> None:
    p, cameras, targets = problem(n=10)
    with pytest.raises(InputError, match="target: expected 6720 values"):
        step(trainer_of(p, on=on), cameras[0], targets[0][:5])
    with pytest.raises(InputError, match="anchors set before"):
        step(trainer_of(p, on=on), cameras[0], targets[0], Regularizers(1.0, 1.0, True))
    with pytest.raises(InputError, match=r"reach: .* above 0"):
        step(trainer_of(p, on=on), cameras[0], targets[0], reach=0.0)
    with pytest.raises(InputError, match="units: expected 10 values"):
        trainer_of(p, np.ones(9, np.float32), on)
    state = trainer_of(p, on=on).state()
    state["order"][:] = 0
    with pytest.raises(InputError, match="order: expected a permutation"):
        trainer_of(p, on=on).load(state)
