"""Reports of a distillation, as its folder keeps them in report.json, and scores by kind of view."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from g2ard.io.reports import LEFT_OUT, Report
from g2ard.progress import plural
from g2ard.rendering.metrics import METRICS
from g2ard.report.labels import RESULT
from g2ard.scene.cameras import USUAL, rows_by_kind
from g2ard.stages.evaluate import Evaluation, Means, Scores, ViewScore
from g2ard.stages.recover.anchors import PriorMeasures
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.simplify.reduce import SimplifyReport

LOST = 0.05
"""Loss of a view in dB that counts."""


@dataclass(frozen=True)
class Change(Report):
    """A score of the simplified and of the recovered scene."""

    before: float
    after: float

    @property
    def gain(self) -> float:
        """Return the score that recovery gained."""
        return self.after - self.before


@dataclass(frozen=True)
class KindScore(Report):
    """Scores in the views of one kind, none of them used for training.

    Args:
        kind: near, standing, anywhere or another kind that views state; otherwise `usual` for generated
            views and `given` for the user's.
        before: mean scores of the simplified scene.
        after: those of the recovered one.
        worst: name of the view with the lowest PSNR after recovery.
        worst_psnr: PSNR of that view, dB.
        lost: number of views that lost over 0.05 dB.
    """

    kind: str
    views: int
    before: Scores
    after: Scores
    worst: str
    worst_psnr: Change
    lost: int

    @property
    def psnr(self) -> Change:
        """Mean PSNR, dB."""
        return Change(self.before.psnr, self.after.psnr)

    def change(self, score: str) -> Change | None:
        """Return a mean score of both scenes; None if it was not measured."""
        before, after = (scores.scores[score] for scores in (self.before, self.after))
        return None if math.isnan(after) else Change(before, after)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values, with one change per score."""
        own = {name: value for name, value in super().as_dict().items() if name not in ("before", "after")}
        changes = {name: self.change(name) for name in self.after.scores}
        return own | {name: change and change.as_dict() for name, change in changes.items()}


def summarize_by_kind(
    before: Sequence[ViewScore], after: Sequence[ViewScore], usual: str = USUAL
) -> tuple[KindScore, ...]:
    """Summarise scores of views before and after recovery by kind of view; `usual` names the usual kind.

    >>> before, after = (ViewScore(psnr, name="near_0000", kind="near") for psnr in (30.0, 31.0))
    >>> found, = summarize_by_kind([before], [after])
    >>> found.kind, found.psnr.gain, found.change("ssim"), found.worst
    ('near', 1.0, None, 'near_0000')
    """
    summaries = []
    for kind, rows in rows_by_kind([view.kind for view in after]).items():
        changes = [Change(before[row].psnr, after[row].psnr) for row in rows]
        worst = min(range(len(rows)), key=lambda i: changes[i].after)
        summaries.append(
            KindScore(
                usual if kind == USUAL else kind,
                len(rows),
                Scores.mean([before[row] for row in rows], fmean),
                Scores.mean([after[row] for row in rows], fmean),
                after[rows[worst]].name,
                changes[worst],
                sum(change.gain < -LOST for change in changes),
            )
        )
    return tuple(summaries)


COLUMNS = ("kind of view", "views", "PSNR, dB", "worst", "detail", "SSIM")


def list_cells(kinds: Iterable[KindScore]) -> list[list[str]]:
    """Return the rows of a table with `COLUMNS`."""
    return [
        [kind.kind, str(kind.views), *_list_scores(kind.before, kind.after, f"{kind.worst_psnr.after:.2f}")]
        for kind in kinds
    ]


def _list_scores(before: Scores, after: Scores, worst: str) -> list[str]:
    """Return the cells of `COLUMNS` from PSNR on."""
    psnr, detail, ssim = (
        "–"
        if math.isnan(after.scores[name])
        else " → ".join(f"{scores.scores[name]:.{METRICS[name].digits}f}" for scores in (before, after))
        for name in ("psnr", "detail", "ssim")
    )
    return [psnr, worst, detail, ssim]


def list_rows(report: RunReport) -> list[list[str]]:
    """Return the rows of a run's table, the views' own size first if another one was requested."""
    if report.own_size is None:
        return list_cells(report.kinds)
    before, after = (report.own_size[name] for name in ("simplified", "recovered"))
    first = ["full size", after.scored_in.split()[0], *_list_scores(before, after, "–")]
    return [first, *list_cells(report.kinds)]


def describe_sizes(report: RunReport) -> str:
    """Return the size of a run's held-out views, and their own if another one was requested."""
    if report.own_size is None:
        return report.size
    full = report.own_size["recovered"].scored_in.rpartition(", ")[2]
    return f"{report.size} (full size: {full})"


