"""Reports of a distillation, as its folder keeps them in report.json, and scores by kind of view."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from statistics import fmean
from typing import Any

from g2ard.io.reports import LEFT_OUT, Report
from g2ard.io.scene_formats import scene_format
from g2ard.progress import plural
from g2ard.rendering.metrics import METRICS
from g2ard.report.labels import RESULT
from g2ard.scene.cameras import USUAL, rows_by_kind
from g2ard.stages.evaluate import Evaluation, Means, Scores, ViewScore
from g2ard.stages.recover.anchors import PriorMeasures
from g2ard.stages.recover.report import (
    RecoverReport,
    describe_idle_regularizers,
    describe_outcome,
    describe_time_limit,
)
from g2ard.stages.simplify.gaps import RECOVERED_GAPS, gaps_line
from g2ard.stages.simplify.reduce import SimplifyReport

LOST = 0.05
"""Loss of a view, or of the mean of views, in dB that counts."""
_LOST_SSIM = 0.001
"""Loss of SSIM that counts."""
_HARMFUL_SIZE = 3.0
"""Loss in dB at the views' own size, against that of training, above which --size is warned of."""
_LEAST_UNSEEN = 0.005
"""Share of the scene that counts if no view sees it."""
WARNED_FORMAT_LOSS = 1.0
"""Loss in dB by a file format that is worth a warning."""
_INVISIBLE_LOSS_PSNR = 45.0
"""PSNR in dB above which nobody sees a loss."""


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
        if math.isnan(after):
            return None
        return Change(before, after)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values, with one change per score."""
        own = {
            name: value
            for name, value in super().as_dict().items()
            if name not in ("before", "after")
        }
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
        [
            kind.kind,
            str(kind.views),
            *_list_scores(kind.before, kind.after, f"{kind.worst_psnr.after:.2f}"),
        ]
        for kind in kinds
    ]


def _list_scores(before: Scores, after: Scores, worst: str) -> list[str]:
    """Return the cells of `COLUMNS` from PSNR on."""
    cells = []
    for name in ("psnr", "detail", "ssim"):
        digits = METRICS[name].digits
        if math.isnan(after.scores[name]):
            cells.append("–")
        else:
            cells.append(f"{before.scores[name]:.{digits}f} → {after.scores[name]:.{digits}f}")
    psnr, detail, ssim = cells
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
        before, output, file = (
            (self.bytes[name] or 0) / 1e6 for name in ("input", "output", "file")
        )
        if self.photos:
            start = ""
        else:
            start = f"{before:.2f} → "
        if self.packed is None:
            return f"{start}{file or output:.2f} MB as .ply"
        start = start.replace(" → ", " MB as .ply → ")
        return f"{start}{file:.2f} MB as .{self.packed.file.partition('.')[2]}"

    @property
    def counts(self) -> str:
        """Counts, sizes and times."""
        seconds = {name: value for name, value in self.seconds.items() if name != "resumed"}
        times = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items())
        return f"{self.title}, {self.sizes}; {times}"

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


def list_remarks(report: RunReport, *, verbose: bool = False) -> list[str]:
    """Return lines on recovery, losses, unseen parts and packing; `verbose` adds idle regularisers."""
    rounds = [entry.recover for entry in report.rounds]
    recoveries = list(chain.from_iterable(rounds))
    lines = _compare_own_size(report)
    lines += map(describe_outcome, recoveries)
    if rounds and rounds[-1]:
        lines.append(describe_time_limit(recoveries[-1]))
    for entry in rounds:
        if entry and entry[-1].exposure:
            lines.append(str(entry[-1].exposure))
    if verbose:
        lines.append(describe_idle_regularizers(rounds))
    start = "start" if report.photos else "simplified scene"
    lines += [
        describe_loss(kind, f"the {start} is better there (--keep writes it too)")
        for kind in report.kinds
    ]
    lines.append(gaps_line(report.opacity_lost, RECOVERED_GAPS))
    if report.unseen and report.unseen > _LEAST_UNSEEN:
        lines.append(
            f"{report.unseen:.0%} of the scene is in no view: simplified but not recovered"
        )
    lines += report.warnings or ()
    if report.packed:
        size = report.bytes["file"] or 0
        lines += score_lines(report.packed, size, report.scores["recovered"].psnr, report.size)
    return [line for line in lines if line is not None]


def _compare_own_size(report: RunReport) -> list[str | None]:
    """Return the scores at the views' own size, if they were measured, and whether --size did harm."""
    if not report.own_size:
        return []
    before, after = (report.own_size[name] for name in ("simplified", "recovered"))
    lines: list[str | None] = [
        f"at the views' own size ({after.scored_in}): {before.psnr:.2f} → {after.psnr:.2f} dB, "
        f"SSIM {before.ssim:.4f} → {after.ssim:.4f}"
    ]
    lost = report.scores["recovered"].psnr - after.psnr
    if lost > _HARMFUL_SIZE:
        lines.append(
            f"warning: the result is {lost:.1f} dB worse at the views' own size than at --size; "
            "leave --size out, or give a larger one"
        )
    return lines


