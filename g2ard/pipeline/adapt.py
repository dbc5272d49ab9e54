"""Adaptation: fitting new appearance to frozen geometry (`tab:geobase`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np

from g2ard.arrays import Float, Float32
from g2ard.config.checks import AtLeastOne, NotNegative, Within, checks_arguments
from g2ard.config.choices import AdaptSchedule
from g2ard.errors import InputError
from g2ard.io.reports import LEFT_OUT, Report
from g2ard.pipeline.steps import Steps
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.exposure import Exposure
from g2ard.rendering.renderer import Renderer
from g2ard.rendering.targets import Targets, checked_targets, mask_of
from g2ard.rendering.visibility import visibility
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import SH_C0, Splats
from g2ard.stages.recover.anchors import FREE
from g2ard.stages.recover.config import PAPER, TUNED, FitConfig, RecoverConfig, Schedule
from g2ard.stages.recover.probe import Probe
from g2ard.stages.recover.report import Gain, RecoverReport
from g2ard.system.shown import Shown

_FITTED_VIEWS = 16
"""Number of evenly spaced targets used to fit the change of colours."""
_FITTED_PIXELS = 20_000
"""Most pixels used per target."""
_NO_CHANGE_WEIGHT = 1e-5
"""Weight of no change, as a share of the pixels, for colours that the scene lacks."""
_VISIBILITY_SIDE = 300
"""Longer side in pixels of the renders that measure visibility."""
_HALF_SEEN_WEIGHT = 10.0
"""Σ αT over these renders at which a view counts as half."""
_STEPS_PER_IMAGE = 50
"""Default steps per image."""

_FEWEST_STEPS = 250
"""Least default steps. A base colour moves by at most 0.28 × 0.03 in a step and by half of that over a
stretch, so that 250 steps span all of its range."""

_MOST_STEPS = 7000
"""Most default steps, as in the paper."""


@dataclass(frozen=True, eq=False)
class ColourChange:
    """Affine change of all colours of a scene: c → matrix·c + shift.

    Args:
        gain: gain in dB on the pixels it was fitted to.
    """

    matrix: Float
    shift: Float
    gain: float


def fit_colour_change(
    splats: Splats, targets: Targets, background: tuple[float, float, float]
) -> ColourChange:
    """Fit the affine colour map (exposure, white balance) from a scene's renders to images.

    A pixel is C + (1 − A)·background, C = Σ αT·c and A = Σ αT, and matrix·C + A·shift + (1 − A)·background
    after the map: linear least squares with twelve unknowns and a small weight on no change, over pixels that
    are not masked.
    """
    cameras = targets.cameras
    behind = np.asarray(background)
    normal = np.zeros((4, 4))
    right = np.zeros((4, 3))
    before = pixels = 0.0
    renderer = Renderer(splats, background=background)
    for view in evenly_spaced(len(cameras), _FITTED_VIEWS):
        rendered = renderer.render(cameras[view])
        image = targets[view]
        mask = mask_of(targets, view)
        counts = np.ones(image.shape[:2], bool) if mask is None else mask
        rows = np.flatnonzero(counts)[:: max(1, int(counts.sum()) // _FITTED_PIXELS)]
        alpha = rendered.alpha.reshape(-1, 1)[rows].astype(np.float64)
        beyond = (1 - alpha) * behind
        own = rendered.image.reshape(-1, 3)[rows] - beyond
        missing = image.reshape(-1, 3)[rows] - beyond - own
        features = np.hstack([own, alpha])
        normal += features.T @ features
        right += features.T @ missing
        before += float((missing**2).sum())
        pixels += len(rows)
    change = np.linalg.solve(normal + _NO_CHANGE_WEIGHT * pixels * np.eye(4), right)
    # |y − Xb|² = |y|² − 2 bᵀXᵀy + bᵀXᵀXb
    after = before - 2 * float((change * right).sum()) + float((change * (normal @ change)).sum())
    tiny = np.finfo(np.float64).tiny
    gain = 10 * float(np.log10(max(before, tiny) / max(after, tiny)))
    return ColourChange(np.eye(3) + change[:3].T, change[3], gain)


def recolour(splats: Splats, change: ColourChange) -> Splats:
    """Change the colours of a scene: all bands by the matrix, the base also by the shift."""
    matrix = change.matrix.astype(np.float32)
    rest = (change.matrix.sum(1) * 0.5 + change.shift - 0.5) / SH_C0
    base = splats.sh0 @ matrix.T + rest.astype(np.float32)
    return replace(splats, sh0=base, shN=splats.shN @ matrix.T)


def count_views_seeing(splats: Splats, cameras: Cameras) -> Float:
    """Return (N,) the number of views that see each Gaussian; each counts w/(w + 10), w = Σ αT in a small
    render."""
    small = cameras.resized(_VISIBILITY_SIDE)
    out = np.zeros(len(splats))
    for view in range(len(small)):
        weight = visibility(splats, small.take([view])).weight
        out += weight / (weight + _HALF_SEEN_WEIGHT)
    return out


def blend_appearance(start: Splats, fitted: Splats, share: Float) -> Splats:
    """Interpolate colours and opacity logits from `start` to `fitted` by the (N,) `share`."""
    s = share.astype(np.float32)

    def between(a: Float32, b: Float32) -> Float32:
        return a + s.reshape(-1, *[1] * (a.ndim - 1)) * (b - a)

    return replace(
        fitted,
        sh0=between(start.sh0, fitted.sh0),
        shN=between(start.shN, fitted.shN),
        logit_opacities=between(start.logit_opacities, fitted.logit_opacities),
    )


def freeze_geometry(schedule: Schedule) -> Schedule:
    """Return the schedule with the rates of geometry set to 0."""
    return replace(schedule, rates=replace(schedule.rates, means=0.0, log_scales=0.0, quats=0.0))


_TUNED = freeze_geometry(TUNED)
_PAPER = freeze_geometry(PAPER)


@dataclass(frozen=True)
class AdaptConfig(FitConfig, tag="schedule"):
    """Settings of adaptation, in addition to `FitConfig`; the schedule `default` has more.

    Args:
        schedule: "default" takes stretches of 500, 1,000, 2,000 … steps with falling rates; "paper" takes all
            steps at once, with rates that decay to a tenth, without colour change or blending.
        steps: maximum number of steps. None takes 50 per image, at least 250 and at most the paper's 7,000,
            which "paper" always takes.
        recovery: rates and decay of a stretch with frozen geometry, see `freeze_geometry`.

    Raises:
        InputError: a value out of range.
    """

    schedule: AdaptSchedule = "default"
    steps: AtLeastOne | None = None
    recovery: Schedule = field(default=_TUNED, metadata={"whole": True})

    if TYPE_CHECKING:  # the settings of a schedule are those of its class
        tolerance: ClassVar[float]
        prior_views: ClassVar[float]

        def __init__(self, **settings: Any) -> None: ...

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.recovery != freeze_geometry(self.recovery):
            raise InputError(
                "expected rates of 0 for means, log_scales and quats, because geometry is frozen",
                parameter="recovery",
            )

    def most_steps(self, count: int) -> int:
        """Return the maximum number of steps for some images.

        >>> [AdaptConfig().most_steps(count) for count in (4, 43, 500)], AdaptConfig(steps=9).most_steps(4)
        ([250, 2150, 7000], 9)
        """
        if self.steps is not None:
            return self.steps
        least = _FEWEST_STEPS if isinstance(self, Stretched) else _MOST_STEPS
        return min(_MOST_STEPS, max(least, _STEPS_PER_IMAGE * count))

    def stretches(self, count: int) -> list[int]:
        """Return the steps of each stretch, doubling; the remainder joins the last one.

        >>> AdaptConfig().stretches(140), AdaptConfig(steps=600).stretches(140)
        ([500, 1000, 2000, 3500], [600])
        """
        most = self.most_steps(count)
        if not isinstance(self, Stretched):
            return [most]
        out = []
        length = self.first_stretch
        left = most
        while left >= 2 * length:
            out.append(length)
            left -= length
            length *= 2
        return [*out, left]


@dataclass(frozen=True)
class Stretched(AdaptConfig, variants=("default",)):
    """Settings of the schedule `default`.

    Args:
        tolerance: gain on the training views, dB, below which fitting stops after a stretch; 0 takes all
            steps.
        prior_views: weight of the appearance before the fit, in views. A Gaussian seen by v views moves v/(v
            + prior_views) of the way to its fit. 0 keeps the fit.
        first_stretch: steps of the first stretch.
        colour_worth: smallest gain on the images, dB, for which all colours are changed at once.
    """

    tolerance: Annotated[float, Within("[0, inf]")] = 0.05  # type: ignore[misc]
    prior_views: NotNegative = 1.0  # type: ignore[misc]
    first_stretch: AtLeastOne = 500
    colour_worth: Annotated[float, Within("[0, inf]")] = 0.3


@dataclass(frozen=True)
class AtOnce(AdaptConfig, variants=("paper",)):
    """Settings of the schedule `paper`: those of `AdaptConfig`."""

    schedule: Literal["paper"] = "paper"
    recovery: Schedule = field(default=_PAPER, metadata={"whole": True})
    tolerance: ClassVar[float] = 0.0
    prior_views: ClassVar[float] = 0.0


@dataclass(frozen=True)
class Stretch(Report):
    """Number of steps, and the PSNR (dB) of the training views after them."""

    steps: int
    psnr: float


@dataclass(frozen=True)
class AdaptReport(Report):
    """Figures of an adaptation.

    Args:
        converged: whether the last stretch gained less than the tolerance.
        psnr: PSNR before and after, on a sample of the training views; all are measured alike.
        colour_change: gain (dB), matrix and shift of the change of all colours; None if it was not applied.
        prior_share: mean share of the previous appearance in the result.
        exposure: what was last estimated of the photos' exposures; None if they agree.
    """

    steps: int
    seconds: float
    converged: bool
    psnr: Gain
    stretches: tuple[Stretch, ...]
    colour_change: dict[str, Any] | None
    prior_share: float
    exposure: Exposure | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, eq=False)
class Adapted(Shown):
    """A scene with new appearance.

    Args:
        splats: the given means, rotations and scales, bit for bit, with new SH and opacities.
        report: figures of the adaptation.
    """

    splats: Splats
    report: AdaptReport

    def __repr__(self) -> str:
        return f"Adapted({plural(len(self.splats), 'Gaussian')}, {self.report.psnr})"


def _fit(
    start: Splats, targets: Targets, config: AdaptConfig, steps: Steps, progress: Progress
) -> tuple[list[Splats], list[RecoverReport]]:
    """Recover with frozen geometry until a stretch gains less than the tolerance; return each one's scene."""
    scene = start
    before = 0
    images = len(targets.cameras)
    most = config.most_steps(images)
    scenes: list[Splats] = []
    reports: list[RecoverReport] = []

    def told(stage: str, done: int, total: int, info: Mapping[str, Any] | None = None) -> None:
        progress(stage, before + done, most, info or {})

    for length in config.stretches(images):
        how = RecoverConfig(
            schedule=config.recovery,
            steps=length,
            regularizers=FREE,  # geometry is frozen
            ssim_weight=config.ssim_weight,
            background=config.background,
            seed=config.seed + len(reports),
            engine=config.engine,
        )
        name = f"stretch-{len(reports) + 1}"
        tell = silent if progress is silent else told
        new, report = steps.recover(name, scene, targets, how, progress=tell, stage="adapt")
        scene = replace(scene, logit_opacities=new.logit_opacities, sh0=new.sh0, shN=new.shN)
        scenes.append(scene)
        reports.append(report)
        before += length
        if report.psnr.after - report.psnr.before < config.tolerance:
            break
    progress("adapt", before, before, {})
    return scenes, reports


