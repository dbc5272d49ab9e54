"""The fused loss and the metrics against a naive float64 twin."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import g2ard._core as _core
from g2ard.config.choices import BLACK
from g2ard.errors import InputError
from g2ard.rendering.metrics import detail, edge_psnr, lost_detail, psnr, ssim
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.stages.recover.losses import l1_ssim
from g2ard.stages.recover.probe import Probe
from helpers.scenes import around, checkered_ball
from reference import ssim as reference

Image = NDArray[np.float32]
SHAPES = [(48, 64, 3), (1, 1, 3), (5, 7, 3), (33, 100, 1), (215, 190, 1), (12, 11, 4)]
"""The largest has several tiles both ways."""
KINDS = ("noise", "close", "flat", "dark", "equal but for two pixels")


def images(shape: tuple[int, int, int], kind: str) -> tuple[Image, Image]:
    rng = np.random.default_rng(sum(shape))
    y, x = np.mgrid[: shape[0], : shape[1]] / 20
    smooth = (0.5 + 0.4 * np.sin(x + 2 * y))[..., None] * np.ones(shape[2])
    two = np.zeros(shape)
    two[shape[0] // 2, shape[1] // 2], two[-1, 0] = 1, -1
    a, b = {
        "noise": (rng.random(shape), rng.random(shape)),
        "close": (smooth, smooth + rng.normal(size=shape) * 0.01),
        "equal but for two pixels": (smooth, smooth + 0.3 * two),
        "flat": (np.full(shape, 0.3), np.full(shape, 0.6)),
        "dark": (np.zeros(shape), rng.random(shape) * 0.01),
    }[kind]
    return a.astype(np.float32), b.astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_loss_and_gradient_are_the_twin_s(shape: tuple[int, int, int], kind: str) -> None:
    a, b = images(shape, kind)
    for weight in (0.0, 0.2, 1.0):
        x = torch.from_numpy(a).requires_grad_()
        loss = l1_ssim(x, torch.from_numpy(b), weight)
        (3 * loss).backward()
        x64 = torch.from_numpy(a.astype(np.float64)).requires_grad_()
        want = reference.l1_ssim(x64, torch.from_numpy(b.astype(np.float64)), weight)
        (3 * want).backward()
        assert abs(loss.item() - want.item()) < 1e-5
        error = float((x.grad - x64.grad).norm() / x64.grad.norm().clamp(min=1e-9))
        assert error < 3e-4


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_metrics_are_the_twin_s(shape: tuple[int, int, int], kind: str) -> None:
    a, b = images(shape, kind)
    a64, b64 = a.astype(np.float64), b.astype(np.float64)
    want = float(reference.ssim(torch.from_numpy(a64), torch.from_numpy(b64)))
    assert abs(_core.ssim(a, b) - want) < 1e-5
    assert abs(_core.psnr(a, b) - -10 * np.log10(np.mean((a64 - b64) ** 2))) < 1e-9
    assert abs(_core.ssim(a, a) - 1) < 1e-12
    assert _core.psnr(a, a) == np.inf


def masked(shape: tuple[int, ...], kind: str) -> NDArray[np.bool_]:
    """A mask of an image's (height, width)."""
    rng = np.random.default_rng(sum(shape))
    mask = np.zeros(shape[:2], bool)
    height, width = shape[:2]
    if kind == "one pixel":
        mask[height // 2, width // 3] = True
    elif kind == "corner":
        mask[-2:, :1] = True
    elif kind == "block":
        mask[height // 4 : -(height // 5) or None, width // 3 :] = True
    elif kind == "all but a block":
        mask[:] = True
        mask[height // 3 : height // 2, : width // 2] = False
    else:
        mask[:] = rng.random(mask.shape) < {"few": 0.02, "most": 0.95, "all": 2}[kind]
        mask[0, -1] = True
    return mask


MASKS = ("one pixel", "corner", "block", "all but a block", "few", "most", "all")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mask_kind", MASKS)
@pytest.mark.parametrize("shape", [(5, 7, 3), (33, 100, 1), (130, 95, 1)])
def test_masked_loss_gradient_and_metric_are_the_twin_s(
    shape: tuple[int, int, int], mask_kind: str, kind: str
) -> None:
    a, b = images(shape, kind)
    mask = masked(shape, mask_kind)
    counts = torch.from_numpy(mask)
    a64, b64 = (torch.from_numpy(image.astype(np.float64)) for image in (a, b))
    few = mask.sum() < 100  # float32's rounding of variances does not average out
    want = float(reference.ssim(a64, b64, counts))
    assert ssim(a, b, mask) == pytest.approx(want, abs=3e-4 if few else 1e-5)
    x = torch.from_numpy(a).requires_grad_()
    loss = l1_ssim(x, torch.from_numpy(b), 0.7, counts)
    loss.backward()
    x64 = a64.clone().requires_grad_()
    twin = reference.l1_ssim(x64, b64, 0.7, counts)
    twin.backward()
    assert loss.item() == pytest.approx(twin.item(), abs=3e-4 if few else 1e-5)
    assert not x.grad[~counts].any()
    error = float((x.grad - x64.grad).norm() / x64.grad.norm().clamp(min=1e-9))
    assert error < (5e-3 if few else 3e-4)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(st.integers(1, 30), st.integers(1, 30), st.sampled_from([1, 3])),
    st.integers(0, 2**32 - 1),
    st.floats(0, 1),
    st.sampled_from(["noise", "inverse", "steps"]),
)
def test_masked_ssim_is_between_minus_one_and_one_and_sees_the_mask_alone(
    shape: tuple[int, int, int], seed: int, share: float, kind: str
) -> None:
    rng = np.random.default_rng(seed)
    a = rng.random(shape).astype(np.float32)
    b = rng.random(shape).astype(np.float32)
    if kind != "noise":
        a = (a > rng.random()).astype(np.float32) if kind == "steps" else a
        b = 1 - a
    mask = rng.random(shape[:2]) < share
    found = ssim(a, b, mask)
    assert -1 <= found <= 1
    assert ssim(a, a, mask) == 1
    loss, gradient = _core.l1_ssim(a, b, 1.0, mask)
    assert loss == pytest.approx(1 - found, abs=1e-12)
    assert 0 <= _core.l1_ssim(a, b, 0.2, mask)[0] <= 1.8
    for spoilt in (np.nan, 1e30, 0.5):
        other_a, other_b = (
            np.where(mask[..., None], image, np.float32(spoilt)) for image in (a, b)
        )
        assert ssim(other_a, b, mask) == ssim(a, other_b, mask) == found
        again, other_gradient = _core.l1_ssim(other_a, other_b, 1.0, mask)
        assert again == loss
        np.testing.assert_array_equal(other_gradient, gradient)


def test_gradients_are_the_twin_s() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 9, 7, 3)).astype(np.float32)
    b = (0.7 * a + 0.3 * b).astype(np.float32)
    mask = rng.random((9, 7)) < 0.7
    for chosen in (None, mask):
        pairs = []
        for y, x in np.ndindex(9, 7):
            for down, right in ((1, 0), (0, 1)):
                there = y + down, x + right
                inside = there[0] < 9 and there[1] < 7
                if inside and (chosen is None or (chosen[y, x] and chosen[there])):
                    pairs.append([image[there].astype(float) - image[y, x] for image in (a, b)])
        own, wanted = np.array(pairs).swapaxes(0, 1)
        want = -10 * np.log10(np.mean((own - wanted) ** 2))
        assert edge_psnr(a, b, chosen) == pytest.approx(want, abs=1e-4)
        want = (own * wanted).sum() / np.sqrt((own**2).sum() * (wanted**2).sum())
        assert detail(a, b, chosen) == pytest.approx(want, abs=1e-6)


