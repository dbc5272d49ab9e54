"""One row of the study of recovery."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Look"]


@dataclass(frozen=True)
class Look:
    """One look at the unseen views; a row of the CSV.

    Args:
        study: of `STUDIES`.
        scene: its label.
        ratio: prior over budget.
        seed: of the order of views.
        variant: what is compared within the study.
        budget: Gaussians at the end.
        count: Gaussians at this look; more than `budget` before the last round.
        step: of the recovery in progress.
        seconds: of recovery so far, over all rounds, looks left out.
        cpu_s: the same in CPU seconds of all threads.
        simplify_s: seconds of simplification; 0 until the end.
        psnr: mean over unseen views, dB.
        ssim: the same.
        drift95: against the anchors of the last recovery; None before the end.
        needle: share of needles.
        rank_p1: the first percentile of effective ranks, which moves before there are needles.
        reg_share: share of recovery's time that regularisers took; None before the end.
        skipped: steps of single Gaussians left out as not finite; None before the end.
        final: 1 for the result, 0 on the way.
        version: of g2ard.
        machine: processor and cores.
        views_kind: what was looked at: "pool", "near" or "standing".
    """

    study: str
    scene: str
    ratio: float
    seed: int
    variant: str
    budget: int
    count: int
    step: int
    seconds: float
    cpu_s: float
    simplify_s: float
    psnr: float
    ssim: float
    drift95: float | None
    needle: float
    rank_p1: float
    reg_share: float | None
    skipped: int | None
    final: int
    version: str
    machine: str
    views_kind: str = "pool"

    @property
    def key(self) -> tuple[str, str, float, int, str]:
        """The run it belongs to."""
        return self.study, self.scene, self.ratio, self.seed, self.variant
