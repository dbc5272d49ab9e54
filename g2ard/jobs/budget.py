"""Budgets: an exact count from a count, share, ratio, device, file size or quality."""

import math
import re
from dataclasses import dataclass
from typing import Annotated

from g2ard.config.checks import AtLeastOne, Positive, Within
from g2ard.config.schema import Settings
from g2ard.errors import InputError

DEVICES = {
    "quest3": 400_000,
    "visionpro": 750_000,
    "android": 1_000_000,
    "ios": 1_500_000,
    "mobile": 1_000_000,
    "web": 2_000_000,
    "desktop": 2_500_000,
}
"""Gaussians that render smoothly: the defaults of Spark and of SuperSplat's viewer; fewer for Quest 3, after
reports of its users. Sources are in `docs/how-to/headset-budget.md`.
"""
LAYERS = {"quest3": 67}
"""Most Gaussians per pixel of near views: pixels that the device can write over those that it shows.
The same page derives it.
"""

_PAGE = "page:"
"""Prefix of the bytes of a page with the scene."""
_BYTES = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmMgG])[bB]")
_UNITS = {"k": 1e3, "m": 1e6, "g": 1e9}
_COUNT = re.compile(r"(\d+(?:\.\d+)?)\s*([kKmM]?)")


def parse_count(given: int | str | None) -> int | None:
    """Return a count that is given as a number, or as text such as 50k, 1.5M or 50_000.

    >>> parse_count("50k"), parse_count("1.5M"), parse_count(" 50_000 "), parse_count(7)
    (50000, 1500000, 50000, 7)
    """
    if not isinstance(given, str):
        return given
    match = _COUNT.fullmatch(given.strip().replace("_", ""))
    count = float(match[1]) * _UNITS.get(match[2].lower(), 1) if match else 0.5
    if count != round(count):
        raise InputError(
            f"expected a whole number, or text such as 50k or 1.5M, got {given!r}",
            parameter="count",
        )
    return round(count)


@dataclass(frozen=True)
class Budget(Settings):
    """Number of Gaussians to keep, given in one of several ways.

    Args:
        count: exact number.
        ratio: reduction factor, at least 1; keeps round(N/ratio), at least 1.
        share: share to keep, in (0, 1]; rounded up.
        fit: as many as fit into a file of this size, such as 5MB or 800kB, or into a viewer page with the
            scene alone, such as page:10MB, or render smoothly on a device: quest3, visionpro, android, ios,
            mobile, web or desktop.
        min_psnr: approximately the fewest that keep this PSNR (dB) against renders of the scene.
        min_ssim: approximately the fewest that keep this SSIM; with `min_psnr` both hold.

    >>> Budget(ratio=3).of(1000), Budget(count=10).of(1000), Budget(share=0.25).of(10)
    (333, 10, 3)
    >>> Budget(fit="1.5MB").bytes, Budget(fit="quest3").of(2_000_000)
    (1500000, 400000)
    """

    count: AtLeastOne | None = None
    ratio: Annotated[float, Within("[1, inf)")] | None = None
    share: Annotated[float, Within("(0, 1]")] | None = None
    fit: str | None = None
    min_psnr: Positive | None = None
    min_ssim: Annotated[float, Within("(0, 1)")] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        quality = self.min_psnr if self.min_ssim is None else self.min_ssim
        if (self.count, self.ratio, self.share, self.fit, quality).count(None) != 4:
            raise InputError(
                "expected exactly one kind of budget: count, ratio, fit, min_psnr or min_ssim"
            )
        if self.fit is not None and self.fit.lower() not in DEVICES and not self.bytes:
            raise InputError(
                f"expected bytes such as 5MB or page:10MB, or {', '.join(DEVICES)}, got {self.fit!r}",
                parameter="fit",
            )

    @property
    def kind(self) -> str:
        """Name of the given field; min_psnr for both qualities."""
        return next(name for name, value in vars(self).items() if value is not None)

    @property
    def bytes(self) -> int | None:
        """Size of `fit` in bytes; None if `fit` names a device or is not given."""
        match = _BYTES.fullmatch((self.fit or "").strip().removeprefix(_PAGE).strip())
        return None if match is None else round(float(match[1]) * _UNITS[match[2].lower()])

    @property
    def of_page(self) -> bool:
        """Return whether the bytes are those of a page with the scene."""
        return (self.fit or "").strip().startswith(_PAGE)

    @property
    def is_measured(self) -> bool:
        """Return whether the count depends on the scene, not only on its size: `budget_search`."""
        return self.layers is not None or self._is_searched

    @property
    def layers(self) -> int | None:
        """Most Gaussians per pixel of near views on the device of `fit`; None for no limit."""
        return LAYERS.get((self.fit or "").lower())

    @property
    def _is_searched(self) -> bool:
        return self.bytes is not None or self.min_psnr is not None or self.min_ssim is not None

    def of(self, total: int, name: str = "scene") -> int:
        """Return the count for a scene of `total` Gaussians, called `name` in errors.

        `layers` may lower it further.
        """
        if self._is_searched:
            raise InputError("fit, min_psnr, min_ssim: the count depends on the scene")
        if self.ratio is not None:
            return max(1, math.floor(total / self.ratio + 0.5))
        if self.share is not None:
            return max(1, math.ceil(self.share * total - 1e-9))
        if self.fit is not None:
            return min(DEVICES[self.fit.lower()], total)
        assert self.count is not None
        if self.count > total:
            raise InputError(
                f"expected a budget of at most {total:,}, got {self.count:,}", path=name
            )
        return self.count
