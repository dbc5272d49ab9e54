"""New appearance on frozen geometry: what a compact map is reused for (`tab:geobase`)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from g2ard.config.choices import ADAPT_SCHEDULES, BLACK, AdaptSchedule, Colour
from g2ard.errors import InputError, require
from g2ard.progress import Progress, silent
from g2ard.report.base import Report
from g2ard.scene.appearance import blended, colour_change, recoloured, views_seeing
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets, fingerprint_of
from g2ard.stages.recover import RecoverConfig, checkpoint, recover
from g2ard.stages.recover.anchors import Regularizers
from g2ard.stages.recover.probe import Probe
from g2ard.stages.recover.report import Gain
from g2ard.stages.recover.schedule import PAPER, TUNED, Schedule

_FREE = Regularizers(anchor=0.0, shape=0.0, effective_rank=False)
"""Geometry that cannot move needs nothing to hold it."""


@dataclass(frozen=True)
class AdaptConfig:
    """How appearance is refitted.

    Args:
        steps: at most; 7,000 as in the paper.
        tolerance: dB; a stretch of steps that gains less on the training views is the last; 0 takes all.
        schedule: "default" takes stretches of 500, 1,000, 2,000 … steps, each under a cosine; "paper" takes
            all steps at its rates, which decay to a tenth, from the scene as it is, and blends nothing.
        prior_views: what the appearance before the fit weighs, in views. A Gaussian that v views have seen
            ends v/(v + this) of the way from there to its fit: few images say little of what they hardly
            see. 0 takes the fit as it is.
        sh_degree: of the result; None keeps the scene's. A scene without higher bands has no place for shine.
        background: RGB behind the scene.
        seed: of the order of views.
        first_stretch: steps of the first stretch.
        colour_worth: dB that a change of all colours at once must bring on the images.
        ssim_weight: λ of the photometric loss, see `RecoverConfig`.
        recovery: rates and decay of a stretch, see `appearance_only`; None means those of `schedule`.

    Raises:
        InputError: a value out of its range.
    """

    steps: int = 7000
    tolerance: float = 0.05
    schedule: AdaptSchedule = "default"
    prior_views: float = 1.0
    sh_degree: int | None = None
    background: Colour = BLACK
    seed: int = 0
    first_stretch: int = 500
    colour_worth: float = 0.3
    ssim_weight: float = RecoverConfig.ssim_weight
    recovery: Schedule | None = None

    def __post_init__(self) -> None:
        if self.steps < 1 or not self.tolerance >= 0:
            raise InputError(
                f"{self.steps} steps, tolerance {self.tolerance}: expected ≥ 1 and ≥ 0", parameter="steps"
            )
        if not 0 <= self.prior_views < float("inf"):
            raise InputError(
                f"expected a number of views, at least 0, got {self.prior_views}", parameter="prior_views"
            )
        if self.schedule not in ADAPT_SCHEDULES:
            raise InputError(
                f"expected {' or '.join(ADAPT_SCHEDULES)}, got {self.schedule!r}", parameter="schedule"
            )
        require("first_stretch", self.first_stretch, self.first_stretch >= 1, "at least 1")
        if self.recovery is not None and self.recovery != appearance_only(self.recovery):
            raise InputError(
                "geometry stays: the rates of means, log_scales and quats are 0", parameter="recovery"
            )

    @classmethod
    def scheduled(cls, schedule: AdaptSchedule) -> AdaptConfig:
        """Return the config of a schedule, its rates and decay included.

        >>> AdaptConfig.scheduled("paper").prior_views
        0.0
        """
        rates = appearance_only(PAPER if schedule == "paper" else TUNED)
        return cls(schedule=schedule, prior_views=0.0 if schedule == "paper" else 1.0, recovery=rates)

    def stretches(self) -> list[int]:
        """Steps of each stretch, doubling; what would be left over for a shorter one joins the last.

        >>> AdaptConfig().stretches(), AdaptConfig(steps=600).stretches()
        ([500, 1000, 2000, 3500], [600])
        """
        if self.schedule == "paper":
            return [self.steps]
        out, length, left = [], self.first_stretch, self.steps
        while left >= 2 * length:
            out.append(length)
            left -= length
            length *= 2
        return [*out, left]


@dataclass(frozen=True)
class Stretch(Report):
    """Steps under one cosine, and the training views' PSNR after them, dB."""

    steps: int
    psnr: float


@dataclass(frozen=True)
class AdaptReport(Report):
    """An adaptation in numbers.

    Args:
        steps: taken.
        seconds: for them.
        converged: whether the last stretch gained less than the tolerance.
        psnr: over a sample of the training views.
        stretches: one after another.
        colour_change: gain (dB), matrix and shift of the change of all colours; None where none is worth it.
        prior_share: the mean share of the appearance before the fit.
    """

    steps: int
    seconds: float
    converged: bool
    psnr: Gain
    stretches: tuple[Stretch, ...]
    colour_change: dict[str, Any] | None
    prior_share: float


@dataclass(frozen=True, eq=False)
class Adapted:
    """A scene with new appearance.

    Args:
        splats: means, rotations and scales of the scene given, bit for bit; new SH and opacities.
        report: what was done, in numbers.
    """

    splats: Splats
    report: AdaptReport


