"""Constants of registration."""

from __future__ import annotations

from dataclasses import dataclass

from g2ard.config.choices import REFINEMENTS, Refinement
from g2ard.errors import require

_POSITIVE = ("max_angle_sigma", "max_position_sigma", "max_edge", "correlated", "max_reprojection", "alike")


@dataclass(frozen=True)
class RegisterConfig:
    """How photos are registered.

    Args:
        size: pixels of the longer side that features are matched at; photos are shrunk to it.
        align_size: pixels of the longer side that alignment ends at, and that likeness is judged at, or
            `size` where that is less.
        matcher: "auto" (SIFT where the extra `register` is installed, else direct), "sift", "direct", or
            "MODULE:FUNCTION".
        refine: what follows features: "auto" joins their pose and that of direct alignment, "photometric"
            takes the second, "none" the first; "exact" goes on from "auto", or from alignment where there
            are no features, by the exact gradient of renders (`g2ard.stages.register.polish`).
        passes: of rendering, matching and solving, at most.
        coarsest: pixels of the longer side that alignment begins at; it doubles from level to level.
        iterations: at most, at each level.
        still: the finest level ends when a step moves the image by fewer pixels (root of the mean square), a
            coarser one at ten times as many.
        accept: median local ZNCC from which a photo counts as registered.
        doubt: the same, from which it counts as uncertain; below, it is refused.
        max_angle_sigma: degrees; a registered photo's rotation is known better than this.
        max_position_sigma: as a share of the median depth; likewise its position.
        min_alpha: pixels of the render that hide less of the background than this do not count.
        max_edge: pixels next to which depth jumps by more than this share of it do not count.
        min_overlap: share of the pixels that must count, or nothing can be said.
        window: pixels of the side of ZNCC's windows.
        candidates: the best poses of a pool, by renders of `pool_size` pixels, that are aligned.
        pool_size: pixels of the longer side of those renders.
        correlated: what variances are multiplied by, for neighbouring residuals err alike: set so that
            errors at 500 pixels are about as large as their σ says, on photos of caliterra and of the city.
        features: of an image, at most, for SIFT.
        ratio: SIFT's nearest feature is nearer than this share of the distance to the second nearest.
        max_reprojection: pixels within which PnP explains a match.
        min_inliers: matches that PnP must explain for a pose from features to count.
        fallback: whether alignment is tried where features fail.
        alike: what the variances of features' poses are multiplied by, as `correlated`.

    Raises:
        InputError: a value out of its range.
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
        require("size", self.size, self.size >= 32, "at least 32 pixels")
        require("align_size", self.align_size, self.align_size >= 32, "at least 32 pixels")
        require("refine", self.refine, self.refine in REFINEMENTS, f"one of {', '.join(REFINEMENTS)}")
        require("coarsest", self.coarsest, self.coarsest >= 16, "at least 16 pixels")
        require("iterations", self.iterations, self.iterations >= 1, "at least 1")
        require("still", self.still, self.still > 0, "a positive number of pixels")
        require("accept", self.accept, 0 < self.accept <= 1, "a value in (0, 1]")
        require("doubt", self.doubt, 0 <= self.doubt <= 1, "a value in [0, 1]")
        for name in ("passes", "features"):
            require(name, getattr(self, name), getattr(self, name) >= 1, "at least 1")
        require("ratio", self.ratio, 0 < self.ratio <= 1, "a value in (0, 1]")
        require("min_inliers", self.min_inliers, self.min_inliers >= 6, "at least 6")
        for name in _POSITIVE:
            require(name, getattr(self, name), getattr(self, name) > 0, "a positive number")
        require("min_alpha", self.min_alpha, 0 < self.min_alpha <= 1, "a value in (0, 1]")
        require("min_overlap", self.min_overlap, 0 < self.min_overlap <= 1, "a value in (0, 1]")
        require("window", self.window, self.window >= 3 and self.window % 2 == 1, "an odd number from 3 on")
        require("candidates", self.candidates, self.candidates >= 1, "at least 1")
        require("pool_size", self.pool_size, self.pool_size >= 16, "at least 16 pixels")

    def levels(self) -> list[int]:
        """Longer sides in pixels, coarse to fine: halves of `align_size` down to `coarsest`.

        >>> RegisterConfig().levels(), RegisterConfig(size=40).levels()
        ([31, 62, 125, 250, 500], [40])
        """
        out = [min(self.size, self.align_size)]
        while out[0] > 1.5 * self.coarsest:
            out.insert(0, out[0] // 2)
        return out
