"""Report page and preview picture of a distillation."""

from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import BLACK, Colour
from g2ard.io.images import to_bytes, write_png
from g2ard.io.labels import DENSE, RESULT, TARGET, labels_of
from g2ard.progress import plural
from g2ard.rendering.exposure import rendered
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Targets, mask_of
from g2ard.report.page import Page, Shown
from g2ard.report.run import COLUMNS, LOST, KindScore, RunReport, cells
from g2ard.report.sheet import contact_sheet
from g2ard.scene.cameras import rows_by_kind
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import ViewScore, evaluate

_SHOWN = 3  # worst views of the page, at most
_UNSCORED = np.float32(0.5)


def distill_report(
    path: Path,
    title: str,
    scenes: Sequence[tuple[str, Splats]],
    targets: Sequence[Targets],
    report: RunReport,
    background: Colour = BLACK,
    told: Sequence[str] = (),
    *,
    best: Targets,
) -> None:
    """Write the HTML page of one run: a verdict, scores by kind of view, and pictures of the view that shows
    most and of the worst ones.

    Args:
        scenes: (name, scene) of those in pictures, the result last.
        targets: photos or teacher renders of the held-out views, and of the views of other kinds, if any.
        told: summary lines that the command prints.
        best: targets whose first view shows most of the scene.
    """
    page = Page(title, verdict(report))
    views = [(part, row) for part in targets for row in range(len(part.cameras))]
    parts = [part for part in (report.scores, report.apart) if part]
    scores = {name: [view for part in parts for view in part[name].views] for name in report.scores}
    before, after = scores["simplified"], scores["recovered"]
    scores[RESULT] = after
    renderers = [(name, Renderer(splats, background=background)) for name, splats in reversed(scenes)]

    def show(part: Targets, row: int, psnrs: Sequence[float]) -> None:
        camera = part.cameras[row]
        shown = [
            Shown(stage, to_bytes(scored(rendered(renderer, part, row), part, row)), f"{psnr:.2f} dB")
            for (stage, renderer), psnr in zip(renderers, psnrs, strict=True)
        ]
        title = f"{part.cameras.names[row]}, {camera.width}×{camera.height} px"
        page.comparison(title, to_bytes(scored(part[row], part, row)), shown)

    source = "a photo" if report.photos else f"a photo or a render of the {DENSE}"
    if "photo" not in report.against:
        source = f"a render of the {DENSE}"
    page.heading("A typical view")
    page.paragraph(
        f"Left of the divider: the {TARGET}, {source}. Right: the {RESULT}. Its worst regions are magnified."
    )
    whole = [evaluate(splats, best, background=background).views[0].psnr for _, splats in reversed(scenes)]
    show(best, 0, whole)
    page.heading("Scores")
    page.table(COLUMNS, cells(report.kinds))
    page.paragraph(f"PSNR and SSIM: {report.stages}, in views of {report.size}.")
    if edges := edges_line(report.kinds):
        page.paragraph(edges)
    for line in told:
        page.paragraph(line, warns=line.startswith("warning"))
    lost = _below_start(before, after)
    if lost:
        page.paragraph(f"Views that ended below their start: {', '.join(text for _, text in lost)}.")
    shown = list(dict.fromkeys([*(row for row, _ in lost[:1]), *_worst(after)]))[:_SHOWN]
    shown.sort(key=lambda row: after[row].psnr)
    worst = [view for view in shown if after[view].name != best.cameras.names[0]]
    if worst:
        page.heading("Worst views")
    for view in worst:
        show(*views[view], [scores[stage][view].psnr for stage, _ in renderers])
    page.paragraph(
        f"{report.sizes}, in {report.seconds['total']:,.0f} s. "
        f"Scored against {report.against} in views that were not trained on, "
        f"which blend {report.overdraw:.1f} Gaussians per pixel."
    )
    page.write(path)


def edges_line(kinds: Sequence[KindScore]) -> str | None:
    """Return the scores of thin structures, None without them."""
    found = [
        f"{kind.kind} {kind.edge_psnr.before:.2f} → {kind.edge_psnr.after:.2f} dB"
        for kind in kinds
        if kind.edge_psnr
    ]
    return f"Edges, wires and text (PSNR of gradients): {', '.join(found)}." if found else None


