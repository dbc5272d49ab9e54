"""Report page and preview picture of a distillation."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from statistics import fmean
from types import MappingProxyType

import numpy as np

from g2ard.arrays import Bytes, Float32
from g2ard.config.choices import BLACK, Colour
from g2ard.io.images import to_bytes, write_png
from g2ard.progress import plural
from g2ard.rendering.exposure import rendered
from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.sky import over_sky, seen_on_sky
from g2ard.rendering.targets import Targets, mask_of
from g2ard.report.labels import DENSE, RESULT, TARGET, label_scenes
from g2ard.report.page import Page, Shown
from g2ard.report.run import COLUMNS, LOST, KindScore, RunReport, list_remarks, list_rows
from g2ard.report.sheet import draw_contact_sheet
from g2ard.scene.cameras import Camera, Cameras, rows_by_kind
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import ViewScore

_SHOWN = 3  # worst views of the page, at most
_PICTURE = 1200
"""Least width in pixels of preview.png."""
_UNSCORED = np.float32(0.5)


@dataclass(frozen=True, eq=False)
class Pictures:
    """A view's target and what scenes show there, with their PSNR; pixels that are not scored are grey."""

    name: str
    target: Bytes
    images: list[Bytes]
    psnrs: list[float]


Lit = Callable[[Cameras], Targets]
"""Function that draws the dense scene on white."""


class Drawn:
    """Pictures that a report shows, kept while their views are scored, so that none is rendered again.

    Args:
        best: the views that show most of the scene.
        parts: scored targets, whose worst views are shown.
    """

    def __init__(self, best: Targets, parts: Sequence[Targets]) -> None:
        self.best = best
        self.parts = parts
        self._shown = set(map(_identify, best.cameras))
        self._scored: dict[_Key, str] = {}
        for part in parts:
            self._scored |= {_identify(view): view.kind for view in part.cameras}
        self._worst: dict[str, list[tuple[float, _Key]]] = {
            kind: [] for kind in self._scored.values()
        }
        self._kept: dict[_Key, dict[str, tuple[Bytes, float]]] = {}

    def keep(
        self,
        scene: str,
        targets: Targets,
        view: int,
        score: ViewScore,
        image: Float32,
    ) -> None:
        """Keep a scene's picture and PSNR if the report may show the view; the result is scored first."""
        key = _identify(targets.cameras[view])
        wanted = key in self._shown or key in self._kept
        if scene == RESULT and key in self._scored:
            worst = self._worst[score.kind]
            most = math.ceil(_SHOWN / len(self._worst))
            worst.append((score.psnr, key))
            worst.sort(key=lambda one: one[0])
            gone = {other for _, other in worst[most:]} - self._shown
            del worst[most:]
            self._kept = {other: kept for other, kept in self._kept.items() if other not in gone}
            wanted = key not in gone
        if wanted:
            self._kept.setdefault(key, {})[scene] = (
                to_bytes(grey_unscored(image, targets, view)),
                score.psnr,
            )

    def of(self, targets: Targets, view: int) -> Mapping[str, tuple[Bytes, float]]:
        """Return the picture and PSNR of each scene that is kept of a view."""
        return self._kept.get(_identify(targets.cameras[view]), {})


_Key = tuple[bytes, bytes, int, int]


def _identify(view: Camera) -> _Key:
    """Return what a render depends on; views of other kinds may have the name of a given one."""
    return view.viewmat.tobytes(), view.K.tobytes(), view.width, view.height


def draw_pictures(
    targets: Targets,
    view: int,
    renderers: Mapping[str, Renderer],
    on_white: Lit | None = None,
    drawn: Drawn | None = None,
) -> Pictures:
    """Render a view of targets.

    Args:
        renderers: of the scenes by name.
        on_white: of a dense scene that has holes, behind which pictures show the sky; they are scored on
            black. None leaves the background.
        drawn: pictures that need no render.
    """
    mask = mask_of(targets, view)
    target = targets[view]
    known = {} if drawn is None else drawn.of(targets, view)

    def shown_of(name: str) -> tuple[Bytes, float]:
        if name in known:
            return known[name]
        image = rendered(renderers[name], targets, view)
        return to_bytes(grey_unscored(image, targets, view)), psnr(image, target, mask)

    shown, psnrs = map(list, zip(*map(shown_of, renderers), strict=True))
    if on_white is not None:
        camera = targets.cameras[view]
        light = (on_white(targets.cameras.take([view]))[0] - target).mean(axis=2)
        target = over_sky(target, np.clip(light, 0, 1))
        renders = [seen_on_sky(renderer.render(camera)) for renderer in renderers.values()]
        shown = [to_bytes(grey_unscored(image, targets, view)) for image in renders]
    return Pictures(
        targets.cameras.names[view], to_bytes(grey_unscored(target, targets, view)), shown, psnrs
    )


