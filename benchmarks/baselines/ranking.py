"""Selection of the highest scores, shared by pruning baselines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.scene.splats import Splats

__all__ = ["check_budget", "keep_best"]


def check_budget(splats: Splats, budget: int) -> None:
    """Raise an `InputError` unless the budget is between 1 and the count."""
    if not 1 <= budget <= len(splats):
        raise InputError(f"budget: expected 1 to {len(splats)}, got {budget}")


def keep_best(splats: Splats, scores: NDArray[Any], budget: int) -> Splats:
    """Keep the `budget` rows of highest score in order; lower indices win ties, NaN is lowest.

    >>> keep_best(Splats.create(np.eye(3), scales=np.ones((3, 3))), np.array([1, 3, 3]), 1).means.tolist()
    [[0.0, 1.0, 0.0]]
    """
    check_budget(splats, budget)
    ranked = np.argsort(-np.where(np.isnan(scores), -np.inf, scores), kind="stable")
    return splats.take(np.sort(ranked[:budget]))
