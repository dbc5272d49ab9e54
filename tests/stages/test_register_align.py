"""Direct alignment: against naive twins, rendered differences, and poses that are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import g2ard._core as _core
from g2ard.rendering.renderer import Renderer
from g2ard.stages.register.align import Aligned, Shot, align, level_of, normal_equations, shot_of
from g2ard.stages.register.attempts import Search
from g2ard.stages.register.config import RegisterConfig
from g2ard.stages.register.grey import grey_of, local_zncc, shift_between, zncc
from g2ard.stages.register.pose import motion_between, moved, pose_error
from helpers.registration import BALL, CONFIG, off, pyramid_of
from helpers.scenes import around
from reference import register as twin


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.floats(1e-9, 1))
def test_motions_are_the_exponential(xi: list[float], size: float) -> None:
    motion = np.array(xi) * size
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = twin.cross(motion[3:]), motion[:3]
    small = np.eye(4) + twist / 2**20 + (twist / 2**20) @ (twist / 2**20) / 2
    for _ in range(20):  # squared 20 times
        small = small @ small
    np.testing.assert_allclose(moved(np.eye(4), motion), small, atol=1e-7)
    back = moved(moved(np.eye(4), motion), -motion)
    np.testing.assert_allclose(back, np.eye(4), atol=1e-12)


def test_errors_of_poses_are_exact_when_small() -> None:
    pose = around(3)[1].viewmat
    distance, angle = pose_error(off(pose, 0.25, 1e-6, 0), pose)
    assert distance == pytest.approx(0.25, rel=1e-9)
    assert angle == pytest.approx(1e-6, rel=1e-6)
    assert pose_error(off(pose, 0, 175, 1), pose)[1] == pytest.approx(175, rel=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_normal_equations_are_the_twins(seed: int, masked: bool) -> None:
    rng = np.random.default_rng(seed)
    shape = int(rng.integers(5, 14)), int(rng.integers(5, 14))
    K = np.array(
        [[rng.uniform(5, 30), 0, shape[1] / 2], [0, rng.uniform(5, 30), shape[0] / 2], [0, 0, 1]]
    )
    photo = level_of(rng.random(shape), rng.random(shape) < 0.8 if masked else None)
    shot = Shot(rng.random(shape), rng.uniform(0.5, 9, shape), rng.random(shape) < 0.9)
    gain, bias = rng.uniform(0.5, 2), rng.normal(0, 0.1)
    got = normal_equations(photo, shot, K, gain, bias)
    matrix, right, cost, weights = twin.normal_equations(photo, shot, K, gain, bias, got.scale)
    np.testing.assert_allclose(got.matrix, matrix, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got.right, right, rtol=1e-9, atol=1e-9)
    assert got.cost == pytest.approx(cost, rel=1e-9)
    assert got.weights == pytest.approx(weights, rel=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_the_render_for_alignment_equals_the_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = int(rng.integers(1, 9)), int(rng.integers(1, 12))
    image = rng.uniform(-0.2, 1.3, (*shape, 3)).astype(np.float32)
    alpha = rng.uniform(0.3, 1, shape).astype(np.float32)
    depth = (alpha * rng.uniform(2, 2.3, shape)).astype(np.float32)
    got = _core.shot(image, alpha, depth, 0.5, 0.1)
    want = twin.shot(image, alpha, depth, 0.5, 0.1)
    np.testing.assert_allclose(got[0], want[0], atol=1e-12)
    np.testing.assert_allclose(got[1], want[1], rtol=1e-12)
    np.testing.assert_array_equal(got[2], want[2])
    K = np.array([[7.0, 0, 3], [0, 8, 2.5], [0, 0, 1]])
    xi = rng.normal(size=7)
    if want[2].any():
        flow = _core.flow(got, (7.0, 8.0, 3.0, 2.5), xi.tolist())
        assert flow == pytest.approx(twin.flow(want[1], want[2], K, xi), rel=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_local_zncc_is_the_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = int(rng.integers(7, 16)), int(rng.integers(7, 16))
    a, noise = rng.random((2, *shape))
    b = 0.6 * a + rng.uniform(0, 0.5) * noise
    mask = rng.random(shape) < 0.99
    assert local_zncc(a, b, mask, 5) == pytest.approx(twin.local_zncc(a, b, mask, 5), abs=1e-9)


def test_zncc_separates_similar_from_different_images() -> None:
    rng = np.random.default_rng(0)
    a, other = rng.random((2, 40, 50))
    everywhere = np.ones(a.shape, bool)
    assert local_zncc(a, 0.4 * a + 0.2, everywhere, 15) == pytest.approx(1)
    assert abs(local_zncc(a, other, everywhere, 15)) < 0.1
    assert zncc(a, -a, everywhere) == pytest.approx(-1)
    assert local_zncc(a, np.full_like(a, 0.3), everywhere, 15) == 0


def test_predicts_how_renders_change() -> None:
    """−∇R·∂π/∂X·[I | −[X]ₓ] against central differences of renders of the moved camera, over the whole image
    as a correlation and a slope: edges, where depth is two depths, are masked. Turning the camera changes the
    order of splats by depth, at which renders jump: such differences need longer steps, and stay noisier."""
    camera = around(5, (160, 120), 2.2)[1]
    renderer = Renderer(BALL.with_sh_degree(0))
    shot = shot_of(renderer.render(camera), CONFIG)
    down, right = np.gradient(shot.grey)
    predicted = -twin.image_rows(shot.depth, camera.K, (right, down))
    inner = shot.mask.copy()
    for shift in (-3, 3):
        for axis in (0, 1):
            inner &= np.roll(shot.mask, shift, axis)
    for axis, step in enumerate([0.006] * 6):
        ahead, behind = (
            shot_of(
                renderer.render(replace(camera, viewmat=moved(camera.viewmat, xi))), CONFIG
            ).grey
            for xi in (step * np.eye(6)[axis], -step * np.eye(6)[axis])
        )
        measured = ((ahead - behind) / (2 * step))[inner]
        expected = predicted[axis][inner]
        slope = (measured @ expected) / (expected @ expected)
        assert slope == pytest.approx(1, abs=0.06), axis
        assert np.corrcoef(measured, expected)[0, 1] > 0.94, axis


@pytest.mark.parametrize("view", [0, 3])
def test_known_errors_are_taken_back(view: int) -> None:
    """.15 units (a tenth of the distance to the surface) and 4° off, under other light."""
    camera = around(5, (160, 120), 2.5)[view]
    renderer = Renderer(BALL)
    photo = np.clip(0.7 * renderer.image(camera) + 0.1, 0, 1)
    found = align(
        renderer, off(camera.viewmat, 0.15, 4, view), pyramid_of(camera, photo, CONFIG), CONFIG
    )
    distance, angle = pose_error(found.viewmat, camera.viewmat)
    assert distance < 1e-3
    assert angle < 0.03
    assert found.gain == pytest.approx(0.7, abs=0.01)
    assert found.bias == pytest.approx(0.1, abs=0.01)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0


def test_masked_pixels_do_not_count() -> None:
    """A mask over a painted block: without it the block pulls, with it the pose is as good as before."""
    camera = around(5, (160, 120), 2.5)[2]
    renderer = Renderer(BALL)
    photo = np.clip(renderer.image(camera), 0, 1)
    photo[40:80, 60:100] = 1.0
    mask = np.ones(photo.shape[:2], bool)
    mask[38:82, 58:102] = False
    fine = [(camera, level_of(grey_of(photo), mask))]
    found = align(renderer, off(camera.viewmat, 0.01, 0.3, 0), fine, CONFIG)
    assert pose_error(found.viewmat, camera.viewmat)[1] < 0.01


def test_out_of_sight_there_is_nothing_to_align() -> None:
    camera = around(5, (160, 120), 2.5)[0]
    photo = np.random.default_rng(0).random((120, 160, 3)).astype(np.float32)
    pyramid = pyramid_of(camera, photo, CONFIG)
    away = camera.viewmat.copy()
    away[:3, 3] = [0, 0, -20]
    assert align(Renderer(BALL), away, pyramid, CONFIG) is None


@pytest.mark.parametrize("shape", [(1, 9), (6, 1), (5, 8), (9, 6)])
def test_a_shift_is_that_of_the_best_correlation_without_wrapping(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    for _ in range(8):
        a, b = rng.normal(size=(2, *shape))
        found = {}
        for down in range(-(shape[0] // 2), shape[0] // 2 + 1):
            for right in range(-(shape[1] // 2), shape[1] // 2 + 1):
                there = [
                    slice(max(0, s), n + min(0, s))
                    for s, n in zip((down, right), shape, strict=True)
                ]
                here = [
                    slice(max(0, -s), n + min(0, -s))
                    for s, n in zip((down, right), shape, strict=True)
                ]
                found[right, down] = (a[*here] * b[*there]).sum() / np.sqrt(
                    (a * a).sum() * (b * b).sum()
                )
        best = max(found, key=lambda shift: found[shift])
        right, down, score = shift_between(a, b)
        assert (right, down) == best
        assert score == pytest.approx(found[best], abs=1e-6)


def _informed(rng: np.random.Generator) -> np.ndarray:
    """Return the information of a pose and a focal length from ten measurements."""
    rows = rng.normal(size=(10, 7))
    return rows.T @ rows


@pytest.mark.parametrize("seed", range(3))
def test_features_and_light_are_joined_like_their_measurements(seed: int) -> None:
    """Both have the prior of the focal length, which counts once: one least squares of all."""
    rng = np.random.default_rng(seed)
    of_features, of_light, focal_sigma = _informed(rng), _informed(rng), 0.5
    prior = np.zeros((7, 7))
    # of the logarithm of the focal length over the given one, about 0
    prior[6, 6] = focal_sigma**-2
    solved_at = np.array([0, 0, 0, 0, 0, 0, 0.2])
    near_at = rng.normal(0, 0.1, 7) * [1, 1, 1, 0, 0, 0, 1]  # motions without rotation add up
    # Each estimate is (Λ + Λ₀)⁻¹ Λ m of its measurements m.
    measured = (of_features + prior) @ solved_at + (of_light + prior) @ near_at
    of_all = of_features + of_light + prior
    expected = np.linalg.solve(of_all, measured)
    pose = np.eye(4)

    def aligned(at: np.ndarray, covariance: np.ndarray | None) -> Aligned:
        return Aligned(moved(pose, at[:6]), 1.0, 0.0, covariance, 1.0, 3, 2.0, float(np.exp(at[6])))

    solved = SimpleNamespace(
        viewmat=pose,
        information=of_features,
        focal_sigma=focal_sigma,
        depth=2.0,
        zoom=float(np.exp(0.2)),
    )
    found = {}
    for refine in ("auto", "none", "photometric"):
        search = SimpleNamespace(
            config=RegisterConfig(refine=refine),
            _aligned=lambda *_: aligned(near_at, np.linalg.inv(of_light + prior)),
            _likeness=lambda *_: 1.0,
        )
        photo = SimpleNamespace(pyramid=[])
        found[refine] = Search._refined(search, None, solved, photo).found  # type: ignore[arg-type]
    joined = np.array([*motion_between(pose, found["auto"].viewmat), np.log(found["auto"].zoom)])
    np.testing.assert_allclose(joined, expected, atol=1e-9)
    np.testing.assert_allclose(found["auto"].covariance, np.linalg.inv(of_all), atol=1e-9)
    np.testing.assert_allclose(
        found["none"].covariance, np.linalg.inv(of_features + prior), atol=1e-9
    )
    np.testing.assert_allclose(
        found["photometric"].covariance, np.linalg.inv(of_light + prior), atol=1e-9
    )
