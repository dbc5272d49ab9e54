"""Scores of a scene, and pictures of some views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.rows import Row
from g2ard.config.choices import BLACK, Colour
from g2ard.io.images import as_saved, to_bytes
from g2ard.rendering.metrics import METRICS, Lpips
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.rendering.targets import Targets, mask_of
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats

__all__ = ["View", "figures", "pictured", "save_jpeg", "score"]

_PICTURES = 32
_QUALITY = 88
_SCORES = ("psnr", "ssim", "edge_psnr")

View = dict[str, Any]
"""A view's name, psnr, ssim, edge_psnr and lpips_NET, and whether it is black: in 8 bits, though its target
is not.
"""


def figures(views: list[View]) -> Row:
    """Return the columns of a row: means over views that are not black (`tab:geobase`, †), unless all are."""
    counted = [view for view in views if not view["black"]] or views
    means: Row = {
        name: float(np.mean([view[name] for view in counted]))
        for name in (*_SCORES, "lpips_vgg", "lpips_alex")
        if name in views[0]
    }
    worst = min(view["psnr"] for view in counted)
    black = sum(view["black"] for view in views)
    return {**means, "psnr_worst": worst, "views": len(counted), "black": black}


def score(
    splats: Splats,
    targets: Targets,
    background: Colour = BLACK,
    *,
    lpips: dict[str, Lpips] | None = None,
    settings: RasterSettings | None = None,
    eight_bit: bool = False,
    pictures: Path | None = None,
) -> list[View]:
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
        image, target = renderer.clipped(targets.cameras[number]), targets[number]
        if eight_bit:
            image, target = as_saved(image), as_saved(target)
        mask = mask_of(targets, number)
        view: View = {"name": name}
        view |= {score: METRICS[score].measure(image, target, mask) for score in _SCORES}
        view |= {f"lpips_{net}": model(image, target) for net, model in (lpips or {}).items()}
        view["black"] = not to_bytes(image).any() and bool(to_bytes(target).any())
        views.append(view)
        if pictures is not None and number in pictured(len(targets.cameras)):
            save_jpeg(pictures / f"{number}.jpg", image)
    return views


def pictured(count: int) -> list[int]:
    """Return the views to save as pictures: all, or 32 evenly spaced.

    >>> pictured(3), len(pictured(100))
    ([0, 1, 2], 32)
    """
    chosen = evenly_spaced(count, _PICTURES)
    return [int(view) for view in chosen]


def save_jpeg(path: Path, image: NDArray[np.float32]) -> None:
    """Write an image in [0, 1], and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(to_bytes(image)).save(path, quality=_QUALITY)
