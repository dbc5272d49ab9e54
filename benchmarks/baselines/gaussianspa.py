"""GaussianSpa's optimising and sparsifying (Zhang et al., arXiv 2411.06019).

Implemented: the penalty δ/2·‖α − z + λ‖² on opacities and, at regular intervals, the projection z of α + λ to
its largest entries and λ ← λ + α − z. At two thirds of the steps the largest α are kept and trained on.
δ and the 200 projections are those of its release.

Not included: training the dense scene itself, the release's removal of half of it by importance before
sparsifying, its longer training afterwards (14,800 steps after 10,000), and the variant that projects
the importance of Mini-Splatting instead of opacity.
"""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.baselines.thinning import Training

__all__ = ["GaussianSpa"]

_SPARSE = 2 / 3
"""Share of the steps before the scene is cut to its final count."""
_PROJECTIONS = 200
_DELTA = 5e-4


class GaussianSpa:
    """Strategy that presses the opacities of all but `count` Gaussians towards 0."""

    def __init__(self, count: int, steps: int) -> None:
        self._count, self._cut = count, max(1, round(_SPARSE * steps))
        self._every = max(1, self._cut // _PROJECTIONS)
        self._goal = self._dual = torch.zeros(0)  # z − λ, and λ

    def penalty(self, training: Training) -> Tensor | float:
        """Return δ/2·‖α − z + λ‖², 0 after the cut."""
        if len(training.values["means"]) == self._count:
            return 0.0
        if not len(self._goal):
            self._project(training)
        return (
            _DELTA / 2 * (training.values["logit_opacities"].sigmoid() - self._goal).square().sum()
        )

    def after(self, training: Training, step: int) -> None:
        """Project at intervals, and cut the scene once."""
        if step == self._cut:
            opacities = training.values["logit_opacities"].detach()
            training.keep(opacities.topk(self._count).indices.sort().values)
        elif step < self._cut and step % self._every == 0:
            self._project(training)

    def _project(self, training: Training) -> None:
        opacities = training.values["logit_opacities"].detach().sigmoid()
        dual = self._dual if len(self._dual) else torch.zeros_like(opacities)
        z = projected(opacities + dual, self._count)
        self._dual = dual + opacities - z
        self._goal = z - self._dual


def projected(values: Tensor, count: int) -> Tensor:
    """Return the nearest vector with at most `count` entries that are not 0.

    >>> projected(torch.tensor([0.1, 0.7, 0.2]), 2).tolist() == torch.tensor([0, 0.7, 0.2]).tolist()
    True
    """
    kept = values.topk(count).indices
    return torch.zeros_like(values).index_copy(0, kept, values[kept])
