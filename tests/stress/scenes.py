"""Random small scenes, cameras and conventions: each seed is one problem for the gradient check."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from g2ard.rendering.renderer import RasterSettings
from g2ard.scene.cameras import Cameras, look_at
from g2ard.stages.recover.rasterize import rasterize
from helpers.raster_cases import NAMES, Params, oracle
from reference.raster import Oracle

__all__ = ["NAMES", "Params", "Problem", "random_problem", "weighted"]


@dataclass(frozen=True)
class Problem:
    """A scene, a view of it, and a linear functional of image, alpha and depth.

    Args:
        params: the six float32 arrays.
        cameras: one view.
        settings: conventions.
        background: behind the scene.
        weights: (H, W, 5) float64; zero where rounding may decide what a pixel shows.
    """

    params: Params
    cameras: Cameras
    settings: RasterSettings
    background: tuple[float, float, float]
    weights: NDArray[np.float64]

    @property
    def size(self) -> tuple[int, int]:
        return int(self.cameras.widths[0]), int(self.cameras.heights[0])

    def oracle(self, params: Params, *, grad: bool = False) -> tuple[Oracle, list[torch.Tensor]]:
        # A clip is continuous: on its wrong side only the slope is another, hence the narrow margin.
        return oracle(
            params, self.cameras, self.settings, self.background, grad=grad, clip_margin=2e-6
        )

    def loss(self, image: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
        w = torch.from_numpy(self.weights).to(image.dtype)
        return (image * w[..., :3]).sum() + (alpha * w[..., 3]).sum() + (depth * w[..., 4]).sum()

    def engine(self) -> tuple[tuple[torch.Tensor, ...], dict[str, NDArray[np.float32]]]:
        """The float32 rasteriser's image, alpha and depth, and its gradients."""
        mine = [torch.from_numpy(self.params[k].copy()).requires_grad_() for k in NAMES]
        outputs = rasterize(
            *mine, self.cameras, 0, background=self.background, settings=self.settings
        )
        self.loss(*outputs).backward()
        found = {k: t.grad.numpy() for k, t in zip(NAMES, mine, strict=True) if t.grad is not None}
        return tuple(t.detach() for t in outputs), found


def random_problem(seed: int) -> Problem:
    """SH degree 0–3, either convention, antialiased or not, near planes that cut, odd sizes, backgrounds."""
    rng = np.random.default_rng(seed)
    n, degree = int(rng.integers(1, 25)), int(rng.integers(0, 4))
    settings = RasterSettings(
        convention="inria" if rng.random() < 0.4 else "gsplat",
        antialiased=bool(rng.random() < 0.4),
        alpha_max=float(rng.choice([0.99, 0.999])),
        near=None if rng.random() < 0.7 else float(rng.uniform(0.05, 4)),
    )
    size = np.exp(rng.uniform(np.log(0.01), np.log(1.5)))
    params = {
        "means": rng.normal(size=(n, 3)) * rng.choice([0.3, 1.0]),
        "quats": rng.normal(size=(n, 4)) * np.exp(rng.normal(size=(n, 1))),
        "log_scales": np.log(size) + rng.normal(size=(n, 3)) * 0.8,
        "logit_opacities": rng.normal(size=n) * 2 + rng.choice([0.0, 3.0]),
        "sh0": rng.normal(size=(n, 1, 3)),
        "shN": rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)) * 0.3,
    }
    problem = Problem(
        {k: v.astype(np.float32) for k, v in params.items()},
        _camera(rng),
        settings,
        tuple(rng.random(3)) if rng.random() < 0.7 else (0.0, 0.0, 0.0),
        np.zeros(0),
    )
    return weighted(problem, rng)


def weighted(problem: Problem, rng: np.random.Generator) -> Problem:
    """The problem with random weights wherever its pixels are certain."""
    width, height = problem.size
    weights = rng.normal(size=(height, width, 5))
    with torch.no_grad():
        weights[problem.oracle(problem.params)[0].doubtful.numpy()] = 0
    return Problem(problem.params, problem.cameras, problem.settings, problem.background, weights)


def _camera(rng: np.random.Generator) -> Cameras:
    width, height = (int(v) for v in rng.integers(1, 36, 2))
    eye = rng.normal(size=3)
    eye *= rng.uniform(1.5, 6) / np.linalg.norm(eye)
    focal = max(width, height) * rng.uniform(0.6, 2)
    off = rng.normal(size=2) * 0.15
    K = [[focal, 0, (0.5 + off[0]) * width], [0, 1.1 * focal, (0.5 + off[1]) * height], [0, 0, 1]]
    pose = look_at(eye, rng.normal(size=3) * 0.2)
    return Cameras.from_lists([pose], [K], [(width, height)], ["v"])
