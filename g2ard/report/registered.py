"""Report of a registration: a table of all photos, and renders compared with the photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from g2ard.arrays import Bytes, Float
from g2ard.config.choices import Colour
from g2ard.errors import InputError
from g2ard.io.images import to_bytes
from g2ard.io.photos import load_photo
from g2ard.progress import plural
from g2ard.rendering.renderer import Renderer
from g2ard.report.page import Page, Shown
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.register.report import PhotoReport, Registered

_VIEWS = 12
"""Number of photos shown."""
_SIZE = 640
"""Longer side of their images in pixels."""
_LINES = 80  # matches drawn per photo


def write_registration_report(
    path: Path,
    title: str,
    scene: Splats,
    cameras: Cameras,
    found: Registered,
    starts: Mapping[str, Float],
    side: int,
    told: str,
    background: Colour,
    overwrite: bool = False,
) -> None:
    """Write the HTML page of a registration, least similar photos first.

    Args:
        found: the registration of all photos, in the same order.
        starts: name → (4, 4) camera_from_world, shown beside the result.
        side: longer side in pixels of the images that its matches refer to.
        told: summary that the command prints.
    """
    page = Page(title, f"{plural(len(cameras), 'photo')} against {plural(len(scene), 'Gaussian')}")
    page.paragraph(told)
    columns = ["photo", "status", "ZNCC", "σ position", "σ rotation, °", "why"]
    table = [columns, *map(_list_cells, found.report.photos)]
    told_of = [column for column in zip(*table, strict=True) if any(column[1:])]
    names, *cells = zip(*told_of, strict=True)
    page.table(names, cells)
    page.heading("Least alike first")
    seen = [
        (i, row) for i, row in enumerate(found.report.photos) if row.camera_from_world is not None
    ]
    seen.sort(key=lambda one: -1.0 if one[1].zncc is None else one[1].zncc)
    renderer = Renderer(scene, background=background)
    for i, row in seen[:_VIEWS]:
        one = cameras.take([i]).resized(_SIZE)
        try:
            photo = to_bytes(load_photo(one, 0, background)[0])
        except InputError:
            continue  # deleted since it was registered
        view = replace(one[0], viewmat=np.array(row.camera_from_world))
        render = to_bytes(renderer.image(view))
        if row.zncc is None:
            alike = "kept at its start"
        else:
            alike = f"ZNCC {row.zncc:.2f}"
        shown = [Shown("render", render, alike)]
        if row.name in starts:
            start = renderer.image(replace(one[0], viewmat=starts[row.name]))
            shown.append(Shown("start", to_bytes(start)))
        page.comparison(f"{row.name}: {row.status}", photo, shown, "photo")
        matches = found.matches.get(row.name)
        if matches is not None:
            scale = photo.shape[1] / cameras.take([i]).resized(side)[0].width
            drawn = _draw_matches(photo, render, matches * scale)
            count = plural(len(matches), "match", "matches")
            page.figure(drawn, f"{count} explained by the pose; at most {_LINES} are drawn")
    page.write(path, overwrite)


def _draw_matches(photo: Bytes, render: Bytes, matches: Float) -> Bytes:
    """Draw photo and render side by side, with a line for each match, (M, 4) pixels u, v of both."""
    from PIL import Image, ImageDraw

    pair = Image.fromarray(np.concatenate([photo, render], 1))
    pen = ImageDraw.Draw(pair)
    width = photo.shape[1]
    every = max(1, -(-len(matches) // _LINES))
    for k, (u, v, u_seen, v_seen) in enumerate(matches[::every].tolist()):
        # steps of the golden angle, so neighbours differ
        colour = f"hsl({137 * k % 360}, 90%, 55%)"
        pen.line((u, v, width + u_seen, v_seen), fill=colour)
        for x, y in ((u, v), (width + u_seen, v_seen)):
            pen.ellipse((x - 2, y - 2, x + 2, y + 2), outline=colour)
    return np.asarray(pair)


def _list_cells(row: PhotoReport) -> list[str]:
    def number(value: float | None) -> str:
        return "" if value is None else f"{value:.3g}"

    sigma = (None, None) if row.sigma is None else (row.sigma.position, row.sigma.rotation)
    figures = [number(value) for value in (row.zncc, *sigma)]
    return [row.name, row.status, *figures, row.reason or ""]
