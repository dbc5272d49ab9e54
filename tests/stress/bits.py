"""The same bits for 1, 2 and 8 threads: renders, gradients and whole recovery steps."""

import numpy as np

import g2ard._core as _core
from g2ard.rendering.renderer import view_of
from g2ard.stages.recover.config import Rates
from g2ard.stages.recover.engine import Photometric
from helpers.threads import on_threads
from stress.scenes import NAMES, Problem, random_problem

__all__ = ["differing", "large_problem"]


def large_problem(seed: int, count: int = 12_000) -> Problem:
    """A problem's camera and conventions over enough Gaussians and tiles for every thread to have work."""
    small, rng = random_problem(seed), np.random.default_rng((seed, 2))
    rest = small.params["shN"].shape[1]
    params = {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(-3.5, 0.8, (count, 3)),
        "logit_opacities": rng.normal(0, 2, count),
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": rng.normal(0, 0.3, (count, rest, 3)),
    }
    cameras = small.cameras.take([0])
    cameras.Ks[:, :2] *= 6
    cameras.widths[:] *= 6
    cameras.heights[:] *= 6
    weights = np.zeros((int(cameras.heights[0]), int(cameras.widths[0]), 5))
    params = {k: v.astype(np.float32) for k, v in params.items()}
    return Problem(params, cameras, small.settings, small.background, weights)


def differing(problem: Problem) -> list[str]:
    """Return the arrays that differ between thread counts; empty if none does."""
    found = on_threads(lambda: _everything(problem))
    return [name for name in found[0] if any(other[name] != found[0][name] for other in found[1:])]


def _everything(problem: Problem) -> dict[str, bytes]:
    arrays = tuple(problem.params[name] for name in NAMES)
    width, height = problem.size
    view, settings = view_of(problem.cameras, 0, problem.settings), problem.settings
    background = [float(c) for c in problem.background]
    rng = np.random.default_rng(0)
    target = rng.random((height, width, 3)).astype(np.float32)
    gradient = rng.normal(size=(height, width, 5)).astype(np.float32)
    rasterizer = _core.Rasterizer()
    image, alpha, depth, _ = rasterizer.forward(arrays, view, settings, background)
    assert depth is not None
    planes = [np.ascontiguousarray(gradient[..., part]) for part in (slice(0, 3), 3, 4)]
    found = {"image": image, "alpha": alpha, "depth": depth}
    found |= dict(zip(NAMES, rasterizer.backward(arrays, *planes), strict=True))
    r, g, b = background
    trainer = _core.Trainer(arrays, Photometric(settings, (r, g, b), 0.2))
    for _ in range(2):
        trainer.step(view, target, Rates(*[1e-2] * 6))
    found |= {f"trained {name}": array for name, array in trainer.state().items()}
    return {name: array.tobytes() for name, array in found.items()}