@dataclass(frozen=True)
class ViewsReport(Report):
    """Report of the view selection.

    Args:
        chosen: names of the chosen views, best first.
        refused: names of views that see nothing of the scene or lie inside geometry.
        left_out: share of the whole pool's objective that the remaining views would add.
    """

    policy: str
    candidates: int
    chosen: list[str]
    weighted: bool
    refused: list[str]
    left_out: float


@dataclass(frozen=True)
class RoundReport(Report):
    """Report of a round: simplification, and its recoveries if there are any."""

    count: int
    simplify: SimplifyReport
    recover: tuple[RecoverReport, ...] = ()


@dataclass(frozen=True)
class StageSeconds(Report):
    """Wall seconds of each stage.

    Args:
        targets: rendering of training images.
        resumed: part of these spent by earlier, interrupted calls; None if there were none.
    """

    targets: float
    select: float
    simplify: float
    recover: float
    resumed: float | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True)
class DistillReport(Report):
    """Report of a distillation. `views` holds its selection of views, or None."""

    rounds: tuple[RoundReport, ...]
    seconds: StageSeconds
    views: ViewsReport | None


@dataclass(frozen=True)
class Packed(Report):
    """Mean scores of a scene as read back from its file."""

    file: str
    psnr: float
    ssim: float


@dataclass(frozen=True)
class RunReport(Report):
    """Report of a run.

    Args:
        lifted: whether the scene was lifted from points.
        photos: number of photos of a start from photos alone.
        cleaned: Gaussians removed by kind of clutter; None without cleaning.
        bytes: of the `input` and the `output` as .ply, and of the `file` and the `view` page as written.
        scores: in held-out views, of the `simplified` and of the `recovered` scene.
        apart: the same in views of other kinds, or None.
        size: image size of these views.
        own_size: means at the views' own size if a requested one shrank them, or None.
        unseen: share of the scene that no view sees; None for the paper's method.
        warnings: views that do not show what the scene resolves, and regions that lost too much.
        opacity_lost: share of the light of opaque pixels that the result lets through; None for points from
            photos.
        overdraw: Gaussians per pixel.
        preset: the regularisers chosen, and why; `prior` are the measures that chose them.
        settings: every setting by path.
        seconds: by stage.
        packed: scores of a file that is not .ply.
        tiles: number of tiles of a dense scene in tiles; `peak_rss_bytes` is then that of all processes.
    """

    input_count: int
    output_count: int
    lifted: bool
    photos: int | None
    cleaned: dict[str, int] | None
    bytes: dict[str, int | None]
    scores: dict[str, Evaluation]
    apart: dict[str, Evaluation] | None
    size: str
    own_size: dict[str, Means] | None
    kinds: tuple[KindScore, ...]
    unseen: float | None
    warnings: tuple[str, ...]
    opacity_lost: float | None
    overdraw: float
    against: str
    preset: str
    prior: PriorMeasures
    rounds: tuple[RoundReport, ...]
    views: ViewsReport | None
    settings: dict[str, Any]
    seconds: dict[str, float]
    packed: Packed | None = field(default=None, metadata=LEFT_OUT)
    tiles: int | None = field(default=None, metadata=LEFT_OUT)
    peak_rss_bytes: int | None = field(default=None, metadata=LEFT_OUT)

    @property
    def sizes(self) -> str:
        """Sizes of the dense scene, except points found in photos, and of the result."""
        before, output, file = ((self.bytes[name] or 0) / 1e6 for name in ("input", "output", "file"))
        start = "" if self.photos else f"{before:.2f} → "
        if self.packed is None:
            return f"{start}{file or output:.2f} MB as .ply"
        start = start.replace(" → ", " MB as .ply → ")
        return f"{start}{file:.2f} MB as .{self.packed.file.partition('.')[2]}"

    @property
    def stages(self) -> str:
        """Names of the scenes that are scored before and after."""
        return f"{'start' if self.photos else 'simplified'} → {RESULT}"

    @property
    def title(self) -> str:
        """Numbers before and after."""
        return f"{self.source} → {plural(self.output_count, 'Gaussian')}"

    @property
    def source(self) -> str:
        """Number of photos, points or Gaussians that the result was made from."""
        if self.photos:
            return plural(self.photos, "photo")
        if self.lifted:
            return plural(self.input_count, "point")
        return f"{self.input_count:,}"

    @property
    def made(self) -> str:
        """Number of Gaussians of the result, and what it was made from."""
        if self.photos or self.lifted:
            return f"{plural(self.output_count, 'Gaussian')} from {self.source}"
        return f"{self.output_count:,} of {plural(self.input_count, 'Gaussian')}"
