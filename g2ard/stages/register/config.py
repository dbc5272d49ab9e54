"""Constants of registration."""

from __future__ import annotations

from dataclasses import dataclass

from g2ard.errors import require

__all__ = ["RegisterConfig"]


@dataclass(frozen=True)
class RegisterConfig:
    """How photos are registered.

    Args:
        size: pixels of the longer side that alignment ends at; photos are shrunk to it.
        coarsest: pixels of the longer side that alignment begins at; it doubles from level to level.
        iterations: at most, at each level.
        still: a level ends when a step moves the image by fewer pixels (root of the mean square).
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
        correlated: what variances are multiplied by, for neighbouring residuals err alike: measured at size
            500, so that errors on caliterra's held-out photos are as large as their σ says.

    Raises:
        InputError: a value out of its range.
    """

    size: int = 500
    coarsest: int = 32
    iterations: int = 12
    still: float = 0.01
    accept: float = 0.6
    doubt: float = 0.35
    max_angle_sigma: float = 0.5
    max_position_sigma: float = 0.02
    min_alpha: float = 0.8
    max_edge: float = 0.1
    min_overlap: float = 0.1
    window: int = 15
    candidates: int = 5
    pool_size: int = 64
    correlated: float = 300.0

    def __post_init__(self) -> None:
        require("size", self.size, self.size >= 32, "at least 32 pixels")
        require("coarsest", self.coarsest, self.coarsest >= 16, "at least 16 pixels")
        require("iterations", self.iterations, self.iterations >= 1, "at least 1")
        require("still", self.still, self.still > 0, "a positive number of pixels")
        require("accept", self.accept, 0 < self.accept <= 1, "a value in (0, 1]")
        require("doubt", self.doubt, 0 <= self.doubt <= 1, "a value in [0, 1]")
        for name in ("max_angle_sigma", "max_position_sigma", "max_edge", "correlated"):
            require(name, getattr(self, name), getattr(self, name) > 0, "a positive number")
        require("min_alpha", self.min_alpha, 0 < self.min_alpha <= 1, "a value in (0, 1]")
        require("min_overlap", self.min_overlap, 0 < self.min_overlap <= 1, "a value in (0, 1]")
        require("window", self.window, self.window >= 3 and self.window % 2 == 1, "an odd number from 3 on")
        require("candidates", self.candidates, self.candidates >= 1, "at least 1")
        require("pool_size", self.pool_size, self.pool_size >= 16, "at least 16 pixels")

    def levels(self) -> list[int]:
        """Longer sides in pixels, coarse to fine: halves of `size` down to `coarsest`.

        >>> RegisterConfig().levels(), RegisterConfig(size=40).levels()
        ([31, 62, 125, 250, 500], [40])
        """
        out = [self.size]
        while out[0] > 1.5 * self.coarsest:
            out.insert(0, out[0] // 2)
        return out