def create_renderers(
    scenes: Sequence[tuple[str, Splats]], background: Colour = BLACK
) -> dict[str, Renderer]:
    """Return a renderer for each scene by its name."""
    return {name: Renderer(splats, background=background) for name, splats in scenes}


def write_distill_report(
    path: Path,
    title: str,
    renderers: Mapping[str, Renderer],
    drawn: Drawn,
    report: RunReport,
    *,
    best: Pictures,
    on_white: Lit | None = None,
    command: str = "",
    files: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write the HTML page of one run: a verdict, scores by kind of view, and pictures of the view that shows
    most and of the worst ones.

    Args:
        renderers: of the scenes in pictures by name, the result last.
        drawn: its parts are the targets of the held-out views, and of the views of other kinds, if any.
        best: a view that shows most of the scene.
        on_white: see `draw_pictures`.
        command: the command line of the run.
        files: text of links → files of the run, relative to the page; the first is the scene.
    """
    page = Page(title, summarize_run(report))
    if files:
        page.links(files, f"{report.sizes}: ")
    views: list[tuple[Targets, int]] = []
    for part in drawn.parts:
        views += [(part, row) for row in range(len(part.cameras))]
    before = list(report.scores["simplified"].views)
    after = list(report.scores["recovered"].views)
    if report.apart:
        before += report.apart["simplified"].views
        after += report.apart["recovered"].views

    def show(view: Pictures) -> None:
        named = zip(renderers, view.images, view.psnrs, strict=True)
        shown = [Shown(stage, image, f"{score:.2f} dB") for stage, image, score in named]
        height, width = view.target.shape[:2]
        page.comparison(
            f"{view.name}, {width}×{height} px",
            view.target,
            shown[::-1],
        )

    if report.photos:
        source = "a photo"
    else:
        source = f"a photo or a render of the {DENSE}"
    if "photo" not in report.against:
        source = f"a render of the {DENSE}"
    page.heading("A typical view")
    page.paragraph(
        f"Left of the divider: the {TARGET}, {source}. Right: the {RESULT}. Its worst regions are magnified."
    )
    show(best)
    page.heading("Scores")
    page.table(COLUMNS, list_rows(report))
    below = ", below the first row" if report.own_size else ""
    page.paragraph(f"PSNR and SSIM: {report.stages}, in views of {report.size}{below}.")
    if edges := describe_edges(report.kinds):
        page.paragraph(edges)
    for line in list_remarks(report):
        page.paragraph(line, warns=line.startswith("warning"))
    lost = _find_worsened(before, after)
    shown = _choose_worst(after)
    if lost:
        names = ", ".join(text for _, text in lost)
        page.paragraph(f"Views that ended below their start: {names}.")
        most_lost, _ = lost[0]
        if most_lost not in shown:
            shown = [most_lost, *shown][:_SHOWN]
    shown.sort(key=lambda row: after[row].psnr)
    worst = [view for view in shown if after[view].name != best.name]
    if worst:
        page.heading("Worst views")
    for view in worst:
        show(draw_pictures(*views[view], renderers, on_white, drawn))
    page.paragraph(
        f"Made in {report.seconds['total']:,.0f} s. Scored against {report.against} in views that were not "
        f"trained on, which blend {report.overdraw:.1f} Gaussians per pixel."
    )
    if command:
        page.heading("Command")
        page.code([command])
        page.details("settings", [[name, str(value)] for name, value in report.settings.items()])
    if files:
        scene = next(iter(files.values()))
        page.heading("What next")
        photos = not report.lifted or "photo" in report.against
        page.code(line.format(scene) for line in [*_NEXT, *[_ADAPT] * photos])
    page.write(path)


_NEXT = (
    "g2ard distill {} --fit 5MB --format sog -o smaller/    # a smaller file",
    "g2ard lod {} -o streamed/                              # levels of detail that a browser streams",
)
_ADAPT = "g2ard adapt {} --views photos/ -o adapted.ply          # colours of other photos"
"""Commands for a result, and one for all but scans without photos."""


def describe_edges(kinds: Sequence[KindScore]) -> str | None:
    """Return the scores of thin structures, None without them."""
    found = []
    for kind in kinds:
        change = kind.change("edge_psnr")
        if change:
            found.append(f"{kind.kind} {change.before:.2f} → {change.after:.2f} dB")
    if found:
        return f"Edges, wires and text (PSNR of gradients): {', '.join(found)}."
    return None


def summarize_run(report: RunReport) -> str:
    """Summarise a run in one sentence.

    >>> from types import SimpleNamespace
    >>> from g2ard.report.run import Change
    >>> from g2ard.stages.evaluate import Scores
    >>> change = Change(30.0, 36.6)
    >>> kinds = [KindScore("near", 12, Scores(30.0), Scores(36.6), "near_0003", change, 0)]
    >>> made, size = "500 of 5,000 Gaussians", "800×600 px"
    >>> report = SimpleNamespace(kinds=kinds, made=made, size=size, against="photos", own_size=None)
    >>> summarize_run(report)  # doctest: +ELLIPSIS
    '500 of 5,000 Gaussians reproduce the photos at 36.6 dB, the mean of 12 held-out views of 800×600 px; ...'
    """
    kinds = report.kinds
    if "photo" in report.against:
        what = "photos"
    else:
        what = DENSE
    if not kinds:
        return f"{plural(report.output_count, 'Gaussian')}; no held-out view shows the scene."
    weakest = min(kinds, key=lambda kind: kind.psnr.after)
    last = f"the worst view is {weakest.worst} ({weakest.worst_psnr.after:.1f} dB)"
    if len(kinds) > 1:
        last = f"{weakest.kind} views are weakest ({weakest.psnr.after:.1f} dB)"
    views = sum(kind.views for kind in kinds)
    mean = sum(kind.views * kind.psnr.after for kind in kinds) / views
    if views > 1:
        over = f"the mean of {views} held-out views"
    else:
        over = "in one held-out view"
    at = f"{mean:.1f} dB, {over} of {report.size}"
    if report.own_size:
        full = report.own_size["recovered"]
        at = f"{full.psnr:.1f} dB in {full.scored_in}, the views' own size; at {at}"
    return f"{report.made} reproduce the {what} at {at}; {last}."


def _find_worsened(
    before: Sequence[ViewScore], after: Sequence[ViewScore]
) -> list[tuple[int, str]]:
    """Return the views whose PSNR fell by over `LOST`, most first, with a text on each.

    >>> rows = [ViewScore(30.0, name=name) for name in "ab"]
    >>> _find_worsened(rows, [ViewScore(31.0, name="a"), ViewScore(29.0, name="b")])
    [(1, 'b 30.00 → 29.00 dB')]
    """
    found = []
    for row, (old, new) in enumerate(zip(before, after, strict=True)):
        fall = old.psnr - new.psnr
        if fall > LOST:
            found.append((-fall, row, f"{new.name} {old.psnr:.2f} → {new.psnr:.2f} dB"))
    return [(row, text) for _, row, text in sorted(found)]


def _choose_worst(scores: Sequence[ViewScore]) -> list[int]:
    """Return views to show: the worst of each kind in turn, weakest kind first."""
    found = rows_by_kind([view.kind for view in scores])
    kinds = [sorted(rows, key=lambda row: scores[row].psnr) for rows in found.values()]
    kinds.sort(key=lambda rows: fmean(scores[row].psnr for row in rows))
    turns = chain.from_iterable(zip_longest(*kinds))
    worst = [row for row in turns if row is not None]
    return worst[:_SHOWN]


def write_preview(
    path: Path, drawn: Sequence[Pictures], scenes: Sequence[tuple[str, Splats]]
) -> None:
    """Write a PNG with a row for each view: target, then each scene with its PSNR.

    Small images are enlarged, so that the picture is at least 1,200 pixels wide.
    """
    names = [name for name, _ in scenes]
    counts = [len(splats) for _, splats in scenes]
    rows = [[view.target, *view.images] for view in drawn]
    width = sum(image.shape[1] for image in rows[0])
    times = max(1, math.ceil(_PICTURE / width))
    captions = []
    for row, view in enumerate(drawn):
        rows[row] = [image.repeat(times, 0).repeat(times, 1) for image in rows[row]]
        psnrs = [f"{name} {psnr:.2f} dB" for name, psnr in zip(names, view.psnrs, strict=True)]
        captions.append(", ".join([view.name, *psnrs]))
    labels = [TARGET, *label_scenes(names, counts)]
    sheet = draw_contact_sheet(rows, labels, row_labels=captions)
    write_png(path, sheet, overwrite=True)


def grey_unscored(image: Float32, targets: Targets, view: int) -> Float32:
    """Return an image of a view with the pixels that are not scored in grey."""
    mask = mask_of(targets, view)
    if mask is None:
        return image
    return np.where(mask[..., None], image, _UNSCORED)
