"""How much sooner the default recovery reaches what the paper's schedule ends with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.recover import Look

__all__ = ["Speedup", "speedups"]


@dataclass(frozen=True)
class Speedup:
    """How soon the default is as good as another schedule's result.

    Args:
        scene: its label.
        ratio: prior over budget.
        seed: of the order of views.
        against: the other variant.
        psnr: its result.
        seconds: it took.
        reached_s: seconds of the fastest default run at its first look that is as good; None if none is.
        best_psnr: of the default runs.
        views_kind: what both were scored on.
    """

    scene: str
    ratio: float
    seed: int
    against: str
    psnr: float
    seconds: float
    reached_s: float | None
    best_psnr: float
    views_kind: str = "pool"

    @property
    def share(self) -> float | None:
        """Of the other's time."""
        return None if self.reached_s is None else self.reached_s / self.seconds


def speedups(looks: Sequence[Look]) -> list[Speedup]:
    """Each final row of a variant not called default@…, against the default rows of its scene."""
    found = []
    for other in looks:
        if not other.final or other.variant.startswith("default@"):
            continue
        rivals = [
            look
            for look in looks
            if look.variant.startswith("default@")
            and look.count == look.budget
            and look.key[:4] == other.key[:4]
            and look.views_kind == other.views_kind
        ]
        if rivals:
            reached = [look.seconds for look in rivals if look.psnr >= other.psnr]
            found.append(
                Speedup(
                    other.scene,
                    other.ratio,
                    other.seed,
                    other.variant,
                    other.psnr,
                    other.seconds,
                    min(reached, default=None),
                    max(look.psnr for look in rivals),
                    other.views_kind,
                )
            )
    return found
