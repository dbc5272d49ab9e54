"""Constants of registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from g2ard.config.checks import AboveZero, AtLeastOne, Share, Within
from g2ard.config.choices import Refinement
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require

_Side = Annotated[int, Within("[32, inf)")]
_SmallSide = Annotated[int, Within("[16, inf)")]
_Part = Annotated[float, Within("(0, 1]")]

STATED_FOCAL_SIGMA = 0.0002
"""σ of the logarithm of focal lengths that come with views, as bundle adjustment knows them."""
ROUGH_FOCAL_SIGMA = 0.015
"""The same for those typed in or from EXIF."""
TAIL = 2.0
"""Factor on `focal_sigma` in covariances, because a minority of focal lengths is far off."""

_FEATURE_FIELDS = (
    "passes",
    "features",
    "ratio",
    "max_reprojection",
    "min_inliers",
    "alike",
    "refine",
)


@dataclass(frozen=True)
class RegisterConfig(Settings):
    """Options of registration.

    Args:
        size: longer side in pixels for matching features; photos are shrunk to it.
        align_size: longer side in pixels of the finest alignment level, also for likeness; at most `size`.
        matcher: "auto" (SIFT if the extra `register` is installed, otherwise direct), "sift", "direct", or
            "MODULE:FUNCTION".
        refine: refinement after features: "none" keeps their pose, "photometric" aligns from it, "auto"
            combines both.
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
        focal_sigma: σ of the given focal lengths' logarithm. Pose and focal length are estimated together.
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

    size: _Side = 1000
    align_size: _Side = 500
    matcher: str = "auto"
    refine: Refinement = "auto"
    passes: AtLeastOne = 3
    coarsest: _SmallSide = 32
    iterations: AtLeastOne = 12
    still: AboveZero = 0.01
    accept: _Part = 0.6
    doubt: Share = 0.35
    max_angle_sigma: AboveZero = 0.7
    max_position_sigma: AboveZero = 0.04
    min_alpha: _Part = 0.5
    max_edge: AboveZero = 0.1
    min_overlap: _Part = 0.1
    window: Annotated[int, Within("[3, inf)")] = 15
    focal_sigma: AboveZero = STATED_FOCAL_SIGMA
    candidates: AtLeastOne = 5
    pool_size: _SmallSide = 64
    correlated: AboveZero = 1200.0
    features: AtLeastOne = 4096
    ratio: _Part = 0.85
    max_reprojection: AboveZero = 3.0
    min_inliers: Annotated[int, Within("[6, inf)")] = 30
    fallback: bool = True
    alike: AboveZero = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.matcher == "direct":
            unused = [n for n in _FEATURE_FIELDS if getattr(self, n) != getattr(RegisterConfig, n)]
            if unused:
                raise InputError("has no effect on the matcher direct", parameter=unused[0])
        require("window", self.window, self.window % 2 == 1, "an odd number")

    def levels(self) -> list[int]:
        """Return longer sides in pixels, coarse to fine, halving `align_size` down to about `coarsest`.

        >>> RegisterConfig().levels(), RegisterConfig(size=40).levels()
        ([31, 62, 125, 250, 500], [40])
        """
        out = [min(self.size, self.align_size)]
        while out[0] > 1.5 * self.coarsest:
            out.insert(0, out[0] // 2)
        return out
