"""A before/after picture: held-out views, what they should show and what scenes render."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from g2ard.progress import plural
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets

__all__ = ["preview"]

_ROWS = 3


def preview(
    path: Path,
    targets: Targets,
    scenes: list[tuple[str, Splats]],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write a PNG with a row for each of three evenly spaced views: target, then each scene with its PSNR.

    Args:
        path: where the PNG goes.
        targets: photos or teacher renders with their cameras.
        scenes: (label, scene), left to right after the target.
        background: RGB behind the scenes.
    """
    from g2ard.rendering.metrics import psnr
    from g2ard.rendering.renderer import Renderer
    from g2ard.scene.images import contact_sheet, write_png

    count = len(targets.cameras)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _ROWS)).round().astype(int))
    rows, captions = [], []
    renderers = [Renderer(splats, background=background) for _, splats in scenes]
    for view in map(int, chosen):
        target = targets[view]
        images = [renderer.image(targets.cameras[view]) for renderer in renderers]
        rows.append([target, *(np.clip(image, 0, 1) for image in images)])
        scores = [
            f"{name} {psnr(image, target):.2f} dB"
            for (name, _), image in zip(scenes, rows[-1][1:], strict=True)
        ]
        captions.append(", ".join([targets.cameras.names[view], *scores]))
    labels = ["target", *(f"{name}: {plural(len(splats), 'Gaussian')}" for name, splats in scenes)]
    write_png(path, contact_sheet(rows, labels, row_labels=captions), overwrite=True)
