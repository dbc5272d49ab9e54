"""Scores of a scene before and after recovery, by kind of view."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from g2ard.io.reports import Report
from g2ard.scene.cameras import USUAL, rows_by_kind

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
        ssim: mean SSIM; None for a scene in tiles.
        worst: name of the view with the lowest PSNR after recovery.
        worst_psnr: PSNR of that view, dB.
        lost: number of views that lost over 0.05 dB.
        edge_psnr: mean PSNR of gradients, dB; None for a scene in tiles.
    """

    kind: str
    views: int
    psnr: Change
    ssim: Change | None
    worst: str
    worst_psnr: Change
    lost: int
    edge_psnr: Change | None = None


def by_kind(
    before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]], usual: str = USUAL
) -> tuple[KindScore, ...]:
    """Summarise scores by kind of view.

    Args:
        before: `name`, `kind` unless usual, `psnr` and, unless the scene is in tiles, `ssim` and
            `edge_psnr` of each view with the simplified scene.
        after: the same with the recovered scene.
        usual: name for the usual kind.

    >>> view = {"name": "near_0000", "kind": "near", "psnr": 30.0, "ssim": 0.9}
    >>> found, = by_kind([view], [view | {"psnr": 31.0}])
    >>> found.kind, found.psnr.gain, found.worst
    ('near', 1.0, 'near_0000')
    """

    def changes(score: str, rows: Sequence[int]) -> list[Change]:
        return [Change(before[row][score], after[row][score]) for row in rows]

    def mean_if_scored(score: str, rows: Sequence[int]) -> Change | None:
        return mean(changes(score, rows)) if score in after[rows[0]] else None

    def mean(found: Sequence[Change]) -> Change:
        return Change(fmean(change.before for change in found), fmean(change.after for change in found))

    scores = []
    for kind, rows in rows_by_kind([view.get("kind", USUAL) for view in after]).items():
        psnr = changes("psnr", rows)
        worst = min(range(len(rows)), key=lambda i: psnr[i].after)
        scores.append(
            KindScore(
                usual if kind == USUAL else kind,
                len(rows),
                mean(psnr),
                mean_if_scored("ssim", rows),
                after[rows[worst]]["name"],
                psnr[worst],
                sum(change.gain < -LOST for change in psnr),
                mean_if_scored("edge_psnr", rows),
            )
        )
    return tuple(scores)


COLUMNS = ("kind of view", "views", "PSNR, dB", "worst view", "SSIM")


def cells(kinds: Iterable[KindScore]) -> list[list[str]]:
    """Return the rows of a table with `COLUMNS`."""
    return [
        [
            kind.kind,
            str(kind.views),
            f"{kind.psnr.before:.2f} → {kind.psnr.after:.2f}",
            f"{kind.worst} {kind.worst_psnr.after:.2f}",
            f"{kind.ssim.before:.4f} → {kind.ssim.after:.4f}" if kind.ssim else "–",
        ]
        for kind in kinds
    ]
