"""Constants of simplification, and the counts of its rounds."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import cast

from g2ard import _core
from g2ard.config.checks import check_fields
from g2ard.config.choices import METHODS, Method
from g2ard.errors import InputError, require
from g2ard.scene.regions import Region, as_regions

_RETENTION: dict[str, float] = {"default": 0.65, "fast": 0.65, "paper": 0.75}

_CORE = _core.defaults()
"""Defaults of the Rust core, by method."""

_PAIRWISE, _PAPER = _CORE["default"], _CORE["paper"]

_METHOD_DEFAULTS = ("min_opacity", "morton_premerge_ratio", "morton_premerge_steps")
"""Constants whose default depends on the method."""


_PAIRS, _OF_PAPER = ("default", "fast"), ("paper",)
_USED_BY: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("retention", "fold"), ("default", "paper")),
    "neighbors": ("default",),
    **dict.fromkeys(
        ("morton_premerge_ratio", "morton_premerge_steps", "geometric_weight", "dilation"), _PAIRS
    ),
    **dict.fromkeys(("pixel_scale", "max_growth", "keep_region", "keep_times"), _PAIRS),
    **dict.fromkeys(("color_bin", "max_energy", "min_coverage", "support"), _OF_PAPER),
    **dict.fromkeys(("flag_threshold", "flag_members", "protection"), _OF_PAPER),
}
"""Constant → the methods that use it; the others are used by all."""


@dataclass(frozen=True)
class SimplifyConfig:
    """Constants of simplification: the paper's (`tab:s_config`) if it states them, otherwise measured ones
    (`docs/g2ard-and-the-paper.md`, `docs/methods`).

    Args:
        method: "default", "fast" or "paper", see `g2ard.stages.simplify.simplify`.
        retention: share of the Gaussians that a round keeps; None means 0.75 for `paper` and 0.65 for the
            others (fewer rounds, equally good).
        fold: a last round that removes less than this share (0–1) is merged into the previous one, to save
            its recovery; not in the paper.
        min_opacity: α below which Gaussians are dropped; None means 0.01 for `paper` and 0.004 (invisible)
            for the others.
        morton_premerge_ratio: `default`, `fast`: rows first merge along Morton order until this multiple of
            the budget remains, then as pairs of neighbours; at least 1, infinity merges pairs only. None
            means 3 for `default`, 1 for `fast`.
        morton_premerge_steps: `default`, `fast`: steps of the merging along Morton order, each on a shifted
            lattice. None means 1 for `default`, 2 for `fast`.
        neighbors: `default`: number of nearest clusters considered for merging; 16 is worse, because it
            includes distant ones.
        geometric_weight: `default`, `fast`: weight of the coverage error relative to the colour error; halved
            without views, because much of the scene is hidden.
        dilation: `default`, `fast`: standard deviation of the renderer's blur, in pixels. The renderer's
            is √0.3 ≈ 0.55; 0.4 measured best. 0 for antialiased scenes.
        pixel_scale: `default`, `fast` without views: pixel size over the median of the largest scales.
        max_growth: `default`, `fast`: factor by which a cluster's area may grow, along its two longer axes,
            if α ≤ 0.99 cannot hold its mass. With 1, opaque surfaces show gaps.
        keep_region: `default`, `fast` with views: spheres (x, y, z, r) and boxes (x, y, z, x, y, z), in world
            coordinates, that get more of the budget.
        keep_times: weight of these regions: views count as if √keep_times times closer, so that each Gaussian
            covers keep_times as many pixels.
        color_bin: `paper`: edge of the colour bins within a cell, in colour units
            (`tab:s_config`).
        max_energy: `paper`: largest affine energy of a merged group, summed over channels, colour units
            squared (`tab:s_config`; E_j of eq. `frequency`).
        min_coverage: `paper`: least share of the members' footprint area that the merged footprint covers
            (`tab:s_config`).
        support: `paper`: radius of a footprint for that, in standard deviations, 3 as in 3DGS's renderer; not
            in the paper.
        flag_threshold: ε_h, the affine residual of a cell above which its Gaussians are protected, colour
            units squared (eq. `frequency`, `tab:s_config`).
        flag_members: a cell with fewer Gaussians borrows those of its face neighbours for the fit behind its
            residual; not in the paper. 8 are two per affine coefficient; 1 borrows nothing.
        protection: `paper`: λ_h, relative increase of a protected Gaussian's priority π (eq. `importance`,
            `tab:s_config`).
    """

    method: Method = "default"
    retention: float | None = None
    fold: float = 0.05
    min_opacity: float | None = None
    morton_premerge_ratio: float | None = None
    morton_premerge_steps: int | None = None
    neighbors: int = _PAIRWISE["neighbors"]
    geometric_weight: float = _PAIRWISE["geometric_weight"]
    dilation: float = _PAIRWISE["dilation"]
    pixel_scale: float = _PAIRWISE["pixel_scale"]
    max_growth: float = _PAIRWISE["max_growth"]
    keep_region: tuple[Region, ...] = ()
    keep_times: float = 4.0
    color_bin: float = _PAPER["color_bin"]
    max_energy: float = _PAPER["max_energy"]
    min_coverage: float = _PAPER["min_coverage"]
    support: float = _PAPER["support"]
    flag_threshold: float = _PAPER["flag_threshold"]
    flag_members: int = _PAPER["flag_members"]
    protection: float = _PAPER["protection"]

    def __post_init__(self) -> None:
        check_fields(self)
        require("method", repr(self.method), self.method in METHODS, f"one of {', '.join(METHODS)}")
        retention, alpha = self.retention, self.min_opacity
        require("retention", retention, retention is None or 0 < retention < 1, "a number between 0 and 1")
        require("fold", self.fold, 0 <= self.fold < 1, "a number in [0, 1)")
        require("min_opacity", alpha, alpha is None or 0 <= alpha <= 1, "a number in [0, 1]")
        for name in ("max_growth", "morton_premerge_ratio", "morton_premerge_steps", "neighbors"):
            value = getattr(self, name)
            require(name, value, value is None or value >= 1, "at least 1")
        object.__setattr__(self, "keep_region", as_regions(self.keep_region))
        for name in ("color_bin", "pixel_scale", "support", "keep_times"):
            value = getattr(self, name)
            require(name, value, math.isfinite(value) and value > 0, "a positive number")
        for name in (
            "geometric_weight",
            "dilation",
            "max_energy",
            "min_coverage",
            "flag_threshold",
            "flag_members",
            "protection",
        ):
            value = getattr(self, name)
            require(name, value, value >= 0, "a number ≥ 0")

    def check_used(self, *, rounds: bool = False, apart: Collection[str] = ()) -> None:
        """Reject constants that were changed but that the method does not use.

        Args:
            rounds: whether the config also sets the counts of rounds with recovery in between.
            apart: names that are not checked.

        Raises:
            InputError: the first such constant.

        >>> SimplifyConfig(method="fast", max_energy=0.5).check_used()
        Traceback (most recent call last):
        g2ard.errors.InputError: max_energy: has no effect on the method fast, only on paper
        """
        for name, methods in _USED_BY.items():
            value = getattr(self, name)
            unchanged = value == getattr(type(self), name) or name in apart
            if self.method in methods or unchanged or (rounds and name in ("retention", "fold")):
                continue
            only = " and ".join(methods)
            raise InputError(f"has no effect on the method {self.method}, only on {only}", parameter=name)
        if self.keep_times != type(self).keep_times and not self.keep_region:
            raise InputError("has no effect without regions to keep", parameter="keep_times")

    def resolved(self, method: str | None = None, *, antialiased: bool = False) -> SimplifyConfig:
        """Return the config for a method (by default its own), with None replaced by the method's constants.

        Antialiased scenes get no dilation: their renderer takes from opacity what its blur adds in area.

        >>> SimplifyConfig().resolved("paper").retention
        0.75
        """
        method = cast(Method, method or self.method)
        own = {
            name: value
            for name, value in _CORE[method].items()
            if name in _METHOD_DEFAULTS and getattr(self, name) is None
        }
        if antialiased:
            own["dilation"] = 0.0
        return replace(self, method=method, retention=self.retention_of(method), **own)

    def retention_of(self, method: str) -> float:
        """Return the share of Gaussians that a round of `method` keeps."""
        return _RETENTION[method] if self.retention is None else self.retention


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
