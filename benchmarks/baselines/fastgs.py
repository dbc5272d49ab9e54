"""FastGS's pruning by scores over several views (Ren et al., arXiv 2511.04283).

Implemented: the score Σ_j E_j·(pixels of high error in the Gaussian's footprint in view j) over 10 random
views, with the photometric loss E_j of a view. Each of ten rounds first removes Gaussians with a normalised
score above 0.9, then the faintest, as a threshold on opacity would. Each keeps the same share, so that the
last leaves the exact count. Rounds, their shares and both thresholds are choices of this module.

Not included: training from sparse points, densification by the same counts, and the compact boxes of its
rasteriser.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines.thinning import Training
from g2ard.rendering.renderer import RasterSettings

__all__ = ["FastGS"]

_PRUNED = 2 / 3
"""Share of the steps before the last round."""
_ROUNDS, _VIEWS = 10, 10
_HIGH, _BAD = 0.1, 0.9
"""Error, as a share of its range in a view, of pixels that count, and score of Gaussians to remove."""
_FOOTPRINT = RasterSettings(antialiased=False, near=0.01, alpha_max=1 / 255)
"""Every Gaussian adds 1/255 to each pixel of its footprint, and hides almost nothing."""


class FastGS:
    """Strategy that removes Gaussians in rounds."""

    def __init__(self, count: int, steps: int) -> None:
        self._count, self._every = count, max(1, round(_PRUNED * steps / _ROUNDS))

    def penalty(self, training: Training) -> Tensor | float:
        """Return 0: the method adds nothing to the loss."""
        return 0.0

    def after(self, training: Training, step: int) -> None:
        """Prune at intervals."""
        last = _ROUNDS * self._every
        if step % self._every or step > last:
            return
        opacities = training.values["logit_opacities"].detach()
        left = (last - step) // self._every
        now = len(opacities)
        kept = round(now * (self._count / now) ** (1 / (left + 1)))
        bad = scores(training, step) > _BAD
        training.keep((opacities - 1e6 * bad).topk(kept).indices.sort().values)


def scores(training: Training, seed: int) -> Tensor:
    """Return (N,) scores from 0 to 1."""
    some = np.random.default_rng(seed).permutation(len(training.views))[:_VIEWS]
    total = torch.zeros_like(training.values["logit_opacities"])
    for view in some:
        with torch.no_grad():
            image = training.rendered(view)
            loss = training.loss(view, image)
        target, mask = training.views[view]
        error = (image - target).abs().mean(2)
        if mask is not None:
            error = error * mask[..., 0]
        high = (error - error.min()) / (error.max() - error.min() + 1e-12) > _HIGH
        total += loss * footprint(training, view, high)
    return (total - total.min()) / (total.max() - total.min() + 1e-12)


def footprint(training: Training, view: int, pixels: Tensor) -> Tensor:
    """Return (N,) how many of some pixels (H, W) each Gaussian touches, hidden or not, times a constant."""
    grey = torch.ones_like(training.values["sh0"], requires_grad=True)
    others = {name: value.detach() for name, value in training.values.items()}
    image = training.rendered(
        view, _FOOTPRINT, **{**others, "sh0": grey, "shN": others["shN"][:, :0]}
    )
    (counts,) = torch.autograd.grad((image[..., 0] * pixels).sum(), grey)
    return counts[:, 0, 0]
