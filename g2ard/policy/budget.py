"""An exact budget out of a count, a share or a ratio."""

from __future__ import annotations

import math
from dataclasses import dataclass

from g2ard.errors import InputError

__all__ = ["Budget"]


@dataclass(frozen=True)
class Budget:
    """How many Gaussians are to be left, said in one of three ways.

    Args:
        count: exactly so many.
        ratio: how many times fewer, at least 1; N/ratio is rounded to the nearest, and at least 1.
        share: of those there are, in (0, 1]; rounded up.

    Raises:
        InputError: not exactly one of them, or one out of its range.

    >>> Budget(ratio=3).of(1000), Budget(count=10).of(1000), Budget(share=0.25).of(10)
    (333, 10, 3)
    """

    count: int | None = None
    ratio: float | None = None
    share: float | None = None

    def __post_init__(self) -> None:
        if (self.count, self.ratio, self.share).count(None) != 2:
            raise InputError("count, ratio: expected exactly one of them")
        if self.count is not None and self.count < 1:
            raise InputError(f"count: expected at least 1, got {self.count}")
        if self.ratio is not None and not (math.isfinite(self.ratio) and self.ratio >= 1):
            raise InputError(f"ratio: expected at least 1, got {self.ratio}")
        if self.share is not None and not 0 < self.share <= 1:
            raise InputError(f"share: expected a number in (0, 1], got {self.share}")

    def of(self, total: int, name: str = "scene") -> int:
        """The exact budget out of `total` Gaussians of the scene that errors call `name`.

        Raises:
            InputError: it is above `total`.
        """
        if self.ratio is not None:
            return max(1, math.floor(total / self.ratio + 0.5))
        if self.share is not None:
            return max(1, math.ceil(self.share * total - 1e-9))
        assert self.count is not None
        if self.count > total:
            raise InputError(
                f"{name}: a budget of {self.count:,} is above its {total:,} Gaussians; {total:,} at most"
            )
        return self.count
