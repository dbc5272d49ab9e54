"""Scores of a scene, and pictures of some views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.rows import Row
from g2ard.rendering.lpips import Lpips
from g2ard.rendering.metrics import psnr, ssim
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.scene.images import as_saved, to_bytes
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets, mask_of

__all__ = ["Scored", "ViewFigures", "luma", "pictured", "save_jpeg", "score"]

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
_PICTURES = 32
_QUALITY = 88


@dataclass(frozen=True)
class ViewFigures:
    """Scores of a view.

    Args:
        luma: mean luma of the render minus that of the target.
        black: whether the render is black in 8 bits and the target is not.
    """

    name: str
    psnr: float
    ssim: float
    luma: float
    lpips_alex: float | None = None
    lpips_vgg: float | None = None
    black: bool = False


@dataclass(frozen=True)
class Scored:
    """Scores of all views, with means over those that are not black (`tab:geobase`, †) unless all are."""

    views: tuple[ViewFigures, ...]

    @property
    def counted(self) -> tuple[ViewFigures, ...]:
        """The views in the means."""
        return tuple(view for view in self.views if not view.black) or self.views

    def mean(self, name: str) -> float | None:
        """Return the mean of one score, or None if it was not measured."""
        values = [getattr(view, name) for view in self.counted]
        return None if None in values else float(np.mean(values))

    def figures(self) -> Row:
        """Return the columns of a row."""
        means = {name: self.mean(name) for name in ("psnr", "ssim", "lpips_vgg", "lpips_alex")}
        worst = min(view.psnr for view in self.counted)
        drift = float(np.mean([abs(view.luma) for view in self.counted]))
        black = sum(view.black for view in self.views)
        return {**means, "psnr_worst": worst, "luma_drift": drift, "views": len(self.counted), "black": black}


def luma(image: NDArray[np.float32], mask: NDArray[np.bool_] | None = None) -> float:
    """Return the mean Rec. 709 luma of an image in [0, 1], or of the pixels in a mask.

    >>> round(luma(np.full((2, 2, 3), 0.5, np.float32)), 6)
    0.5
    """
    pixels = image if mask is None else image[mask]
    return float((pixels.astype(np.float64) @ _LUMA).mean())


def score(
    splats: Splats,
    targets: Targets,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    lpips: dict[str, Lpips] | None = None,
    settings: RasterSettings | None = None,
    eight_bit: bool = False,
    pictures: Path | None = None,
) -> Scored:
    """Render and score every view.

    Args:
        splats: the scene.
        targets: photos or renders.
        background: RGB behind the scene.
        lpips: LPIPS networks, if any.
        settings: conventions of the renderer; None means gsplat's.
        eight_bit: as in `g2ard.stages.evaluate.evaluate`.
        pictures: folder for JPEGs of the `pictured` views, named by index.
    """
    renderer = Renderer(splats, background=background, settings=settings)
    views = []
    for number, name in enumerate(targets.cameras.names):
        image, target = np.clip(renderer.image(targets.cameras[number]), 0, 1), targets[number]
        if eight_bit:
            image, target = as_saved(image), as_saved(target)
        mask = mask_of(targets, number)
        off = luma(image, mask) - luma(target, mask)
        perceived = {f"lpips_{net}": model(image, target) for net, model in (lpips or {}).items()}
        views.append(
            ViewFigures(
                name,
                psnr(image, target, mask),
                ssim(image, target, mask),
                off,
                **perceived,
                black=not to_bytes(image).any() and bool(to_bytes(target).any()),
            )
        )
        if pictures is not None and number in pictured(len(targets.cameras)):
            save_jpeg(pictures / f"{number}.jpg", image)
    return Scored(tuple(views))


def pictured(count: int) -> list[int]:
    """Return the views to save as pictures: all, or 32 evenly spaced.

    >>> pictured(3), len(pictured(100))
    ([0, 1, 2], 32)
    """
    chosen = np.unique(np.linspace(0, count - 1, min(count, _PICTURES)).round().astype(int))
    return [int(view) for view in chosen]


def save_jpeg(path: Path, image: NDArray[np.float32]) -> None:
    """Write an image in [0, 1], and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(to_bytes(image)).save(path, quality=_QUALITY)
