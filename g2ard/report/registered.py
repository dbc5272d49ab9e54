"""A registration's report: every photo in a table, and renders laid on the photos they were aligned with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.cameras import Cameras
from g2ard.errors import InputError
from g2ard.images import load_image, to_bytes
from g2ard.progress import plural
from g2ard.report.page import Comparison, Page, Shown
from g2ard.splats import Splats
from g2ard.stages.render import Renderer

__all__ = ["registration_report"]

_VIEWS = 12


def registration_report(
    path: Path,
    title: str,
    scene: Splats,
    photos: Cameras,
    rows: Sequence[Any],
    starts: Mapping[str, NDArray[np.float64]],
    *,
    told: Sequence[str] = (),
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    size: int = 640,
) -> None:
    """Write an HTML page about one registration, the least alike photos first.

    Args:
        path: the file.
        title: of the page.
        scene: that the photos were registered against.
        photos: C views with photos.
        rows: C `PhotoReport`s, in the same order.
        starts: name → (4, 4) camera_from_world, shown beside what was found.
        told: what the command says of the run.
        background: RGB behind the scene.
        size: pixels of the longer side of the pictures.
    """
    page = Page(title, f"{plural(len(photos), 'photo')} against {plural(len(scene), 'Gaussian')}")
    for line in told:
        page.paragraph(line)
    page.table(
        ["photo", "status", "ZNCC", "σ position", "σ rotation, °", "error", "error, °", "why"],
        [_cells(row) for row in rows],
        set(),
    )
    page.heading("Least alike first")
    seen = [i for i, row in enumerate(rows) if row.camera_from_world is not None]
    renderer = Renderer(scene, background=background)
    for i in sorted(seen, key=lambda i: rows[i].zncc)[:_VIEWS]:
        row, one = rows[i], photos.take([i]).resized(size)
        try:
            photo = to_bytes(load_image(one, 0))
        except InputError:
            continue  # gone since it was registered
        found = renderer.image(replace(one[0], viewmat=np.array(row.camera_from_world)))
        shown = [Shown("found", to_bytes(found), f"ZNCC {row.zncc:.2f}")]
        if row.name in starts:
            shown.append(Shown("start", to_bytes(renderer.image(replace(one[0], viewmat=starts[row.name])))))
        page.comparison(Comparison(f"{row.name}: {row.status}", photo, shown))
    page.write(path)


def _cells(row: Any) -> list[str]:
    def number(value: float | None) -> str:
        return "–" if value is None else f"{value:.3g}"

    sigma = (None, None) if row.sigma is None else (row.sigma.position, row.sigma.rotation)
    error = (None, None) if row.error is None else (row.error.position, row.error.rotation)
    figures = [number(value) for value in (row.zncc, *sigma, *error)]
    return [row.name, row.status, *figures, row.reason or ""]
