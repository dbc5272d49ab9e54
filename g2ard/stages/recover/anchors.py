"""Construction-time anchors, drift from them, and weights of the two regularisers, chosen by measuring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from g2ard.arrays import Float32
from g2ard.config.checks import AtLeastOne, NotNegative, Positive, Within
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.io.reports import Report
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.scene.cameras import Cameras, within_frame
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.shape import needle_share
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
        return cls.of(
            "trained" if kind in ("auto", "paper") else kind, paper=name.startswith("paper")
        )

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

    means: Float32
    frames: Float32
    r_parallel: Float32
    r_perp: Float32

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


def drift95(anchors: Anchors, means: Float32) -> float:
    """Return the 95th percentile of |δ̃₃| / r⊥, δ̃ = R̄ᵀ(μ − μ̄): distances from the surface in thicknesses."""
    if not len(means):
        return 0.0
    delta = means.astype(np.float64) - anchors.means
    normals = anchors.frames[:, :, 2].astype(np.float64)
    height = np.einsum("nj,nj->n", normals, delta)
    return float(np.percentile(np.abs(height) / anchors.r_perp, 95))


_LIFT_THICKNESS = 0.2
_LIFT_SPREAD = 2.5
"""Limits for a lift, whose discs are all alike: the normal scale is about a tenth of the tangential ones.
Measured median and spread: lifts .12 and 1.2, simplified tenfold .10–.14 and 1.9–2.3; trained scenes .17–.30
and 3.5–7.3, simplified .44–.49 and 2.2–2.7."""

_MANY_NEEDLES = 0.10
_LEAST_CONSISTENCY = 0.95
"""Least view consistency of a faithful scene. Trained scenes have .977–.988; with a tenth of the Gaussians
displaced .81–.97."""

_SAMPLE_VIEWS = 4
_SAMPLE_PIXELS = 160
_SAME_DEPTH = 0.05


@dataclass(frozen=True)
class PriorMeasures(Report):
    """Measures that distinguish a lift, a faithful and a noisy trained scene.

    Args:
        needle: share of Gaussians with an effective rank below 1.1.
        thickness: median of smallest scale over middle scale.
        thickness_spread: upper over lower quartile of the thickness; a lift's discs are all alike.
        view_dependent: whether any colour depends on the view.
        consistency: see `measure_view_consistency`; None without two views to compare.
    """

    needle: float
    thickness: float
    thickness_spread: float
    view_dependent: bool
    consistency: float | None

    @property
    def is_lift(self) -> bool:
        """Return whether the Gaussians are thin discs of equal proportions, their colours without view
        dependence: an untrained lift."""
        return (
            not self.view_dependent
            and self.thickness <= _LIFT_THICKNESS
            and self.thickness_spread <= _LIFT_SPREAD
        )


def measure_prior(prior: Splats, cameras: Cameras | None = None) -> PriorMeasures:
    """Measure a scene, including its view consistency if there are views.

    >>> flat = Splats.create(np.zeros((4, 3)), scales=[[1, 1, 0.1]] * 4)
    >>> found = measure_prior(flat)
    >>> round(found.thickness, 3), round(found.thickness_spread, 3), found.consistency
    (0.1, 1.0, None)
    """
    scales = np.sort(prior.scales.astype(np.float64), axis=1)
    tiny = np.finfo(np.float32).tiny
    thickness = scales[:, 0] / np.maximum(scales[:, 1], tiny)
    if len(prior):
        low, middle, high = np.quantile(thickness, [0.25, 0.5, 0.75])
    else:
        low, middle, high = (1.0, 1.0, 1.0)
    return PriorMeasures(
        needle=needle_share(prior.scales),
        thickness=float(middle),
        thickness_spread=float(high / max(low, tiny)),
        view_dependent=bool(prior.shN.any()),
        consistency=measure_view_consistency(prior, cameras) if cameras is not None else None,
    )


def measure_view_consistency(scene: Splats, cameras: Cameras) -> float | None:
    """Return the share of surface points of a view that its nearest neighbour does not see through.

    The median depth of a few small views is projected into the nearest other view. Points within 5 % of that
    view's depth agree, points in front of it float, and points behind it are hidden and ignored. The
    result is agreeing over agreeing and floating points, in [0, 1]; None if no point is in two views.
    """
    if len(cameras) < 2 or not len(scene):
        return None
    small = cameras.resized(_SAMPLE_PIXELS)
    renderer = Renderer(scene, settings=RasterSettings(antialiased=False))
    agreeing = 0
    floating = 0
    for a in evenly_spaced(len(small), _SAMPLE_VIEWS):
        distance = np.linalg.norm(small.positions - small.positions[a], axis=1)
        distance[a] = np.inf
        b = int(distance.argmin())
        depth, other = (renderer.render(small[view], median=True).median for view in (a, b))
        assert depth is not None
        assert other is not None
        expected, seen = _carry_depths(depth, other, small, a, b)
        ratio = np.where(seen > 0, seen, np.inf) / expected
        agreeing += int((np.abs(ratio - 1) <= _SAME_DEPTH).sum())
        floating += int((ratio > 1 + _SAME_DEPTH).sum())
    if agreeing + floating:
        return agreeing / (agreeing + floating)
    return None


def _carry_depths(
    depth: np.ndarray, other: np.ndarray, cameras: Cameras, a: int, b: int
) -> tuple[np.ndarray, np.ndarray]:
    """Project points of view `a` into view `b`; return their depth there, and the depth that `b` sees."""
    rows, columns = np.nonzero(depth > 0)
    pixels = np.stack(
        [
            columns + 0.5,
            rows + 0.5,
            np.ones(len(rows)),
        ]
    )
    rays = np.linalg.inv(cameras.Ks[a]) @ pixels * depth[rows, columns]
    b_from_a = cameras.viewmats[b] @ np.linalg.inv(cameras.viewmats[a])
    points = b_from_a[:3, :3] @ rays + b_from_a[:3, 3:]
    points = points[:, points[2] > 1e-6]
    u, v, _ = np.floor(cameras.Ks[b] @ points / points[2])
    height, width = other.shape
    inside = within_frame(u, v, width, height)
    row = v[inside].astype(int)
    column = u[inside].astype(int)
    return points[2, inside], other[row, column]


def choose_regularizers(
    given: Regularizers | str | None,
    prior: Splats,
    cameras: Cameras | None = None,
    *,
    paper: bool = False,
) -> tuple[Regularizers, str, PriorMeasures]:
    """Return the value of the setting `recover.regularizers`: as given, by name, or by measuring the prior.

    `auto` measures: uniform thin discs without view-dependent colour are an untrained lift. Over a tenth of
    needles, or views that see through each other's surfaces, mean a noisy trained scene. Anything else is a
    faithful one.

    Args:
        given: weights, or a name: auto (None), trained, lift or noisy; paper is auto with the paper's
            weights; paper-trained, paper-lift and paper-noisy are rows of its table.
        prior: the scene of the anchors, before simplification if available.
        cameras: views for measuring consistency; None skips it.
        paper: use the paper's weights, for its schedule.

    Returns:
        The weights, a line that explains the choice, and the measures.
    """
    if isinstance(given, Regularizers):
        return given, "as given", measure_prior(prior, cameras)
    name = given or "auto"
    kind = {"paper": "auto"}.get(name, name.removeprefix("paper-"))
    if kind != "auto" and kind not in REGULARIZERS:
        raise InputError(
            f"expected auto, paper, {', '.join(REGULARIZERS)}, got {name!r}", parameter="preset"
        )
    paper = paper or name.startswith("paper")
    measures = measure_prior(prior, cameras)
    why = "as requested"
    if kind == "auto":
        kind, why = _judge(measures)
    said = f"the paper's for {kind}" if paper else kind
    return Regularizers.of(kind, paper=paper), f"{said} ({why})", measures


def _judge(m: PriorMeasures) -> tuple[str, str]:
    if m.is_lift:
        return (
            "lift",
            "thin discs of equal proportions and colours without view dependence: not trained yet",
        )
    needles = f"{m.needle:.1%} of the Gaussians are needles"
    if m.needle > _MANY_NEEDLES:
        return "noisy", needles
    if m.consistency is None:
        return "trained", needles
    why = f"{needles}, {m.consistency:.0%} of the surface agrees between neighbouring views"
    if m.consistency < _LEAST_CONSISTENCY:
        return "noisy", why
    return "trained", why
