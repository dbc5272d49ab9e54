"""HTML page with style and script; each image is stored once and can be shown several times."""

import base64
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from urllib.parse import quote

import numpy as np

from g2ard.arrays import Bytes
from g2ard.io.atomic import atomic_output
from g2ard.io.images import to_bytes
from g2ard.report.labels import TARGET

_WINDOW = 0.28
"""Side of an automatic crop as a share of the image's."""
_CROPS = 2
"""Number of automatic crops."""
_LONGEST = 1280
_QUALITY = 86
_HERE = Path(__file__).parent


@dataclass(frozen=True, eq=False)
class Shown:
    """One rendering of a view: its method, image and caption."""

    name: str
    image: Bytes
    caption: str = ""


Window = tuple[float, float, float, float]
"""Left, top, width and height of a rectangle of an image, as fractions of its width and height."""


def slice_window(window: Window, height: int, width: int) -> tuple[slice, slice]:
    """Return the rows and columns of a window in an image of that size, at least one of each.

    >>> slice_window((0.25, 0.5, 0.25, 0.25), 100, 200)
    (slice(50, 75, None), slice(50, 100, None))
    """
    left, top, across, down = window
    return _slice_span(top, down, height), _slice_span(left, across, width)


def _slice_span(start: float, extent: float, size: int) -> slice:
    first = min(int(start * size + 1e-6), size - 1)
    last = min(size, round((start + extent) * size))
    return slice(first, max(first + 1, last))


