"""Constants of simplification, and the counts of its rounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import g2ard._core as _core
from g2ard.config.checks import AtLeastOne, Positive, Share, Within
from g2ard.config.choices import Method
from g2ard.config.schema import Settings
from g2ard.errors import InputError
from g2ard.scene.regions import Region, as_regions

_RETENTION: dict[str, float] = {"default": 0.65, "fast": 0.65, "paper": 0.75}

_USUAL_RATIO = 10.0
"""Reduction from which more of the merging is done in pairs."""

_CORE = _core.defaults()
"""Defaults of the Rust core, by method."""

_PAIRWISE = _CORE["default"]
_PAPER = _CORE["paper"]


@dataclass(frozen=True)
class SimplifyConfig(Settings, tag="method"):
    """Settings of every method of simplification; `SimplifyConfig(method="paper", …)` makes those of one.

    Constants are the paper's (`tab:s_config`) if it states them, otherwise measured ones
    (`docs/g2ard-and-the-paper.md`, `docs/methods`).

    Args:
        method: "default", "fast" or "paper", see `g2ard.stages.simplify.simplify`. Each has further settings:
            `Default`, `Fast` and `Paper`.
        min_opacity: α below which Gaussians are dropped; None means 0.01 for `paper` and 0.004 (invisible)
            for the others.
    """

    method: Method = "default"
    min_opacity: Share | None = None

    if TYPE_CHECKING:  # the settings of a method are those of its class
        retention: ClassVar[float | None]
        fold: ClassVar[float]

        def __init__(self, method: Method = "default", **settings: Any) -> None: ...

    def rounds(self, count: int, budget: int, *, recovered: bool = False) -> list[int]:
        """Return the count after each round; without `retention`, rounds with recovery keep 75 % each."""
        usual = _RETENTION["paper" if recovered else self.method]
        return round_counts(count, budget, self.retention or usual, self.fold)

    def resolved(self, *, antialiased: bool = False, ratio: float = 1.0) -> Self:
        """Return the config with None replaced by the method's constants, for a reduction by `ratio`.

        Antialiased scenes get no dilation: their renderer takes from opacity what its blur adds in area.

        >>> SimplifyConfig(method="paper").resolved().retention
        0.75
        >>> SimplifyConfig().resolved(ratio=1000).morton_premerge_ratio
        30.0
        """
        own = {"retention": _RETENTION[self.method], **_CORE[self.method]}
        given = {
            f.name: own[f.name]
            for f in fields(self)
            if f.name in own and getattr(self, f.name) is None
        }
        if isinstance(self, Default) and "morton_premerge_ratio" in given:
            given["morton_premerge_ratio"] *= max(1.0, math.sqrt(ratio / _USUAL_RATIO))
        if antialiased and isinstance(self, Pairs):
            given["dilation"] = 0.0
        return replace(self, **given)


@dataclass(frozen=True)
class Rounds(SimplifyConfig):
    """Settings of methods that work in rounds.

    Args:
        retention: share of the Gaussians that a round keeps; None means 0.75 for `paper` and 0.65 for the
            others (fewer rounds, equally good).
        fold: a last round that removes less than this share (0–1) is merged into the previous one, to save
            its recovery; not in the paper.
    """

    retention: Annotated[float, Within("(0, 1)")] | None = None  # type: ignore[misc]
    fold: Annotated[float, Within("[0, 1)")] = 0.05  # type: ignore[misc]


@dataclass(frozen=True)
class Pairs(SimplifyConfig):
    """Settings of `default` and `fast`.

    Args:
        morton_premerge_ratio: rows first merge along Morton order until this multiple of the budget remains,
            then as pairs of neighbours; at least 1, infinity merges pairs only. None means 3 for `default`,
            times √(ratio/10) beyond 10×, and 1 for `fast`.
        morton_premerge_steps: steps of the merging along Morton order, each on a shifted lattice. None means
            1 for `default`, 2 for `fast`.
        longest_run: longest run of Morton order that merges, in mean runs, so that details that are fine from
            afar survive; infinity for no limit. None means 6 for `default`, 4 for `fast`.
        edge_weight: with views: weight of the error of gradients beside that of values, in pixels squared.
        geometric_weight: weight of the coverage error relative to the colour error; halved without views,
            because much of the scene is hidden.
        dilation: standard deviation of the renderer's blur, in pixels. The renderer's is √0.3 ≈ 0.55; 0.4
            measured best. 0 for antialiased scenes.
        pixel_scale: without views: pixel size over the median of the largest scales.
        surface_depth: merged Gaussians whose mass α ≤ 0.99 cannot hold widen along their two longer axes
            until the optical depth of the surface at their centre reaches this, so that it stays closed. 3
            stops 95 % of the light; infinity keeps all mass, which blurs where layers lie on each other.
        max_growth: largest factor by which their area grows. With 1, opaque surfaces show gaps.
        keep_region: with views: spheres (x, y, z, r) and boxes (x, y, z, x, y, z), in world coordinates, that
            get more of the budget.
        keep_times: weight of these regions: views count as if √keep_times times closer, so that each Gaussian
            covers keep_times as many pixels.
    """

    morton_premerge_ratio: Annotated[float, Within("[1, inf]")] | None = None
    morton_premerge_steps: AtLeastOne | None = None
    longest_run: Annotated[float, Within("[1, inf]")] | None = None
    edge_weight: Annotated[float, Within("[0, inf]")] = _PAIRWISE["edge_weight"]
    geometric_weight: Annotated[float, Within("[0, inf]")] = _PAIRWISE["geometric_weight"]
    dilation: Annotated[float, Within("[0, inf]")] = _PAIRWISE["dilation"]
    pixel_scale: Positive = _PAIRWISE["pixel_scale"]
    surface_depth: Annotated[float, Within("(0, inf]")] = _PAIRWISE["surface_depth"]
    max_growth: Annotated[float, Within("[1, inf]")] = _PAIRWISE["max_growth"]
    keep_region: tuple[Region, ...] = ()
    keep_times: Positive = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "keep_region", as_regions(self.keep_region))
        if self.keep_times != Pairs.keep_times and not self.keep_region:
            raise InputError("has no effect without regions to keep", parameter="keep_times")


@dataclass(frozen=True)
class Default(Pairs, Rounds, variants=("default",)):
    """Settings of the method `default`, besides those of `Rounds` and `Pairs`.

    Args:
        neighbors: number of nearest clusters considered for merging; 16 is worse, because it includes distant
            ones.
    """

    method: Literal["default"] = "default"
    neighbors: AtLeastOne = _PAIRWISE["neighbors"]


@dataclass(frozen=True)
class Fast(Pairs, variants=("fast",)):
    """Settings of the method `fast`: those of `Pairs`. Rounds with recovery keep 75 % each."""

    method: Literal["fast"] = "fast"
    neighbors: ClassVar[int] = _PAIRWISE["neighbors"]
    retention: ClassVar[float | None] = None
    fold: ClassVar[float] = 0.0


@dataclass(frozen=True)
class Paper(Rounds, variants=("paper",)):
    """Settings of the method `paper`, besides those of `Rounds`.

    Args:
        color_bin: edge of the colour bins within a cell, in colour units (`tab:s_config`).
        max_energy: largest affine energy of a merged group, summed over channels, colour units squared
            (`tab:s_config`; E_j of eq. `frequency`).
        min_coverage: least share of the members' footprint area that the merged footprint covers
            (`tab:s_config`).
        support: radius of a footprint for that, in standard deviations, 3 as in 3DGS's renderer; not in the
            paper.
        flag_threshold: ε_h, the affine residual of a cell above which its Gaussians are protected, colour
            units squared (eq. `frequency`, `tab:s_config`).
        flag_members: a cell with fewer Gaussians borrows those of its face neighbours for the fit behind its
            residual; not in the paper. 8 are two per affine coefficient; 1 borrows nothing.
        protection: λ_h, relative increase of a protected Gaussian's priority π (eq. `importance`,
            `tab:s_config`).
    """

    method: Literal["paper"] = "paper"
    color_bin: Positive = _PAPER["color_bin"]
    max_energy: Annotated[float, Within("[0, inf]")] = _PAPER["max_energy"]
    min_coverage: Annotated[float, Within("[0, inf]")] = _PAPER["min_coverage"]
    support: Positive = _PAPER["support"]
    flag_threshold: Annotated[float, Within("[0, inf]")] = _PAPER["flag_threshold"]
    flag_members: Annotated[int, Within("[0, inf)")] = _PAPER["flag_members"]
    protection: Annotated[float, Within("[0, inf]")] = _PAPER["protection"]


def round_counts(
    count: int, budget: int, retention: float = _RETENTION["paper"], fold: float = 0.05
) -> list[int]:
    """Return the count after each round, N_r = max(N_S, ⌈retention·N_{r−1}⌉), folding in a small last round.

    >>> round_counts(500_000, 50_000)
    [375000, 281250, 210938, 158204, 118653, 88990, 66743, 50000]
    >>> round_counts(10, 10)
    []
    """
    rounds: list[int] = []
    while count > budget:
        count = max(budget, min(count - 1, math.ceil(retention * count)))
        if budget > (1 - fold) * count:
            count = budget
        rounds.append(count)
    return rounds
