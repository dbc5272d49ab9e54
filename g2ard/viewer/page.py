"""Viewer pages: SuperSplat's viewer, scenes and start camera in one HTML file that needs no network.

`supersplat/` holds the published viewer; its README.md tells the version and how to update it.
"""

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from html import escape
from pathlib import Path

import numpy as np

from g2ard._core import __version__
from g2ard.config.choices import BLACK
from g2ard.errors import InputError, OutputError
from g2ard.io.atomic import atomic_output, check_output
from g2ard.io.paths import naming
from g2ard.io.sog_write import sog_bytes
from g2ard.progress import Progress, silent
from g2ard.scene.splats import Splats

_HERE = Path(__file__).parent
_NOTICE = "The viewer on this page is SuperSplat Viewer 1.36.2 with PlayCanvas Engine 2.22.6.\n\n"

_LARGEST_SOG_BYTES = 380_000_000
"""Largest SOG in bytes: browsers limit text to 2²⁹ characters, and base64 needs 4 characters per 3 bytes."""


@dataclass(frozen=True)
class Start:
    """Initial camera of a page, in the viewer's axes: x right, y up, z towards the viewer.

    Args:
        target: centre of rotation, scene units.
        fov: vertical field of view in degrees for windows of rising aspects (width / height); between them,
            its tangent is a power of the aspect.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: tuple[tuple[float, float], ...]


def check_page_output(path: str | Path, overwrite: bool = False) -> Path:
    """Check that a page can be written here, like `g2ard.io.check_output`."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise OutputError("expected a file name that ends in .html", path=path)
    return check_output(path, overwrite)


def write_page(
    path: str | Path,
    scenes: Sequence[tuple[str, Splats]],
    *,
    start: Start | None = None,
    stops: Sequence[tuple[str, Start]] = (),
    background: Sequence[float] | None = BLACK,
    overwrite: bool = False,
    progress: Progress = silent,
) -> tuple[int, tuple[int, ...]]:
    """Write a page that shows one scene, or two with a divider under a shared camera.

    Scenes are embedded, and quantised, as .sog; their `offset` is dropped. Equal scenes give equal bytes.

    Args:
        scenes: (label, scene), one or two, left to right, in the same frame: x right, y down, z ahead.
        start: initial camera; None lets the viewer frame the whole scene.
        stops: (title, camera) of views to step through, by arrows below the scene.
        background: RGB in [0, 1] behind the scenes; None means a soft gradient.

    Returns:
        Bytes of the page, and of each scene as .sog.
    """
    path = check_page_output(path, overwrite)
    packed = [_pack(path, label, splats, progress) for label, splats in scenes]
    shown = {
        "start": None if start is None else asdict(start),
        "stops": [{"title": title, **asdict(stop)} for title, stop in stops],
        "background": _list_channels(background),
        "files": [f"scene{index}.sog" for index in range(len(scenes))],
        "antialiased": [splats.antialiased for _, splats in scenes],
        "placed": None,
    }
    size = _write(path, _fill_page([label for label, _ in scenes], shown, packed), overwrite)
    return size, tuple(map(len, packed))


def room_for_scene(size: int) -> int:
    """Return the bytes of .sog for which the page of a scene has at most `size` bytes.

    >>> room_for_scene(10_000_000) // 1_000_000
    6
    """
    room = (size - len(_fill_page(["?" * 100], {}, []).encode()) - 1000) * 3 // 4
    if room <= 0:
        raise InputError(
            f"{size:,} bytes are too few; the viewer takes {size - room * 4 // 3:,}",
            parameter="fit",
        )
    return room


def write_stream_page(
    path: str | Path,
    title: str,
    *,
    start: Start | None,
    rotation: Sequence[float],
    position: Sequence[float],
    antialiased: bool,
    background: Sequence[float] | None = BLACK,
) -> int:
    """Write a page that streams lod-meta.json from its own folder, and return its bytes.

    Quaternion x y z w and position lead from the files' axes to the viewer's.
    """
    shown = {
        "start": None if start is None else asdict(start),
        "stops": [],
        "background": _list_channels(background),
        "files": ["lod-meta.json"],
        "antialiased": [antialiased],
        "placed": {
            "rotation": [float(q) for q in rotation],
            "position": [float(x) for x in position],
        },
    }
    return _write(Path(path), _fill_page([title], shown, []), overwrite=True)


def write_globe_page(
    path: str | Path,
    title: str,
    *,
    eye: Sequence[float],
    target: Sequence[float],
    fov: Sequence[tuple[float, float]],
    background: Sequence[float] | None = BLACK,
) -> int:
    """Write a page that shows the tileset.json of its own folder with a CesiumJS named in its address.

    The initial camera is in the axes of the tiles, its fields of view as in `Start`.
    """
    view = {
        "eye": [float(x) for x in eye],
        "target": [float(x) for x in target],
        "fov": [[float(aspect), float(degrees)] for aspect, degrees in fov],
        "background": _list_channels(background),
    }
    text = _read_part("globe.html").replace("{fit}", _read_part("fit.js"))
    text = text.replace("{generator}", f"g2ard {__version__}").replace("{title}", escape(title))
    return _write(Path(path), text.replace("{view}", json.dumps(view)), overwrite=True)


def _write(path: Path, text: str, overwrite: bool) -> int:
    with atomic_output(path, overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace", newline="\n")
        return temporary.stat().st_size


def _list_channels(background: Sequence[float] | None) -> list[float] | None:
    return None if background is None else [float(channel) for channel in background]


def _pack(path: Path, label: str, splats: Splats, progress: Progress) -> bytes:
    with naming(path):
        packed = sog_bytes(replace(splats, offset=np.zeros(3)), progress)
    if len(packed) > _LARGEST_SOG_BYTES:
        raise InputError(
            f"{label} has {len(packed) / 1e6:.0f} MB as SOG, but browsers accept at most"
            f" {_LARGEST_SOG_BYTES / 1e6:.0f} in a page; simplify it first",
            path=path,
        )
    return packed


def _write_label(text: str, *, switch: bool) -> str:
    """Return a scene's label; of two scenes, it is a button that shows this one alone."""
    if not switch:
        return f'<p class="label">{escape(text)}</p>'
    title = "Show this scene alone, or both"
    return f'<button type="button" class="label" aria-pressed="false" title="{title}">{escape(text)}</button>'


def _read_part(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _fill_page(labels: Sequence[str], shown: object, packed: Sequence[bytes]) -> str:
    data = (
        f'<script type="text/plain" id="scene{index}">{base64.b64encode(sog).decode()}</script>'
        for index, sog in enumerate(packed)
    )
    return _read_part("page.html").format(
        generator=f"g2ard {__version__}",
        title=escape(" | ".join(labels)),
        notice=_NOTICE + _read_part("supersplat/LICENSE"),
        style=_read_part("supersplat/index.css") + _read_part("page.css"),
        labels="\n".join(_write_label(label, switch=len(labels) > 1) for label in labels),
        view=json.dumps(shown).replace("<", "\\u003c"),
        viewer=base64.b64encode((_HERE / "supersplat/index.js.gz").read_bytes()).decode(),
        scenes="\n".join(data),
        script=_read_part("fit.js") + _read_part("page.js"),
    )