def describe_loss(kind: KindScore, hint: str) -> str | None:
    """Describe what recovery lost in the views of a kind, if anything; `hint` ends a warning."""
    psnr = kind.psnr.gain
    change = kind.change("ssim")
    ssim = change.gain if change else 0.0
    if ssim < -_LOST_SSIM and psnr > 0:  # neither scene is better
        return f"recovery lost {-ssim:.3f} SSIM and gained {psnr:.2f} dB in {kind.kind} views"
    lost = f"{kind.lost} of {kind.views}"
    if psnr < -LOST or ssim < -_LOST_SSIM:
        if psnr < -LOST:
            how = f"{-psnr:.2f} dB"
        else:
            how = f"{-ssim:.3f} SSIM"
        where = f"{lost} views lost PSNR"
        if kind.worst_psnr.gain < 0:
            where = f"worst view {kind.worst}: {kind.worst_psnr.before:.2f} → {kind.worst_psnr.after:.2f} dB"
        return f"warning: recovery lost {how} in {kind.kind} views ({where}); {hint}"
    if not kind.lost:
        return None
    how = "gained" if psnr > 0 else "lost"
    return (
        f"{lost} {kind.kind} views lost PSNR; the mean of all {kind.views} {how} {abs(psnr):.2f} dB"
    )


def score_lines(
    packed: Packed,
    size: int,
    unpacked: float,
    pixels: str,
) -> list[str]:
    """Return a packed file's size in bytes and score beside that of the unpacked scene, and a warning if its
    loss is large and visible. `pixels` is the size of the views.

    >>> score_lines(Packed("scene.sog", 37.86, 0.9), 1_310_000, 37.94, "800×600 px")
    ['scene.sog: 1.31 MB, 37.9 dB in held-out views, 800×600 px (37.9 as .ply)']
    >>> len(score_lines(Packed("scene.sog", 58.6, 0.9), 1_310_000, 62.6, "800×600 px"))
    1
    """
    name = packed.file
    lost = unpacked - packed.psnr
    scores = f"{packed.psnr:.1f} dB in held-out views, {pixels} ({unpacked:.1f} as .ply)"
    lines = [f"{name}: {size / 1e6:.2f} MB, {scores}"]
    if lost > WARNED_FORMAT_LOSS and packed.psnr < _INVISIBLE_LOSS_PSNR:
        lines.append(f"warning: {name}: the format costs {lost:.1f} dB; {better_format(name)}")
    return lines


def better_format(name: str) -> str:
    """Name formats that lose less than that of a file."""
    return ".ply loses nothing" if scene_format(name).loss == 1 else ".sog loses less, .ply nothing"