@checks_arguments
def adapt(
    compact: Splats,
    targets: Targets,
    config: AdaptConfig | None = None,
    *,
    work: Path | None = None,
    progress: Progress = silent,
) -> Adapted:
    """Refit spherical harmonics and opacities to targets; means, rotations and scales stay.

    First, one affine map c ↦ M·(c, 1) is applied to all colours if it gains enough (M (3, 4) by least
    squares, `g2ard.pipeline.adapt.fit_colour_change`), so that a change of light is right in unseen places
    too. Second, each Gaussian's appearance is fitted with L = (1−λ)·L1 + λ·(1−SSIM) as in recovery, without
    regularisers. Last, a Gaussian seen by v images moves v/(v + prior_views) of the way to its fit. PSNR on
    other trajectories then measures the geometry (`tab:geobase`).

    Args:
        compact: the scene; cameras are in world coordinates, including its offset.
        targets: photos, or renders of a scene with the wanted appearance.
        config: see `AdaptConfig`.
        work: existing folder for finished stretches and for checkpoints, written every minute and at Ctrl-C.
            The same call resumes from them, with the same result.
        progress: called after every step.

    Returns:
        The scene with new appearance, its Gaussians in the same order.

    Raises:
        InputError: no Gaussians or no views.
        KeyboardInterrupt: after Ctrl-C, when the checkpoint is written.

    >>> import g2ard
    >>> rng = np.random.default_rng(0)
    >>> scene = Splats.create(rng.normal(size=(300, 3)), scales=np.full((300, 3), 0.2))
    >>> views = g2ard.make_pool(scene, 4, size=(64, 48))
    >>> dark = [g2ard.render(scene, view).image.clip(0, 1) / 2 for view in views]
    >>> darker = adapt(scene, g2ard.Photos(views, dark), AdaptConfig(steps=20))
    >>> darker.report.psnr.after > darker.report.psnr.before
    True
    """
    config = config or AdaptConfig()
    targets = checked_targets(targets)
    given = compact if config.sh_degree is None else compact.with_sh_degree(config.sh_degree)
    probe = Probe(targets, config.background)
    progress("adapt", 0, 0)
    change = None
    start = given
    share = np.ones(len(given))
    if isinstance(config, Stretched) and len(given) and len(targets.cameras):
        change = fit_colour_change(given, targets, config.background)
        change = change if change.gain >= config.colour_worth else None
        start = given if change is None else recolour(given, change)
    scenes, fits = _fit(start, targets, config, Steps(work, progress), progress)
    progress("adapt", 0, 0)
    if config.prior_views:
        seen = count_views_seeing(start, targets.cameras)
        share = seen / (seen + config.prior_views)
    result = blend_appearance(start, scenes[-1], share)
    exposure = next((fit.exposure for fit in reversed(fits) if fit.exposure), None)
    if exposure is not None:
        probe.fit_exposures()
    changed = (
        None if change is None else {k: np.asarray(v).tolist() for k, v in vars(change).items()}
    )
    taken = zip(config.stretches(len(targets.cameras)), scenes, strict=False)
    stretches = tuple(Stretch(steps, probe.score(scene)) for steps, scene in taken)
    report = AdaptReport(
        steps=sum(stretch.steps for stretch in stretches),
        seconds=sum(fit.seconds for fit in fits),
        converged=fits[-1].psnr.after - fits[-1].psnr.before < config.tolerance,
        psnr=Gain(probe.score(given), probe.score(result), probe.scored_in),
        stretches=stretches,
        colour_change=changed,
        prior_share=float(1 - share.mean()),
        exposure=exposure,
    )
    return Adapted(result, report)