@dataclass
class _State:
    """What a resume must bring back between two stretches."""

    splats: Splats
    seconds: float = 0.0
    converged: bool = False
    stretches: list[dict[str, Any]] = field(default_factory=list)

    _ARRAYS: ClassVar = ("logit_opacities", "sh0", "shN")

    def save(self, path: Path, key: str) -> None:
        meta = {"seconds": self.seconds, "converged": self.converged}
        arrays = {name: getattr(self.splats, name) for name in self._ARRAYS}
        checkpoint.save(path, key, {**meta, "stretches": self.stretches}, arrays)

    def load(self, path: Path, key: str) -> None:
        meta, arrays = checkpoint.load(path, key)
        self.splats = replace(self.splats, **arrays)
        self.seconds = meta["seconds"]
        self.converged, self.stretches = meta["converged"], meta["stretches"]


def adapt(
    compact: Splats,
    targets: Targets,
    config: AdaptConfig | None = None,
    *,
    work: Path | None = None,
    progress: Progress = silent,
) -> Adapted:
    """Refit spherical harmonics and opacities to targets; means, rotations and scales stay.

    First one affine map c ↦ M·(c, 1) of all colours, M (3, 4) by least squares
    (`g2ard.scene.appearance.colour_change`), where it gains enough on the images: a change of light is then
    right in unseen places too. Then each Gaussian's own appearance, under L = (1−λ)·L1 + λ·(1−SSIM) as in
    recovery, without regularisers. Last a blend: a Gaussian seen by v images goes v/(v + prior_views) of the
    way to its fit. PSNR on other trajectories then measures the geometry (`tab:geobase`).

    Args:
        compact: the scene; its offset counts, cameras are in world coordinates.
        targets: photos, or renders of a scene with the wanted appearance.
        config: see `AdaptConfig`.
        work: a folder that exists, for checkpoints: after every stretch, every minute and at Ctrl-C. Where it
            holds some, adaptation goes on from them, and ends as if it had never stopped.
        progress: told of every step.

    Returns:
        An `Adapted` with as many Gaussians, in their order.

    Raises:
        InputError: no Gaussians, no views, or checkpoints of another run.
        KeyboardInterrupt: after Ctrl-C, once the checkpoint is written.
    """
    config = config or AdaptConfig()
    given = compact if config.sh_degree is None else compact.with_sh_degree(config.sh_degree)
    probe = Probe(targets, config.background)
    change, start = None, given
    if config.schedule == "default" and len(given) and len(targets.cameras):
        change = colour_change(given, targets, config.background)
        change = change if change.gain >= config.colour_worth else None
        start = given if change is None else recoloured(given, change)
    state = _State(start)
    parts = (repr(config), compact.fingerprint(), fingerprint_of(targets))
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()
    done, within = (work / "stretches.npz", work / "steps.npz") if work else (None, None)
    if done and done.exists():
        state.load(done, key)
    lengths = config.stretches()
    while len(state.stretches) < len(lengths) and not state.converged:
        number = len(state.stretches)
        _stretch(state, compact, targets, config, lengths[number], number, within, progress)
        if done and within:
            state.save(done, key)
            within.unlink(missing_ok=True)
    share = np.ones(len(given))
    if config.schedule == "default" and config.prior_views:
        seen = views_seeing(start, targets.cameras)
        share = seen / (seen + config.prior_views)
    result = blended(start, state.splats, share)
    report = AdaptReport(
        steps=sum(s["steps"] for s in state.stretches),
        seconds=state.seconds,
        converged=state.converged,
        psnr=Gain(probe.all_of(given), probe.all_of(result)),
        stretches=tuple(map(Stretch.of, state.stretches)),
        colour_change=None
        if change is None
        else {k: np.asarray(v).tolist() for k, v in vars(change).items()},
        prior_share=float(1 - share.mean()),
    )
    return Adapted(result, report)


def _stretch(
    state: _State,
    compact: Splats,
    targets: Targets,
    config: AdaptConfig,
    steps: int,
    number: int,
    within: Path | None,
    progress: Progress,
) -> None:
    """Steps under one cosine."""
    recovery = config.recovery or appearance_only(PAPER if config.schedule == "paper" else TUNED)
    how = RecoverConfig(
        schedule=recovery,
        steps=steps,
        regularizers=_FREE,
        ssim_weight=config.ssim_weight,
        background=config.background,
        seed=config.seed + number,
    )
    found = recover(state.splats, targets, how, checkpoint=within, progress=progress, stage="adapt")
    before, after = found.report.psnr.before, found.report.psnr.after
    state.splats = replace(found.splats, means=compact.means, quats=compact.quats, scales=compact.scales)
    state.stretches.append({"steps": steps, "psnr": after})
    state.seconds += found.report.seconds
    state.converged = after - before < config.tolerance


def appearance_only(schedule: Schedule) -> Schedule:
    """A schedule under which geometry stays: its rates are 0."""
    return replace(schedule, rates=replace(schedule.rates, means=0.0, log_scales=0.0, quats=0.0))
