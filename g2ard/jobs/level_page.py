"""index.html beside levels of detail."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from g2ard.config.choices import BLACK, Colour
from g2ard.jobs.inputs import Views
from g2ard.jobs.viewer_frame import frame_of
from g2ard.levels.tileset import TILE_OF_SCENE
from g2ard.levels.tree import Level
from g2ard.progress import Progress, silent
from g2ard.scene.samples import evenly_spaced
from g2ard.viewer import Start, write_globe_page, write_stream_page

_ROWS = 500_000
"""Gaussians of the coarsest level among which the opening view is chosen."""


def write_level_page(
    folder: Path,
    levels: Sequence[Level],
    kind: Literal["sog", "3dtiles"],
    *,
    views: Views | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    background: Colour = BLACK,
    seed: int = 0,
    progress: Progress = silent,
) -> int:
    """Write the page that shows the levels in a folder, and return its bytes.

    Args:
        levels: the levels in the folder, finest first.
        kind: streamed SOG, or 3D Tiles with z up.
        views, beside, up: see `g2ard.jobs.viewer_frame.frame_of`. The page's title names
            `beside`, or else the folder.
    """
    coarse = levels[-1]
    few = coarse.take(np.array(evenly_spaced(len(coarse), _ROWS, floor=True)))
    frame = frame_of(few, views, beside=beside, up=up, seed=seed, progress=progress)
    page, title, offset = folder / "index.html", Path(beside or folder).resolve().name, np.asarray(few.offset)
    if kind == "sog":
        rotation, position = frame.placed(offset)
        placed: dict[str, Any] = {"rotation": rotation, "position": position}
        antialiased = few.antialiased
        return write_stream_page(
            page, title, start=frame.start, antialiased=antialiased, background=background, **placed
        )
    reach = float(np.linalg.norm(np.ptp(few.means, axis=0)))
    start = frame.start or Start((0.0, reach / 4, -reach), (0.0, 0.0, 0.0), (60.0, 45.0))
    eye, target = (
        (TILE_OF_SCENE @ (frame.world(point) - offset)).tolist() for point in (start.position, start.target)
    )
    return write_globe_page(page, title, eye=eye, target=target, fov=max(start.fov))
