"""A picture of what `g2ard clean` would take out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats
    from g2ard.stages.clean import Cleaning

__all__ = ["paint_clutter"]

_COLORS = {
    "invisible": (0.20, 0.45, 0.95),
    "giant": (0.95, 0.85, 0.10),
    "needle": (0.90, 0.15, 0.75),
    "floater": (0.95, 0.25, 0.10),
}


def paint_clutter(path: Path, splats: Splats, found: Cleaning, cameras: Cameras, overwrite: bool) -> None:
    """Three views: as it is, what would go in the colour of its kind on grey, and what stays."""
    import numpy as np

    from g2ard.rendering.renderer import Renderer
    from g2ard.report.paint import painted
    from g2ard.scene.images import contact_sheet, write_png
    from g2ard.stages.clean import KINDS

    colors = np.array([*_COLORS.values(), (0.45, 0.48, 0.52)])[found.kind]
    scenes = [splats, painted(splats, colors), splats.take(found.keep)]
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(3, len(cameras))).astype(int))
    renderers = [Renderer(scene) for scene in scenes]
    rows = [[np.clip(r.image(cameras[int(view)]), 0, 1) for r in renderers] for view in chosen]
    legend = ", ".join(f"{name} {word}" for name, word in zip(KINDS, _WORDS, strict=True))
    labels = [f"{plural(len(splats), 'Gaussian')}", legend, f"{len(scenes[2]):,} stay"]
    write_png(path, contact_sheet(rows, labels), overwrite=overwrite)


_WORDS = ("blue", "yellow", "pink", "red")
