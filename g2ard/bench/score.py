"""What a cell's result is worth: figures of every view, and pictures of some."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from g2ard.images import to_bytes
from g2ard.lpips import Lpips
from g2ard.metrics import psnr, ssim
from g2ard.render import render
from g2ard.splats import Splats
from g2ard.targets import Targets, mask_of

__all__ = ["Scored", "ViewFigures", "luma", "pictured", "save_jpeg", "score"]

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
_PICTURES = 32
_QUALITY = 88


@dataclass(frozen=True)
class ViewFigures:
    """One view's figures; `luma` is the mean luma of the render less the target's."""

    name: str
    psnr: float
    ssim: float
    luma: float
    lpips_alex: float | None = None
    lpips_vgg: float | None = None


@dataclass(frozen=True)
class Scored:
    """Means over the views.

    Args:
        views: in the cameras' order.
    """

    views: tuple[ViewFigures, ...]

    def mean(self, name: str) -> float | None:
        """Of one figure; None where it was not measured."""
        values = [getattr(view, name) for view in self.views]
        return None if None in values else float(np.mean(values))

    @property
    def luma_drift(self) -> float:
        """Mean over views of |mean luma of the render − the target's|, in [0, 1]: exposure that wandered
        off."""
        return float(np.mean([abs(view.luma) for view in self.views]))


def luma(image: NDArray[np.float32], mask: NDArray[np.bool_] | None = None) -> float:
    """Mean Rec. 709 luma of an image in [0, 1], or of the pixels that count.

    >>> round(luma(np.full((2, 2, 3), 0.5, np.float32)), 6)
    0.5
    """
    pixels = image if mask is None else image[mask]
    return float((pixels.astype(np.float64) @ _LUMA).mean())


def score(
    splats: Splats,
    targets: Targets,
    background: tuple[float, float, float],
    *,
    lpips: dict[str, Lpips] | None = None,
    pictures: Path | None = None,
) -> Scored:
    """Render and score every view; JPEGs of `pictured` ones go to `pictures`, by the view's number."""
    views = []
    for number, name in enumerate(targets.cameras.names):
        image = np.clip(render(splats, targets.cameras, number, background=background).image, 0, 1)
        target = targets[number]
        mask = mask_of(targets, number)
        off = luma(image, mask) - luma(target, mask)
        perceived = {f"lpips_{net}": model(image, target) for net, model in (lpips or {}).items()}
        views.append(
            ViewFigures(name, psnr(image, target, mask), ssim(image, target, mask), off, **perceived)
        )
        if pictures is not None and number in pictured(len(targets.cameras)):
            save_jpeg(pictures / f"{number}.jpg", image)
    return Scored(tuple(views))


def pictured(count: int) -> list[int]:
    """The views that are kept as pictures: all, or 32 evenly spaced.

    >>> pictured(3), len(pictured(100))
    ([0, 1, 2], 32)
    """
    chosen = np.unique(np.linspace(0, count - 1, min(count, _PICTURES)).round().astype(int))
    return [int(view) for view in chosen]


def save_jpeg(path: Path, image: NDArray[np.float32]) -> None:
    """Write an image in [0, 1], making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(to_bytes(image)).save(path, quality=_QUALITY)
