"""Scenes, views and results in a notebook: `g2ard.view`, and what cells show of them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from g2ard.arrays import Bytes, Values
from g2ard.config.checks import checks_arguments
from g2ard.config.choices import Colour
from g2ard.errors import InputError
from g2ard.io import Source
from g2ard.io.images import png_bytes, resize
from g2ard.io.photos import load_photo
from g2ard.io.reports import Report
from g2ard.jobs.comparison import is_made_of_points
from g2ard.jobs.inputs import GivenViews, Scene, Views, load_scene
from g2ard.jobs.viewer_frame import choose_backdrop, choose_frame
from g2ard.poses import best_views
from g2ard.progress import Progress, Say, kernel, silent, unsaid
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.sky import seen_on_sky
from g2ard.rendering.targets import Targets
from g2ard.report.labels import RESULT, label_scenes
from g2ard.report.sheet import draw_contact_sheet
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import HasSplats, Splats, scene_of

_SIZE = (480, 360)
"""Width and height in pixels of a scene's picture."""
_TARGETS = 4
"""Targets in a picture."""
_TARGET = 240
"""Longer side of a target in a picture, in pixels."""
_LARGEST = 10_000_000
"""Bytes of a page that a notebook embeds, and that its file then holds, at most."""
_FRAME = 640
"""Height of a page in a cell, pixels."""


@checks_arguments
def view(
    scene: Scene | HasSplats,
    other: Scene | HasSplats | None = None,
    *,
    output: str | Path | None = None,
    views: Views | None = None,
    start: str | None = None,
    up: Sequence[float] | None = None,
    background: Colour | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Any:
    """Show one scene, or two with a divider, on a page with a viewer, like the command `g2ard view`.

    Args:
        scene: the scene, a result, or the path of either.
        other: a second scene to compare with, right of the divider.
        output: the page's file, .html; None writes a temporary one.
        views: cameras to start from, or their path; None looks for some beside a path, or places the start.
        start: name of the view to open with; None takes the one that shows most.
        up: (3,) direction away from the ground; None estimates it.
        background: RGB in [0, 1] behind the scene; None means black, or a soft gradient for a lift.
        overwrite: whether to replace an existing file.
        progress: called while scenes are packed.
        say: called with log messages.

    Returns:
        In a notebook, an `IFrame` of the whole page, for the cell to show, and a line with its size. Pages of
        more than 10 MB are not embedded: a picture and the path. Elsewhere, the page's path.

    Raises:
        InputError: an unreadable scene or views, or a scene too large for a page.
        OutputError: the file exists, cannot be written, or does not end in .html.

    >>> dots = Splats.create([[0, 0, 0], [1, 0, 0]], scales=[[0.1] * 3] * 2)
    >>> view(dots).name
    'view.html'
    """
    given = [scene] if other is None else [scene, other]
    shown = [
        Source(one) if isinstance(one, str | Path) else scene_of(one, name)
        for one, name in zip(given, ("scene", "other"), strict=False)
    ]
    loaded = [load_scene(one, say) for one in shown]
    named = [
        source if isinstance(source, Source) else "scene" if isinstance(one, Splats) else RESULT
        for one, source in zip(given, shown, strict=True)
    ]
    beside = shown[0].file if isinstance(shown[0], Source) else None
    labels = label_scenes(named, [len(splats) for splats in loaded])
    stand = choose_frame(loaded[0], GivenViews(views, beside, up, say=say), start)
    page = Path(mkdtemp(prefix="g2ard-")) / "view.html" if output is None else Path(output)
    stand.write_page(
        page,
        labels,
        loaded,
        background=choose_backdrop(
            background, loaded, of_points=beside is not None and is_made_of_points(beside)
        ),
        overwrite=overwrite,
        progress=progress,
    )
    return _embed_page(page, loaded[0]) if kernel() is not None else page


def write_html(shown: Any) -> str:
    """Return what a notebook shows: a line, and of a report its values, otherwise a picture."""
    try:
        picture = _draw_picture(shown)
    except InputError as error:  # nothing visible, or a photo that moved
        return f"<div>{escape(repr(shown))}<br><small>{escape(str(error))}</small></div>"
    return f"<div>{escape(repr(shown))}<br>{picture}</div>"


def _draw_picture(shown: Any) -> str:
    if isinstance(shown, Report):
        rows = (f"<tr><td>{name}</td><td>{escape(text)}</td></tr>" for name, text in shown.rows())
        return f"<table>{''.join(rows)}</table>"
    if isinstance(shown, Camera):
        if shown.image_path is None:
            return _draw_wedge(shown)
        return _embed(_shrink(load_photo(Cameras.of([shown]), 0)[0]))
    if isinstance(shown, Cameras):
        return " ".join(
            _draw_picture(shown[int(view)]) for view in evenly_spaced(len(shown), _TARGETS)
        )
    held = getattr(shown, "splats", None)
    if held is None and hasattr(shown, "cameras"):
        return _embed(_draw_row(shown))
    scene = scene_of(held[0] if isinstance(held, tuple) else shown)  # the finest of levels
    view = best_views(scene, size=_SIZE)[0]
    drawn = Renderer(scene).render(view)
    lifted = choose_backdrop(None, [scene]) is None
    return _embed(seen_on_sky(drawn) if lifted else np.clip(drawn.image, 0, 1))


def _draw_row(targets: Targets) -> Bytes:
    """Return a few targets in a row, evenly spaced."""
    some = evenly_spaced(len(targets.cameras), _TARGETS)
    names = [targets.cameras.names[view] for view in some]
    return draw_contact_sheet([[_shrink(targets[int(view)]) for view in some]], names)


def _shrink(image: Values) -> Values:
    height, width = image.shape[:2]
    share = min(1.0, _TARGET / max(height, width))
    return resize(image, (max(1, round(width * share)), max(1, round(height * share))))


def _embed(image: Values) -> str:
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(png_bytes(image)).decode()}">'


def _draw_wedge(camera: Camera) -> str:
    """Draw the image's frame and its principal point, in proportion."""
    width = camera.width
    height = camera.height
    x = camera.K[0, 2]
    y = camera.K[1, 2]
    line = max(width, height) / 100
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{_TARGET}" fill="none" stroke="currentColor"'
        f' stroke-width="{line:g}"><rect width="{width}" height="{height}"/>'
        f'<path d="M0 0L{x:g} {y:g}L{width} 0M0 {height}L{x:g} {y:g}L{width} {height}"/></svg>'
    )


def _embed_page(page: Path, scene: Splats) -> Any:
    from IPython.display import HTML, IFrame

    size = page.stat().st_size
    if size > _LARGEST:
        text = f"{page}: {size / 1e6:.1f} MB are too many to embed; open it in a browser"
        return HTML(f"<div>{escape(text)}<br>{_draw_picture(scene)}</div>")
    print(f"{page.name}: {size / 1e6:.1f} MB are embedded in this notebook")
    content = escape(page.read_text(encoding="utf-8"))
    return IFrame("about:blank", "100%", _FRAME, extras=[f'srcdoc="{content}"'])