def test_detail_counts_lines_whatever_their_area() -> None:
    target = np.full((64, 64, 3), 0.5, np.float32)
    target[:, 20] = 0.6  # a wire
    flat, brighter, moved = np.full_like(target, 0.5), target + 0.2, np.roll(target, 3, 1)
    noise = np.random.default_rng(0).normal(0, 0.05, target.shape).astype(np.float32)
    assert psnr(flat, target) > 35 > psnr(brighter, target)
    assert detail(brighter, target) == pytest.approx(1, abs=1e-4)
    for lost in (flat, moved, flat + noise):
        assert abs(detail(lost, target)) < 0.1
    assert detail(1 - target, target) == pytest.approx(-1, abs=1e-2)
    assert 0.3 < detail(target + 0.4 * noise, target) < 0.5  # a sixth of the energy is the wire's
    assert detail(flat, flat + np.float32(0.1)) == detail(target[:1, :1], noise[:1, :1]) == 1
    mask = np.zeros(target.shape[:2], bool)
    assert detail(target, noise, mask) == 1
    mask[:, :10] = True
    assert detail(flat, target, mask) == 1  # the wire is outside


def test_edges_see_a_blurred_line_before_a_wrong_colour() -> None:
    target = np.full((64, 64, 3), 0.5, np.float32)
    target[:, 20:22] = 0.9
    wrong, blurred = target + 0.1, target.copy()
    blurred[:, 18:24] = target[:, 18:24].mean(1, keepdims=True)
    assert psnr(wrong, target) < psnr(blurred, target) < 30
    assert edge_psnr(wrong, target) > 60
    assert edge_psnr(blurred, target) < 30
    assert edge_psnr(target, target) == edge_psnr(target[:1, :1], wrong[:1, :1]) == 100


