"""Constants of registration."""

from __future__ import annotations

from dataclasses import dataclass

from g2ard.config.checks import check_fields
from g2ard.config.choices import REFINEMENTS, Refinement
from g2ard.errors import InputError, require

_POSITIVE_FIELDS = (
    "max_angle_sigma",
    "max_position_sigma",
    "max_edge",
    "correlated",
    "max_reprojection",
    "alike",
)

_FEATURE_FIELDS = ("passes", "features", "ratio", "max_reprojection", "min_inliers", "alike")


@dataclass(frozen=True)
class RegisterConfig:
    """Options of registration.

    Args:
        size: longer side in pixels for matching features; photos are shrunk to it.
        align_size: longer side in pixels of the finest alignment level, also for likeness; at most `size`.
        matcher: "auto" (SIFT if the extra `register` is installed, otherwise direct), "sift", "direct", or
            "MODULE:FUNCTION".
        refine: refinement after features: "none" keeps their pose, "photometric" aligns from it, "auto"
            combines both, "exact" polishes the result (or alignment's) by the exact gradient of renders
            (`g2ard.stages.register.polish`).
        passes: maximum number of passes of rendering, matching and solving.
        coarsest: approximate longer side in pixels of the coarsest alignment level; each level doubles it.
        iterations: maximum iterations per level.
        still: the finest level ends when a step moves the image by fewer pixels (root mean square), coarser
            ones at ten times this.
        accept: lowest median local ZNCC for status "registered".
        doubt: lowest median local ZNCC for status "uncertain"; below, a photo is "refused".
        max_angle_sigma: largest σ of the rotation for "registered", degrees.
        max_position_sigma: largest σ of the position for "registered", as a share of the median depth.
        min_alpha: render pixels with less alpha are ignored.
        max_edge: pixels next to a relative depth jump above this are ignored.
        min_overlap: smallest share of valid pixels.
        window: side of ZNCC's windows in pixels.
        candidates: number of pool poses tried, ranked by renders of `pool_size` pixels.
        pool_size: longer side of those renders in pixels.
        correlated: factor on variances, because neighbouring residuals are correlated; calibrated at 500
            pixels on photos of caliterra and of the city.
        features: maximum SIFT features per image.
        ratio: SIFT's ratio test: largest ratio of the nearest to the second nearest distance.
        max_reprojection: largest reprojection error of an inlier, pixels.
        min_inliers: minimum inliers of a pose from features.
        fallback: try alignment if features fail.
        alike: factor on the variances of poses from features, like `correlated`.

    Raises:
        InputError: a value out of range.
    """

    size: int = 1000
    align_size: int = 500
    matcher: str = "auto"
    refine: Refinement = "auto"
    passes: int = 3
    coarsest: int = 32
    iterations: int = 12
    still: float = 0.01
    accept: float = 0.6
    doubt: float = 0.35
    max_angle_sigma: float = 0.7
    max_position_sigma: float = 0.03
    min_alpha: float = 0.5
    max_edge: float = 0.1
    min_overlap: float = 0.1
    window: int = 15
    candidates: int = 5
    pool_size: int = 64
    correlated: float = 2000.0
    features: int = 4096
    ratio: float = 0.85
    max_reprojection: float = 3.0
    min_inliers: int = 30
    fallback: bool = True
    alike: float = 10.0

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("size", "align_size"):
            require(name, getattr(self, name), getattr(self, name) >= 32, "at least 32 pixels")
        require("refine", self.refine, self.refine in REFINEMENTS, f"one of {', '.join(REFINEMENTS)}")
        for name in ("coarsest", "pool_size"):
            require(name, getattr(self, name), getattr(self, name) >= 16, "at least 16 pixels")
        require("still", self.still, self.still > 0, "a positive number of pixels")
        for name in ("accept", "ratio", "min_alpha", "min_overlap"):
            require(name, getattr(self, name), 0 < getattr(self, name) <= 1, "a value in (0, 1]")
        require("doubt", self.doubt, 0 <= self.doubt <= 1, "a value in [0, 1]")
        for name in ("passes", "features", "iterations", "candidates"):
            require(name, getattr(self, name), getattr(self, name) >= 1, "at least 1")
        require("min_inliers", self.min_inliers, self.min_inliers >= 6, "at least 6")
        for name in _POSITIVE_FIELDS:
            require(name, getattr(self, name), getattr(self, name) > 0, "a positive number")
        if self.matcher == "direct":
            unused = [
                name for name in _FEATURE_FIELDS if getattr(self, name) != getattr(RegisterConfig, name)
            ]
            unused += ["refine"] if self.refine in ("none", "photometric") else []
            if unused:
                raise InputError("has no effect on the matcher direct", parameter=unused[0])
        require("window", self.window, self.window >= 3 and self.window % 2 == 1, "an odd number from 3 on")

    def levels(self) -> list[int]:
        """Return longer sides in pixels, coarse to fine, halving `align_size` down to about `coarsest`.

        >>> RegisterConfig().levels(), RegisterConfig(size=40).levels()
        ([31, 62, 125, 250, 500], [40])
        """
        out = [min(self.size, self.align_size)]
        while out[0] > 1.5 * self.coarsest:
            out.insert(0, out[0] // 2)
        return out
