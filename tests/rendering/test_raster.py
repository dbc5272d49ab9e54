"""The rasteriser against a naive float64 oracle, and its promises: determinism, no NaN, independent calls."""

from typing import Any

import numpy as np
import pytest
import torch

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.rendering.renderer import RasterSettings, arrays_of, render, settings_for, view_of
from g2ard.rendering.visibility import visibility, visibility_source
from g2ard.scene.cameras import Cameras, look_at
from g2ard.stages.recover.rasterize import rasterize
from helpers.raster_cases import (
    NAMES,
    VARIANTS,
    Params,
    camera,
    oracle,
    scene,
    splats_of,
    tensors_of,
)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("width", "height", "off"), [(64, 48, 0.0), (37, 53, 0.2), (1, 1, 0.0), (16, 130, -0.3)]
)
def test_image_is_the_oracle_s(variant: str, width: int, height: int, off: float) -> None:
    settings = VARIANTS[variant]
    cameras = camera(width, height, off=off, seed=width)
    for seed, (n, size) in enumerate([(200, 0.05), (60, 0.4), (300, 0.004)]):
        p = scene(seed, n, degree=seed + 1, size=size)
        background = (0.2, 0.5, 0.9)
        want, _ = oracle(p, cameras, settings, background)
        image, alpha, depth = rasterize(
            *tensors_of(p), cameras, 0, background=background, settings=settings
        )
        sure = ~want.doubtful
        assert sure.double().mean() > 0.9
        for got, expected in ((image, want.image), (alpha, want.alpha), (depth, want.depth)):
            error = (got.detach().double() - expected).abs()[sure]
            assert error.quantile(0.999) < 2e-6 * max(1.0, float(expected.abs().max()))
            assert error.max() < 2e-5 * max(1.0, float(expected.abs().max()))


def test_median_depth_is_the_oracle_s() -> None:
    cameras = camera(64, 48)
    p = scene(5, 300, size=0.1)
    want, _ = oracle(p, cameras, RasterSettings(), (0, 0, 0))
    got = render(splats_of(p), cameras[0], median=True).median
    same = np.abs(got - want.median.numpy()) < 1e-4
    assert (want.median > 0).double().mean() > 0.2
    assert same.mean() > 0.999


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_are_the_oracle_s(variant: str, degree: int) -> None:
    settings = VARIANTS[variant]
    cameras = camera(40, 30, off=0.05, seed=degree)
    for seed, (n, size) in enumerate([(80, 0.15), (150, 0.03), (40, 0.6)]):
        p = scene(10 * degree + seed, n, degree, size=size)
        weights = np.random.default_rng(seed).normal(size=(30, 40, 5))
        background = (0.3, 0.1, 0.7)
        want, tensors = oracle(p, cameras, settings, background, grad=True)
        weights[want.doubtful.numpy()] = 0  # a flipped skip or stop is no gradient's fault
        w = torch.from_numpy(weights)
        loss = (
            (want.image * w[..., :3]).sum()
            + (want.alpha * w[..., 3]).sum()
            + (want.depth * w[..., 4]).sum()
        )
        loss.backward()
        mine = tensors_of(p)
        image, alpha, depth = rasterize(*mine, cameras, 0, background=background, settings=settings)
        w = w.float()
        (
            (image * w[..., :3]).sum() + (alpha * w[..., 3]).sum() + (depth * w[..., 4]).sum()
        ).backward()
        for name, a, b in zip(NAMES, mine, tensors, strict=True):
            if not a.numel():
                continue
            expected = b.grad
            error = (a.grad.double() - expected).norm() / expected.norm().clamp(min=1e-12)
            assert error < 2e-5, f"{name}: relative error {error:.2e}"


def degenerate() -> dict[str, Params]:
    """Scenes that break rasterisers, seen by a camera at (0, 0, −2) looking along +z."""
    n = 24
    base = scene(1, n, 2)
    base["means"] *= 0.3

    def changed(**change: Any) -> Params:
        return {
            k: np.broadcast_to(np.float32(change.get(k, v)), v.shape).copy()
            for k, v in base.items()
        }

    needles = base["log_scales"].copy()
    needles[:] = [1.5, -12, -12]
    ulp = np.float32(0.01)
    depths = [np.nextafter(ulp, np.float32(0)), ulp, np.nextafter(ulp, np.float32(1)), 0, -1, 1e-30]
    at_near = base["means"].copy()
    at_near[:, 2] = np.resize(depths, n) - 2
    return {
        "needles": changed(log_scales=needles),
        "flat": changed(log_scales=[-1.0, -1.0, -80.0]),
        "huge": changed(log_scales=8.0),
        "vast": changed(log_scales=40.0),
        "tiny": changed(log_scales=-80.0),
        "behind": changed(means=[0, 0, -5]),
        "in the camera": changed(means=[0, 0, -2]),
        "at the near plane": changed(means=at_near),
        "saturated": changed(logit_opacities=40.0),
        "transparent": changed(logit_opacities=-40.0),
        "identical": changed(
            means=[0.1, 0, 0],
            quats=[1, 0, 0, 0],
            log_scales=-2.0,
            logit_opacities=1.0,
            sh0=0.5,
            shN=0.1,
        ),
        "zero quaternions": changed(quats=0.0),
        "tiny quaternions": changed(quats=[1e-30, 0, 2e-30, 0]),
        "huge quaternions": changed(quats=[1e30, 0, 2e30, 0]),
        "beside the image": changed(means=[50, 0, 0]),
        "dark": changed(sh0=-9.0),
    }