def test_nan_is_no_perfect_score() -> None:
    views = around(2, (16, 12))
    ball = checkered_ball(50)
    image = Renderer(ball).clipped(views[0])
    spoilt = image.copy()
    spoilt[3, 4] = np.nan
    everywhere = np.ones(image.shape[:2], bool)
    for mask in (None, everywhere):
        assert np.isnan(
            [score(image, spoilt, mask) for score in (psnr, ssim, edge_psnr, detail)]
        ).all()
    targets = Spoilt(views)
    assert np.isnan(Probe(targets, BLACK).score(ball))
    assert np.isnan(Probe(targets, BLACK, 40.0).score(ball))


class Spoilt:
    """Targets of which one pixel is NaN."""

    def __init__(self, cameras: Cameras) -> None:
        self.cameras = cameras

    def __getitem__(self, view: int) -> NDArray[np.float32]:
        target = np.zeros((12, 16, 3), np.float32)
        target[0, view] = np.nan
        return target


def test_shapes_must_fit() -> None:
    a = np.zeros((4, 5, 3), np.float32)
    with pytest.raises(InputError, match="target: expected the image's shape"):
        _core.ssim(a, a[:3])
    with pytest.raises(InputError, match="target: expected the image's shape"):
        edge_psnr(a, a[:3])
    with pytest.raises(InputError, match="target: expected the image's shape"):
        detail(a, a[:3])
    with pytest.raises(InputError, match="image"):
        _core.psnr(a[:0], a[:0])
    with pytest.raises(InputError, match=r"target: expected \(H, W, C\) float32"):
        l1_ssim(torch.zeros(4, 5, 3), torch.zeros(4, 5, 3, dtype=torch.float64))


def test_detail_counts_as_lost_where_people_see_it() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((96, 96, 3), 0.5)
    grain = np.where((np.indices((96, 96)).sum(0) // 2) % 2, 1.0, -1.0)[..., None]
    textured, faint = flat + 0.05 * grain, flat + 0.001 * grain
    noisy = textured + rng.normal(0, 0.05, textured.shape)
    hole, mask = textured.copy(), np.ones((96, 96), bool)
    hole[32:64, 32:64] = 0.5
    mask[30:66, 30:66] = False
    assert lost_detail(flat, textured) > 2
    assert lost_detail(hole, textured) > 2  # one region of nine
    assert lost_detail(hole, textured, mask) == 0
    assert lost_detail(flat, faint) == 0  # nobody sees it
    assert lost_detail(textured + 0.02, textured) < 0.3  # brighter
    assert lost_detail(noisy, textured) < 0.3
    assert (
        0
        < lost_detail(flat + 0.04 * grain, textured)
        < 1
        < lost_detail(flat + 0.01 * grain, textured)
    )