def find_worst_windows(image: Bytes, target: Bytes) -> list[Window]:
    """Return the windows with the largest error, worst first, in shares of the image's size."""
    error = ((image.astype(np.float64) - target) ** 2).sum(-1)
    height, width = error.shape
    rows = max(1, int(_WINDOW * height))
    columns = max(1, int(_WINDOW * width))
    total = np.pad(error, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    sums = total[rows:, columns:] - total[:-rows, columns:]
    sums -= total[rows:, :-columns]
    sums += total[:-rows, :-columns]
    found: list[Window] = []
    while len(found) < _CROPS and sums.max() >= 0:
        top, left = divmod(int(np.argmax(sums)), sums.shape[1])
        window = (
            left / width,
            top / height,
            columns / width,
            rows / height,
        )
        found.append(window)
        # No later window may overlap this one.
        above = max(0, top - rows + 1)
        before = max(0, left - columns + 1)
        sums[above : top + rows, before : left + columns] = -1
    return found


class Page:
    """An HTML page built section by section and written atomically."""

    def __init__(self, title: str, lead: str = "") -> None:
        self._title = title
        self._parts = [f"<h1>{escape(title)}</h1>", f'<p class="lead">{escape(lead)}</p>']
        self._images: list[str] = []

    def html(self, text: str) -> None:
        """Add markup unescaped."""
        self._parts.append(text)

    def heading(self, text: str, level: int = 2) -> None:
        self._parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def paragraph(self, text: str, *, warns: bool = False) -> None:
        kind = ' class="warns"' * warns
        self._parts.append(f"<p{kind}>{escape(text)}</p>")

    def links(self, files: Mapping[str, str], text: str = "") -> None:
        """Add a line of links to files beside the page, by their texts."""
        links = (
            f'<a href="{escape(quote(file))}">{escape(name)}</a>' for name, file in files.items()
        )
        self._parts.append(f"<p>{escape(text)}{', '.join(links)}</p>")

    def code(self, lines: Iterable[str]) -> None:
        """Add lines of code."""
        text = escape("\n".join(lines))
        self._parts.append(f'<div class="scroll"><pre>{text}</pre></div>')

    def details(self, title: str, rows: Sequence[Sequence[str]]) -> None:
        """Add a table of two columns that opens on a click."""
        self._parts.append(f"<details><summary>{escape(title)}</summary>")
        self.table(("name", "value"), rows)
        self._parts.append("</details>")

    def table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[str]],
        best: Collection[tuple[int, int]] = (),
    ) -> None:
        """Add a table; cells (row, column) in `best` are bold."""
        head = "".join(f"<th>{escape(name)}</th>" for name in columns)
        body = []
        mark = ' class="best"'
        for i, row in enumerate(rows):
            cells = ""
            for j, (name, cell) in enumerate(zip(columns, row, strict=True)):
                if (i, j) in best:
                    bold = mark
                else:
                    bold = ""
                cells += f'<td data-column="{escape(name)}"{bold}>{escape(cell)}</td>'
            body.append(f"<tr>{cells}</tr>")
        self._parts.append(
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{''.join(body)}</tbody></table></div>"
        )

    def figure(self, image: Bytes, caption: str) -> None:
        number = self._image(image)
        text = escape(caption)
        self._parts.append(
            f'<figure class="wide"><img data-i="{number}" alt="{text}">'
            f"<figcaption>{text}</figcaption></figure>"
        )

    def comparison(
        self,
        title: str,
        target: Bytes,
        shown: Sequence[Shown],
        name: str = TARGET,
    ) -> None:
        """Add a view: a slider between the target, with a `name`, and any rendering, and magnified crops.

        The first rendering is shown initially, and its worst regions are magnified. Crops keep the resolution
        of the given images; whole images are shrunk.
        """
        number = self._image(target)
        numbers = [self._image(one.image) for one in shown]
        windows = find_worst_windows(shown[0].image, target)
        height, width = target.shape[:2]
        options = "".join(
            f'<option value="{n}">{escape(s.name)} {escape(s.caption)}</option>'
            for n, s in zip(numbers, shown, strict=True)
        )
        named = [Shown(name, target), *shown]
        marks = ""
        crops = ""
        for k, window in enumerate(windows):
            left, top, across, down = window
            place = f"left:{left:.2%};top:{top:.2%};width:{across:.2%};height:{down:.2%}"
            marks += f'<i class="roi r{k % 2}" style="{place}"></i>'
            parts = "".join(self._crop(one, window) for one in named)
            crops += f'<div class="crops r{k % 2}">{parts}</div>'
        self._parts.append(
            f'<section class="view"><h4>{escape(title)}</h4>'
            f'<div class="pair" style="width:calc(85vh*{width / height:.4f})">'
            f'<div class="slider" style="aspect-ratio:{width}/{height}">'
            f'<img data-i="{number}" alt="{name}"><img class="over" data-i="{numbers[0]}" alt="rendering">'
            f'{marks}<span class="tag left">{name}</span><span class="tag right"></span>'
            f'<input type="range" min="0" max="100" value="50" aria-label="{name} or rendering"></div>'
            f'<label class="pick">right: <select>{options}</select></label></div>'
            f'<div class="parts">{crops}</div></section>'
        )

    def _crop(self, shown: Shown, window: Window) -> str:
        rows, columns = slice_window(window, *shown.image.shape[:2])
        crop = shown.image[rows, columns]
        number = self._image(crop)
        ratio = crop.shape[1] / crop.shape[0]
        return (
            f'<figure class="crop" style="max-width:min(300px,38vh*{ratio:.4f})">'
            f'<img data-i="{number}" alt="{escape(shown.name)}">'
            f"<figcaption>{escape(shown.name)}</figcaption></figure>"
        )

    def _image(self, image: Bytes) -> int:
        from PIL import Image

        picture = Image.fromarray(to_bytes(image))
        picture.thumbnail((_LONGEST, _LONGEST))
        buffer = BytesIO()
        picture.save(buffer, "JPEG", quality=_QUALITY)
        self._images.append(base64.b64encode(buffer.getvalue()).decode())
        return len(self._images) - 1

    def text(self) -> str:
        """Return the HTML of the page."""
        images = json.dumps(self._images)
        style, script = (
            (_HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js")
        )
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<title>{escape(self._title)}</title><style>\n{style}</style></head><body><main>"
            f"{''.join(self._parts)}</main>"
            f'<script type="application/json" id="images">{images}</script>'
            f"<script>\n{script}</script></body></html>\n"
        )

    def write(self, path: Path, overwrite: bool = True) -> None:
        """Write the page atomically."""
        with atomic_output(path, overwrite) as temporary:
            temporary.write_text(self.text(), encoding="utf-8", errors="replace", newline="\n")
