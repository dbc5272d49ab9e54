"""The gradient with respect to a camera's pose: against autograd of a float64 twin."""

import numpy as np
import pytest
import torch

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.rendering.renderer import arrays_of, view_of
from helpers.raster_cases import VARIANTS, camera, oracle, scene, splats_of
from helpers.scenes import checkered_ball

BACKGROUND = [0.2, 0.5, 0.9]


def generators() -> torch.Tensor:
    """(6, 4, 4) of exp's derivatives at 0: three translations, three rotations."""
    out = torch.zeros(6, 4, 4, dtype=torch.float64)
    for k in range(3):
        out[k, k, 3] = 1
        i, j = (k + 1) % 3, (k + 2) % 3
        out[3 + k, j, i], out[3 + k, i, j] = 1, -1
    return out


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("seed", "size", "degree"), [(0, 0.05, 3), (1, 0.3, 2), (2, 0.02, 0)])
def test_gradient_is_the_twins(variant: str, seed: int, size: float, degree: int) -> None:
    settings = VARIANTS[variant]
    cameras = camera(48, 40, off=0.1, seed=seed)
    p = scene(seed, 120, degree=degree, size=size)
    pose = torch.from_numpy(cameras.viewmats[0]).requires_grad_()
    out, _ = oracle(p, cameras, settings, tuple(BACKGROUND), pose=pose)
    weight = torch.from_numpy(np.random.default_rng(seed).normal(size=(40, 48, 3)))
    weight[out.doubtful] = 0
    (out.image * weight).sum().backward()
    want = torch.einsum("ij,kij->k", pose.grad, generators() @ pose.detach()).numpy()
    rasterizer = _core.Rasterizer()
    arrays = arrays_of(splats_of(p))
    rasterizer.forward(arrays, view_of(cameras, 0, settings), settings, BACKGROUND, 0)
    got = np.array(rasterizer.pose_gradient(arrays, weight.numpy().astype(np.float32)))
    np.testing.assert_allclose(got, want, atol=1e-3 * np.abs(want).max())


def test_a_pose_gradient_needs_a_forward_pass() -> None:
    arrays = arrays_of(checkered_ball(50))
    with pytest.raises(InputError, match="pose gradient: expected a forward pass before it"):
        _core.Rasterizer().pose_gradient(arrays, np.zeros((4, 4, 3), np.float32))