def verdict(report: RunReport) -> str:
    """Summarise a run in one sentence.

    >>> from types import SimpleNamespace
    >>> from g2ard.report.run import Change
    >>> change = Change(30.0, 36.6)
    >>> kinds = [KindScore("near", 12, change, change, "near_0003", change, 0)]
    >>> made, size = "500 of 5,000 Gaussians", "800×600 px"
    >>> report = SimpleNamespace(kinds=kinds, made=made, size=size, against="photos", own_size=None)
    >>> verdict(report)  # doctest: +ELLIPSIS
    '500 of 5,000 Gaussians reproduce the photos at 36.6 dB, the mean of 12 held-out views of 800×600 px; ...'
    """
    kinds = report.kinds
    what = "photos" if "photo" in report.against else DENSE
    if not kinds:
        return f"{plural(report.output_count, 'Gaussian')}; no held-out view shows the scene."
    weakest = min(kinds, key=lambda kind: kind.psnr.after)
    last = f"the worst view is {weakest.worst} ({weakest.worst_psnr.after:.1f} dB)"
    if len(kinds) > 1:
        last = f"{weakest.kind} views are weakest ({weakest.psnr.after:.1f} dB)"
    views = sum(kind.views for kind in kinds)
    mean = sum(kind.views * kind.psnr.after for kind in kinds) / views
    over = f"the mean of {views} held-out views" if views > 1 else "in one held-out view"
    at = f"{mean:.1f} dB, {over} of {report.size}"
    if report.own_size:
        full = report.own_size["recovered"]
        at = f"{full.psnr:.1f} dB in {full.scored_in}, the views' own size; at {at}"
    return f"{report.made} reproduce the {what} at {at}; {last}."


def _below_start(before: Sequence[ViewScore], after: Sequence[ViewScore]) -> list[tuple[int, str]]:
    """Return the views whose PSNR fell by over `LOST`, most first, with a text on each.

    >>> rows = [ViewScore(name, 30.0) for name in "ab"]
    >>> _below_start(rows, [ViewScore("a", 31.0), ViewScore("b", 29.0)])
    [(1, 'b 30.00 → 29.00 dB')]
    """
    falls = [old.psnr - new.psnr for old, new in zip(before, after, strict=True)]
    rows = sorted((row for row, fall in enumerate(falls) if fall > LOST), key=lambda row: -falls[row])
    texts = [f"{after[i].name} {before[i].psnr:.2f} → {after[i].psnr:.2f} dB" for i in rows]
    return list(zip(rows, texts, strict=True))


def _worst(scores: Sequence[ViewScore]) -> list[int]:
    """Return views to show: the worst of each kind in turn, weakest kind first."""
    found = rows_by_kind([view.kind for view in scores])
    kinds = [sorted(rows, key=lambda row: scores[row].psnr) for rows in found.values()]
    kinds.sort(key=lambda rows: fmean(scores[row].psnr for row in rows))
    return [row for turn in zip_longest(*kinds) for row in turn if row is not None][:_SHOWN]


def preview(
    path: Path, targets: Targets, scenes: list[tuple[str, Splats]], background: Colour = BLACK
) -> None:
    """Write a PNG with a row for each view: target, then each scene with its PSNR.

    Pixels that are not scored are grey in all of them.
    """
    cameras = targets.cameras
    renderers = [Renderer(splats, background=background) for _, splats in scenes]
    scores = [evaluate(splats, targets, background=background).views for _, splats in scenes]
    rows = [
        [
            scored(image, targets, view)
            for image in (targets[view], *(rendered(r, targets, view) for r in renderers))
        ]
        for view in range(len(cameras))
    ]
    captions = [
        ", ".join(
            [view[0].name, *(f"{name} {v.psnr:.2f} dB" for (name, _), v in zip(scenes, view, strict=True))]
        )
        for view in zip(*scores, strict=True)
    ]
    labels = [TARGET, *labels_of([name for name, _ in scenes], [len(splats) for _, splats in scenes])]
    write_png(path, contact_sheet(rows, labels, row_labels=captions), overwrite=True)


def scored(image: NDArray[np.float32], targets: Targets, view: int) -> NDArray[np.float32]:
    """Return an image of a view with the pixels that are not scored in grey."""
    mask = mask_of(targets, view)
    return image if mask is None else np.where(mask[..., None], image, _UNSCORED)
