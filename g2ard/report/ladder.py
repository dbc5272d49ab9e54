"""Page of one scene's results at several sizes: quality against size, pictures, and which size suffices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from g2ard.config.choices import BLACK, Colour
from g2ard.io.images import to_bytes
from g2ard.rendering.exposure import rendered
from g2ard.rendering.renderer import RasterSettings, Renderer
from g2ard.rendering.targets import Targets
from g2ard.report.charts import STYLE, Point, draw_chart, draw_legend
from g2ard.report.distilled import grey_unscored
from g2ard.report.page import Page, Shown
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import Evaluation, ViewScore, evaluate

_VISIBLE = 1.0
"""Loss of detail against the dense scene that is just noticeable, see `metrics.lost_detail`."""
_EQUAL_LOSS = 1.0
"""Loss in dB against the best result that is tolerated where targets are photos, which no scene reaches."""


@dataclass(frozen=True, eq=False)
class Rung:
    """A result of one size.

    Args:
        name: its file.
        label: its size in one word, such as 10×.
        bytes: size of the file.
    """

    name: str
    label: str
    bytes: int
    splats: Splats
    scores: Evaluation

    @property
    def worst(self) -> ViewScore:
        """Score of its worst view: by detail against renders, by PSNR against photos."""
        views = self.scores.views
        if any(view.against == "photo" for view in views):
            return min(views, key=lambda view: view.psnr)
        return max(views, key=lambda view: view.lost)


@dataclass(frozen=True)
class Dense:
    """The scene that the results were made from: its name, Gaussians, and bytes of its file."""

    name: str
    count: int
    bytes: int


def label_sizes(names: Sequence[str], counts: Sequence[int], dense: int | None) -> list[str]:
    """Return a short name for each size: the ratio to the dense scene, the count, or the file's name.

    >>> label_sizes(["a", "b"], [100_000, 33_333], 1_000_000)
    ['10×', '30×']
    >>> label_sizes("abc", [9, 20_000, 1_234_567], None)
    ['9', '20k', '1.23M']
    >>> label_sizes(["a.ply", "a.sog"], [100, 100], 1000)
    ['a.ply', 'a.sog']
    """
    if dense is None:
        found = [_abbreviate(count) for count in counts]
    else:
        found = [f"{dense / count:.3g}×" for count in counts]
    if len(set(found)) < len(found):
        return list(names)
    return found


def _abbreviate(count: int) -> str:
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if count >= size:
            return f"{count / size:.3g}{unit}"
    return str(count)


def recommend_size(rungs: Sequence[Rung]) -> str:
    """Return one sentence on the smallest result that suffices; `rungs` are sorted by size, smallest first.

    Against renders of the dense scene no view may lose detail visibly. Against photos the mean may be 1 dB
    below the best.
    """
    by_photos = any(view.against == "photo" for view in rungs[0].scores.views)
    if by_photos:
        best = max(rung.scores.psnr for rung in rungs)
        enough = [rung for rung in rungs if rung.scores.psnr >= best - _EQUAL_LOSS]
    else:
        enough = [rung for rung in rungs if rung.worst.lost < _VISIBLE]
    if not enough:
        largest = rungs[-1]
        return (
            f"every size loses detail visibly, {largest.label} most in {largest.worst.name}; "
            "keep more Gaussians, or recover them with distill"
        )
    found = enough[0]
    if by_photos:
        text = f"{found.label} is the smallest within {_EQUAL_LOSS:.0f} dB of the best: "
        text += f"{found.scores.psnr:.1f} dB against the photos"
    else:
        text = f"{found.label} is the smallest without a visible loss of detail"
    return text + ("; fewer Gaussians may do" if found is rungs[0] else "")


def write_ladder(
    path: Path,
    title: str,
    rungs: Sequence[Rung],
    targets: Targets,
    best: Targets,
    *,
    dense: Dense | None,
    background: Colour = BLACK,
    settings: RasterSettings | None = None,
    overwrite: bool = False,
) -> None:
    """Write the HTML page.

    Args:
        rungs: the results, smallest first.
        targets: photos or teacher renders that they are scored against.
        best: targets whose first view shows most of the scene.
        dense: the scene that they were made from; None without one.
    """
    advice = recommend_size(rungs)
    page = Page(title, f"{advice[0].upper()}{advice[1:]}.")
    page.html(STYLE)
    page.html(f'<div class="row"><figure>{_draw_plot(rungs)}</figure></div>')
    page.html(draw_legend(["mean", "worst view"]))
    page.table(_COLUMNS, _list_rows(rungs, dense))
    page.paragraph(
        f"Scored in {rungs[0].scores.scored_in}. Detail lost: contrast that the worst regions "
        f"of a view lack; people see it from {_VISIBLE:.0f} on."
    )
    renderers = [Renderer(rung.splats, background=background, settings=settings) for rung in rungs]
    score = partial(evaluate, targets=best, background=background, settings=settings)

    def show(
        title: str,
        part: Targets,
        row: int,
        psnrs: Sequence[float],
    ) -> None:
        shown = [
            Shown(
                rung.label,
                to_bytes(grey_unscored(rendered(renderer, part, row), part, row)),
                f"{psnr:.2f} dB",
            )
            for rung, renderer, psnr in zip(rungs, renderers, psnrs, strict=True)
        ]
        page.comparison(title, to_bytes(grey_unscored(part[row], part, row)), shown)

    page.heading("The same view")
    show(
        best.cameras.names[0],
        best,
        0,
        [score(rung.splats).views[0].psnr for rung in rungs],
    )
    page.heading("The worst view of each size")
    for name in dict.fromkeys(rung.worst.name for rung in rungs):
        row = targets.cameras.names.index(name)
        of = ", ".join(rung.label for rung in rungs if rung.worst.name == name)
        show(
            f"{name}, worst of {of}", targets, row, [rung.scores.views[row].psnr for rung in rungs]
        )
    page.write(path, overwrite)


_COLUMNS = ("scene", "size", "Gaussians", "MB", "PSNR, dB", "worst view", "detail lost", "SSIM")


def _list_rows(rungs: Sequence[Rung], dense: Dense | None) -> list[list[str]]:
    if dense is None:
        top = []
    else:
        top = [[dense.name, "1×", f"{dense.count:,}", _format_megabytes(dense.bytes), *[""] * 4]]
    return top + [
        [
            rung.name,
            rung.label,
            f"{rung.scores.count:,}",
            _format_megabytes(rung.bytes),
            f"{rung.scores.psnr:.2f}",
            f"{rung.worst.name} {rung.worst.psnr:.2f}",
            f"{rung.worst.lost:.2f}",
            f"{rung.scores.ssim:.4f}",
        ]
        for rung in reversed(rungs)
    ]


def _format_megabytes(size: int) -> str:
    return f"{size / 1e6:.2f}"


def _draw_plot(rungs: Sequence[Rung]) -> str:
    """Draw mean and worst PSNR against size."""
    points = []
    for rung in rungs:
        for series, psnr in enumerate((rung.scores.psnr, rung.worst.psnr)):
            text = f"{rung.name}: {psnr:.2f} dB, {_format_megabytes(rung.bytes)} MB"
            points.append(Point(rung.bytes / 1e6, psnr, series, text=text, label=rung.label))
    return draw_chart(points, x_label="MB", y_label="PSNR, dB", log=True, joined=True)