@pytest.mark.parametrize("variant", ["default", "antialiased", "inria"])
@pytest.mark.parametrize("name", degenerate())
def test_degenerate_scenes(name: str, variant: str) -> None:
    p = degenerate()[name]
    settings = VARIANTS[variant]
    K = [[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]
    cameras = Cameras.from_lists(
        [look_at([0, 0, -2], [0, 0, 0], up=[0, -1, 0])], [K], [(40, 30)], ["v"]
    )
    mine = tensors_of(p)
    image, alpha, depth = rasterize(*mine, cameras, 0, background=(1, 0, 0.5), settings=settings)
    (image.sum() + alpha.sum() + depth.square().sum()).backward()
    for value in (image, alpha, depth, *(m.grad for m in mine)):
        assert torch.isfinite(value).all()
    if name == "vast":  # past what float32 can hold, such splats are left out
        assert not alpha.any()
        return
    want, theirs = oracle(p, cameras, settings, (1, 0, 0.5), grad=True)
    sure = ~want.doubtful  # a flipped skip or stop is no gradient's fault
    assert sure.double().mean() > 0.99
    assert (image - want.image).abs()[sure].quantile(0.99) < 1e-5
    ours = tensors_of(p)
    again = rasterize(*ours, cameras, 0, background=(1, 0, 0.5), settings=settings)
    for planes in (again, (want.image, want.alpha, want.depth)):
        torch.stack([plane[sure].square().sum() for plane in planes]).sum().backward()
    for key, a, b in zip(NAMES, ours, theirs, strict=True):
        assert torch.isfinite(b.grad).all(), key
        scale = b.grad.norm() + 0.05 * len(p["means"])
        assert (a.grad - b.grad).norm() <= (5e-3 if name == "needles" else 1e-5) * scale, key


def test_nothing_to_see() -> None:
    p = scene(0, 0, 3)
    cameras = camera(20, 18)
    image, alpha, depth = rasterize(
        *(mine := tensors_of(p)), cameras, 0, background=(0.25, 0.5, 0.75)
    )
    assert torch.equal(image, torch.tensor([0.25, 0.5, 0.75]).expand(18, 20, 3))
    assert not alpha.any()
    assert not depth.any()
    image.sum().backward()
    assert all(m.grad is not None and m.grad.shape == m.shape for m in mine)


@pytest.mark.parametrize("isa", _core.instruction_sets())
def test_instruction_sets_agree(isa: str) -> None:
    p = scene(0, 3000, 3, size=0.05)
    cameras = camera(100, 75)
    arrays = tuple(p[k] for k in NAMES)
    view = (cameras.viewmats[0].tolist(), [90.0, 90, 50, 37], (100, 75), 0.01)
    g = np.random.default_rng(0).normal(size=(75, 100, 3)).astype(np.float32)
    results = []
    for name in ("portable", isa):
        r = _core.Rasterizer(name)
        image = r.forward(arrays, view, RasterSettings(antialiased=False), [0, 0, 0])[0]
        results.append((image, r.backward(arrays, g)))
    (a, ga), (b, gb) = results
    assert np.quantile(np.abs(a - b), 0.999) < 2e-6
    for name, x, y in zip(NAMES, ga, gb, strict=True):
        assert np.linalg.norm(x - y) < 2e-3 * np.linalg.norm(x), name


def test_calls_are_independent() -> None:
    """Several forwards before one backward, as batches of views do."""
    p = scene(2, 200, 1)
    views = [camera(32, 24, seed=s) for s in range(3)]
    separate = []
    for v in views:
        mine = tensors_of(p)
        rasterize(*mine, v, 0)[0].square().sum().backward()
        separate.append([m.grad for m in mine])
    mine = tensors_of(p)
    total = sum(rasterize(*mine, v, 0)[0].square().sum() for v in views)
    assert isinstance(total, torch.Tensor)
    total.backward()
    for k, m in enumerate(mine):
        expected = sum(s[k] for s in separate)  # type: ignore[misc]
        assert torch.allclose(m.grad, expected, rtol=1e-5, atol=1e-6)  # type: ignore[arg-type]


def test_visibility_equals_the_oracles() -> None:
    p = scene(4, 150, 0, size=0.1)
    cameras = camera(48, 36)
    want, _ = oracle(p, cameras, RasterSettings(), (0, 0, 0))
    got = visibility(splats_of(p), cameras)
    weight = want.weight.numpy()
    assert np.allclose(got.weight, weight.sum(1), rtol=1e-4, atol=2e-2)
    assert np.abs(got.hits.astype(int) - (weight > 0).sum(1)).sum() <= 4
    assert np.allclose(got.peak, weight.max(1), rtol=1e-4, atol=1e-2)
    assert np.allclose(got.transmittance, want.before.sum(1).numpy(), rtol=1e-3, atol=2)
    dominant = np.bincount(weight.argmax(0)[weight.max(0) > 0], minlength=150)
    assert np.abs(got.dominant.astype(int) - dominant).sum() <= 4
    sampled = visibility_source(cameras, longest=48)(splats_of(p))
    squared = (want.weight * want.before).sum(1).numpy()
    assert np.allclose(sampled.weight, squared, rtol=1e-4, atol=2e-2)
    camera_z = p["means"] @ cameras.viewmats[0, 2, :3] + cameras.viewmats[0, 2, 3]
    inside = np.isfinite(got.pixel_size)
    assert 0 < inside.sum() < 150
    assert np.allclose(got.pixel_size[inside], camera_z[inside] / cameras.Ks[0, 1, 1], rtol=1e-5)


@pytest.mark.parametrize("variant", ["default", "inria-antialiased"])
def test_rows_out_of_view_are_skipped_without_a_trace(variant: str) -> None:
    """Bounds of rows change no bit of an image, whether the scene is ordered in space or not."""
    p = scene(6, 4000, 1, size=0.03, spread=2.0)
    p["log_scales"][::500] = 0.5
    order = np.lexsort(np.floor(p["means"]).T)
    settings = VARIANTS[variant]
    for rows in (order, slice(None)):
        arrays = arrays_of(splats_of({name: values[rows] for name, values in p.items()}))
        bounds, rasterizer = _core.RowBounds(arrays), _core.Rasterizer()
        for seed in range(8):
            view = view_of(camera(60, 45, distance=0.7 * seed + 0.1, seed=seed), 0, settings)
            forward = [
                rasterizer.forward(arrays, view, settings, [0.1, 0.2, 0.3], 2, given)
                for given in (None, bounds)
            ]
            for whole, skipped in zip(*forward, strict=True):
                assert whole is not None
                np.testing.assert_array_equal(whole, skipped)
            np.testing.assert_array_equal(
                rasterizer.image(arrays, view, settings, [0.1, 0.2, 0.3], bounds), forward[0][0]
            )
            pull = np.random.default_rng(seed).normal(size=(45, 60, 3)).astype(np.float32)
            after_bounds = rasterizer.backward(arrays, pull)
            rasterizer.forward(arrays, view, settings, [0.1, 0.2, 0.3])
            for a, b in zip(after_bounds, rasterizer.backward(arrays, pull), strict=True):
                np.testing.assert_array_equal(a, b)


def test_bounds_of_other_rows_are_an_error() -> None:
    arrays, others = (arrays_of(splats_of(scene(0, n, 0))) for n in (600, 200))
    settings = settings_for(arrays[0])
    view = view_of(camera(8, 8), 0, settings)
    with pytest.raises(InputError, match="bounds: expected 3 bounds"):
        _core.Rasterizer().forward(arrays, view, settings, [0.0] * 3, 1, _core.RowBounds(others))


def test_bad_input_is_named() -> None:
    p = scene(0, 4, 1)
    cameras = camera(8, 8)
    with pytest.raises(InputError, match="near: expected one distance"):
        render(splats_of(p), cameras[0], settings=RasterSettings(near=[0.1, 0.2]))
    with pytest.raises(InputError, match="alpha_max"):
        RasterSettings(alpha_max=1.5)
    with pytest.raises(InputError, match="log_scales: expected float32"):
        rasterize(*[t.double() if i == 2 else t for i, t in enumerate(tensors_of(p))], cameras, 0)
    short = tensors_of(p)
    short[1] = short[1][:3]
    with pytest.raises(InputError, match="quats: expected 4 rows of 4"):
        rasterize(*short, cameras, 0)
    with pytest.raises(InputError, match="near"):
        render(splats_of(p), cameras[0], settings=RasterSettings(near=-1.0))


def test_sums_of_each_view_alone_equal_those_of_one_call_per_view() -> None:
    p, cameras = splats_of(scene(8, 300)), [camera(40, 30, seed=seed) for seed in range(5)]
    settings, arrays = settings_for(p.means), arrays_of(p)
    views = [view_of(each, 0, settings) for each in cameras]
    together = _core.accumulate_each(arrays, views, settings)
    for view, sums in zip(views, together, strict=True):
        alone = _core.accumulate(arrays, [view], settings)
        assert sums["weight"].any()
        for name, values in alone.items():
            np.testing.assert_array_equal(sums[name], values)
