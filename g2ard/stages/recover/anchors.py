"""Construction-time anchors, weights of the two regularisers, and drift from the anchors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from g2ard.config.checks import AtLeastOne, NotNegative, Positive, Within
from g2ard.config.schema import Settings
from g2ard.errors import require
from g2ard.scene.splats import Splats
from g2ard.scene.transform import rotation_matrices


@dataclass(frozen=True)
class Regularizers(Settings):
    """The paper's `eq:objective`: λ_a·L_anchor + λ_s·L_shape, added every `period` steps.

    Args:
        anchor: λ_a.
        shape: λ_s.
        effective_rank: whether L_shape includes its barrier against needles.
        thickness: β, weight in L_shape of exceeding the anchor's thickness.
        rank_offset: ε of log(r_eff − 1 + ε).
        period: steps between two additions.
        in_plane: r∥ of the trust region, over the mean tangential scale; r⊥ is the smallest scale. The paper
            only says r∥ ≫ r⊥.

    Raises:
        InputError: a value out of range.
    """

    anchor: NotNegative
    shape: NotNegative
    effective_rank: bool
    thickness: NotNegative = 1.0
    rank_offset: Annotated[float, Within("(0, 1)")] = 1e-6
    period: AtLeastOne = 100
    in_plane: Positive = 3.0

    @classmethod
    def of(cls, prior: str, *, paper: bool = False) -> Regularizers:
        """Return the weights for a kind of dense scene.

        Args:
            prior: trained, lift (from a point cloud, untrained), or noisy (trained, with needles).
            paper: return the row of `tab:s_recovery`, for the paper's rates and steps.

        Raises:
            InputError: an unknown kind.

        >>> Regularizers.of("lift").anchor, Regularizers.of("lift", paper=True).anchor
        (0.1, 0.001)
        """
        rows = PAPER_REGULARIZERS if paper else REGULARIZERS
        require("prior", repr(prior), prior in rows, f"one of {', '.join(rows)}")
        return rows[prior]

    @classmethod
    def named(cls, name: str) -> Regularizers:
        """Return the weights of a kind of dense scene, or the paper's with the prefix `paper-`.

        `auto` and `paper`, which are chosen by measuring the scene, give a trained scene's here.

        >>> Regularizers.named("lift").anchor, Regularizers.named("paper-lift").anchor
        (0.1, 0.001)
        """
        kind = name.removeprefix("paper-")
        return cls.of("trained" if kind in ("auto", "paper") else kind, paper=name.startswith("paper"))

    @property
    def active(self) -> bool:
        """Return whether any term has weight."""
        return self.anchor > 0 or self.shape > 0


PAPER_REGULARIZERS = {
    "trained": Regularizers(anchor=5e-2, shape=0.0, effective_rank=False),
    "lift": Regularizers(anchor=1e-3, shape=1e-4, effective_rank=True),
    "noisy": Regularizers(anchor=5e-2, shape=1e-3, effective_rank=True),
}
"""Rows of `tab:s_recovery` (faithful trained prior, lift, less regularised trained prior) for the paper's
schedule."""

REGULARIZERS = {
    "trained": PAPER_REGULARIZERS["trained"],
    "lift": Regularizers(anchor=1e-1, shape=1.0, effective_rank=True),
    "noisy": Regularizers(anchor=5e-2, shape=1.0, effective_rank=True),
}
"""Weights for g2ard's schedule of a thousand steps, only ten of them regularised, so that larger weights are
needed (decision 0019)."""

FREE = Regularizers(anchor=0.0, shape=0.0, effective_rank=False)
"""No regularisers, for points found in photos: their places are guesses. On held-out photos this gains 1.7 dB
for an object with a visual hull, and 0.3 dB for a room with sparse points."""


@dataclass(frozen=True, eq=False)
class Anchors:
    """Frozen construction-time geometry of N Gaussians.

    Args:
        means: (N, 3) float32.
        frames: (N, 3, 3) float32, columns t1, t2, n: the normal is the axis of the smallest scale.
        r_parallel: (N,) float32 in-plane radius, 3 × the mean tangential scale, or `in_plane` × it.
        r_perp: (N,) float32 normal radius, the smallest scale.
    """

    means: NDArray[np.float32]
    frames: NDArray[np.float32]
    r_parallel: NDArray[np.float32]
    r_perp: NDArray[np.float32]

    @classmethod
    def of(cls, splats: Splats, in_plane: float = 3.0) -> Anchors:
        """Freeze the geometry of a scene whose means are float32, see `Splats.narrowed`.

        Args:
            splats: the scene, with the offset of the scene that the anchors are for.
            in_plane: as in `Regularizers`.
        """
        order = np.argsort(-splats.scales, axis=1, kind="stable")
        frames = np.take_along_axis(rotation_matrices(splats.quats), order[:, None, :], axis=2)
        scales = np.take_along_axis(splats.scales, order, axis=1).astype(np.float64)
        tangential = scales[:, :2].mean(1)
        floor = np.maximum(1e-6 * scales[:, 0], np.finfo(np.float32).tiny)
        return cls(
            means=splats.means.astype(np.float32),
            frames=frames.astype(np.float32),
            r_parallel=(in_plane * np.maximum(tangential, floor)).astype(np.float32),
            r_perp=np.maximum(scales[:, 2], floor).astype(np.float32),
        )


def drift95(anchors: Anchors, means: NDArray[np.float32]) -> float:
    """Return the 95th percentile of |δ̃₃| / r⊥, δ̃ = R̄ᵀ(μ − μ̄): distances from the surface in thicknesses."""
    if not len(means):
        return 0.0
    delta = means.astype(np.float64) - anchors.means
    local = np.einsum("nji,nj->ni", anchors.frames.astype(np.float64), delta)
    return float(np.percentile(np.abs(local[:, 2]) / anchors.r_perp, 95))
