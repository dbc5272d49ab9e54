"""Other simplification methods, implemented from their papers at an exact count, without recovery."""

from __future__ import annotations

import numpy as np

from benchmarks.baselines import pruning
from benchmarks.baselines.nanogs import nanogs
from benchmarks.baselines.pup import sensitivity
from g2ard.errors import InputError
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats

__all__ = ["METHODS", "reduce"]

METHODS = ("random", "opacity-area", "lightgaussian", "pup", "mini-splatting", "coreset", "nanogs")


def reduce(
    name: str, splats: Splats, budget: int, cameras: Cameras, *, seed: int = 0, indoor: bool = False
) -> Splats:
    """Reduce a scene to exactly `budget` Gaussians by a baseline of `METHODS`, without recovery.

    Args:
        name: name of the method.
        splats: the scene.
        budget: Gaussians to keep, 1 to N.
        cameras: training views, by which all but nanogs, opacity-area and random score Gaussians.
        seed: seed of random methods (random, Mini-Splatting).
        indoor: whether Mini-Splatting uses its importance for rooms.

    Raises:
        InputError: an unknown method, or a budget out of range.
    """
    if name not in METHODS:
        raise InputError(f"baseline: expected one of {', '.join(METHODS)}, got {name!r}")
    if not 1 <= budget <= len(splats):
        raise InputError(f"budget: expected 1 to {len(splats)}, got {budget}")
    if name == "nanogs":
        return nanogs(splats, budget)
    if name == "random":
        kept = np.random.default_rng(seed).choice(len(splats), budget, replace=False)
        return splats.take(np.sort(kept))
    if name == "mini-splatting":
        weights = pruning.importance(splats, cameras, indoor=indoor)
        return splats.take(pruning.sample(weights, budget, seed=seed))
    if name == "opacity-area":
        scores = pruning.optical_mass(splats)
    elif name == "lightgaussian":
        scores = pruning.global_significance(splats, cameras)
    elif name == "coreset":
        scores = pruning.largest_share(splats, cameras)
    else:  # pup in one round; the release has two (`pup.rounds`)
        scores = sensitivity(splats, cameras)
    return pruning.keep_best(splats, scores, budget)
