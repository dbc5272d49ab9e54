"""Options of recovery: learning rates of each attribute, numbers of steps, and the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from g2ard.config.checks import AboveZero, AtLeastOne, Degree, NotNegative, Positive, Share, Within
from g2ard.config.choices import BLACK, Colour, Engine
from g2ard.config.schema import Settings
from g2ard.errors import InputError, require
from g2ard.scene.cameras import ZOOM, Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import REGULARIZERS, Regularizers

_Decay = Annotated[float, Within("(0, 1]")]

_DEFAULT_REACH = 0.01
"""Default `reach`: Gaussians larger than a hundredth of the image hardly move, unless that is typical."""

_DEFAULT_FINEST = 1.0
"""Pixels, default `finest`: the sampling limit. Of a Gaussian with this standard deviation, exp(−π²/2), under
1 %, of the spectrum's peak is left at the Nyquist frequency, so its pixels determine its shape."""

_UNTRAINED_RMSE = 0.1
"""Initial RMSE above which a scene counts as untrained, so that large Gaussians must move."""

_SIGHT_SAMPLE = 4096
"""Gaussians that `count_steps_for_renders` measures views with."""

_USUAL_VIEWS = 112
"""Usual views that train if each holds the whole scene."""

_MOST_GROWTH = 2.25
"""Largest factor on these if each holds less."""

VIEWS_PER_SCHEDULE = 140
"""Views that the schedule's steps are for."""

_FEW_POINTS = 1250
"""Points of photos up to which the schedule's steps suffice."""

_MOST_STEPS_FACTOR = 3.0
"""Limit of the factor on the schedule's steps."""


@dataclass(frozen=True)
class Rates(Settings):
    """Adam's learning rate of each attribute, in the space it is optimised in.

    Large Gaussians hardly move: with σ the largest standard deviation in the view as a share of the image's
    longer side, rates of means and rotations are multiplied by 1/(1 + (σ/reach)¹⁶), and that of each scale by
    the same for its own axis (`recover.losses.measure_extents`). Otherwise many layers moving together, such
    as a sky's, would move the image by the sum of their steps.

    Gaussians below a pixel hardly move either: the same rates are multiplied by σ²/(σ² + finest²), with σ in
    pixels before dilation. Adam divides by the gradient's own size, and would otherwise move what a view
    cannot resolve as far as everything else.

    Args:
        means: in units of the Gaussian's radius if `means_in_scales`, otherwise scene units.
        log_scales: natural-log units.
        quats: components of the unnormalised quaternion.
        logit_opacities: logits.
        sh0: band-0 coefficients.
        shN: higher-band coefficients.
        reach: share of the image's longer side; infinite treats all sizes alike. Set by the schedule.
        finest: pixels; 0 treats all sizes alike. Set by the schedule.
        momentum: Adam's β₁. Set by the schedule.

    Raises:
        InputError: a value out of range.
    """

    means: NotNegative
    log_scales: NotNegative
    quats: NotNegative
    logit_opacities: NotNegative
    sh0: NotNegative
    shN: NotNegative
    reach: AboveZero = field(default=math.inf, metadata={"setting": False})
    finest: NotNegative = field(default=0.0, metadata={"setting": False})
    momentum: Annotated[float, Within("[0, 1)")] = field(default=0.9, metadata={"setting": False})


@dataclass(frozen=True)
class Schedule(Settings):
    """Rates and their decay over a fixed number of steps.

    Args:
        rates: rates at the first step.
        steps: steps of the final (or only) recovery.
        round_steps: recovery steps of each intermediate round; 0 recovers at the final count only.
        means_in_scales: `rates.means` is a share of each Gaussian's radius, the geometric mean of its longer
            scales, and thus independent of the scene's unit.
        final_rate: rates fall in a straight line to this share; None keeps geometry rates constant.
        appearance_decay: shares (rounds, final) to which appearance rates decay exponentially; 1 keeps them.
        multiplier: factor on all rates; None chooses it by short trials, starting at `guess_multiplier`.
        reach: see `Rates`; None chooses it from the initial error (`choose_reach`).
        finest: see `Rates`. `distill` takes 0 for points found in photos, unless it is set.
        momentum: Adam's β₁, the share of its mean gradient that a step keeps.
        reference_extent: `rates.means` is scaled by the cameras' extent (`Cameras.extent`) over this, so that
            the scene's unit does not matter; None takes it in scene units.
        for_renders: share of the steps that renders take, because they agree with each other, unlike photos.
        guarded: whether a recovery that loses quality returns to the best scene or its start; otherwise all
            steps are taken and kept.

    Raises:
        InputError: a value out of range.
    """

    rates: Rates
    steps: AtLeastOne
    round_steps: Annotated[int, Within("[0, inf)")] = 0
    means_in_scales: bool = True
    final_rate: Share | None = 0.01
    appearance_decay: tuple[_Decay, _Decay] = (1.0, 1.0)
    multiplier: AboveZero | None = None
    reach: AboveZero | None = None
    finest: NotNegative = _DEFAULT_FINEST
    momentum: Annotated[float, Within("[0, 1)")] = 0.6
    reference_extent: AboveZero | None = None
    for_renders: Positive = 0.8
    guarded: bool = True

    @classmethod
    def named(cls, name: str) -> Schedule:
        """Return the schedule of this name in `SCHEDULES`.

        Raises:
            InputError: an unknown name.

        >>> Schedule.named("default").steps
        1000
        """
        require("schedule", repr(name), name in SCHEDULES, f"one of {', '.join(SCHEDULES)}")
        return SCHEDULES[name]

    def within(self, extent: float) -> Schedule:
        """Return the schedule for cameras of this extent; an extent of 0 changes nothing.

        >>> PAPER.within(11.5).rates.means / PAPER.rates.means, TUNED.within(11.5) == TUNED
        (2.0, True)
        """
        if self.reference_extent is None or not extent > 0:
            return self
        means = self.rates.means * extent / self.reference_extent
        return replace(self, rates=replace(self.rates, means=means))

    def scaled(self, steps: int) -> Schedule:
        """Return the schedule with `steps` final steps, and rounds in proportion.

        >>> PAPER.scaled(3000).round_steps
        800
        """
        share = steps / self.steps
        if self.round_steps:
            rounds = max(1, round(self.round_steps * share))
        else:
            rounds = 0
        return replace(self, steps=steps, round_steps=rounds)

    def at(
        self, t: float, *, final: bool, multiplier: float = 1.0, reach: float = math.inf
    ) -> Rates:
        """Return the rates at the share `t` of the steps, from 0 at the first to 1 after the last."""
        if self.final_rate is None:
            fall = 1.0
        else:
            fall = 1 - (1 - self.final_rate) * t
        decay = self.appearance_decay[1 if final else 0] ** t
        geometry = fall * multiplier
        appearance = fall * decay * multiplier
        first = self.rates
        return Rates(
            first.means * geometry,
            first.log_scales * geometry,
            first.quats * geometry,
            first.logit_opacities * appearance,
            first.sh0 * appearance,
            first.shN * appearance,
            reach,
            self.finest,
            self.momentum,
        )


TUNED = Schedule(
    rates=Rates(
        means=0.05, log_scales=6e-2, quats=1.5e-2, logit_opacities=7e-2, sh0=3e-2, shN=3e-3
    ),
    steps=1000,
)
"""g2ard's schedule: rates in units of each Gaussian, falling to 1 % (figures in decisions 0016 and 0037)."""

PAPER = Schedule(
    rates=Rates(
        means=9.2e-4, log_scales=5e-3, quats=1e-3, logit_opacities=5e-3, sh0=2.5e-3, shN=1.25e-4
    ),
    steps=30_000,
    round_steps=8_000,
    means_in_scales=False,
    final_rate=None,
    appearance_decay=(0.36, 0.1),
    multiplier=1.0,
    reach=math.inf,
    finest=0.0,
    momentum=0.9,
    reference_extent=5.75,
    guarded=False,
)
"""The paper's schedule (supplement, `tab:s_config`): 8,000 steps per round and 30,000 at the end, with 3DGS's
rates where the paper states none. Its rate of means lacks a unit; 9.2e-4 is 3DGS's 1.6e-4 × extent at an
extent of 5.75, so it is read that way (decision 0023). `PAPER.scaled(3000)` has a tenth of the steps."""

SCHEDULES: dict[str, Schedule] = {
    "fast": replace(TUNED, steps=300, for_renders=1 / 3),
    "default": TUNED,
    "best": replace(TUNED, steps=6000),
    "paper": PAPER,
}


def guess_multiplier(start_rmse: float, least: float = 1 / 3) -> float:
    """Guess the rate multiplier from the RMSE before recovery: 1 from 0.039 up, a third from 0.013 down.

    Better starts need smaller steps. Trials start at no less than a third (`least`); without time for trials,
    nearly fitted starts need less.

    >>> guess_multiplier(0.05), round(guess_multiplier(0.026), 3), round(guess_multiplier(0.001), 3)
    (1.0, 0.667, 0.333)
    """
    return min(1.0, max(least, start_rmse / 0.039))


def choose_reach(start_rmse: float, typical: float) -> float:
    """Return the reach for a start: .01, or the typical share if larger; infinite for an untrained start.

    >>> choose_reach(0.02, 0.005), choose_reach(0.05, 0.04), choose_reach(0.15, 0.005)
    (0.01, 0.04, inf)
    """
    if start_rmse < _UNTRAINED_RMSE:
        return max(_DEFAULT_REACH, typical)
    return math.inf


def count_steps_from_points(count: int, steps: int) -> int:
    """Return `steps` times √(count / 1,250), or `steps` if that is more, for a start from points of photos.

    Such points are misplaced by a length that does not depend on their count. A mean moves by a share of its
    radius per step, and radii shrink with the root of the count, so that the way takes as many more steps.

    >>> [count_steps_from_points(*case) for case in ((1_000, 1000), (20_000, 1000), (20_000, 300))]
    [1000, 4000, 1200]
    """
    return round(steps * math.sqrt(max(1.0, count / _FEW_POINTS)))


def count_steps_for_renders(scene: Splats, cameras: Cameras, steps: float) -> int:
    """Return the steps for views against renders, one to three times `steps`.

    The least are for 140 views, each used about six times. However many usual views there are, they count as
    112/√h, at most 252, if one holds a share h of the scene: a view of an orbit shows the whole object, but a
    view in a room a tenth of it. Views of other kinds count in proportion, zooms not at all.

    >>> from g2ard.scene.cameras import look_at
    >>> line = Splats.create([[0, 0, 0], [9, 0, 0], [0, 0, 9], [-9, 0, 0]], scales=np.ones((4, 3)))
    >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
    >>> view = Cameras.from_lists([look_at([0, -3, 0], [0, 0, 0])], [K], [(64, 64)], ["a"])
    >>> count_steps_for_renders(line, view, 800)
    1280
    """
    usual = cameras.usual()
    plain = sum(kind != ZOOM for kind in cameras.kinds)
    some = evenly_spaced(len(scene), _SIGHT_SAMPLE)
    points = scene.means[some].astype(np.float64) + scene.offset
    share = max(usual.usual_share(points), 1 / _MOST_GROWTH**2)
    views = _USUAL_VIEWS / math.sqrt(share) * (plain / len(usual))
    factor = min(max(1.0, views / VIEWS_PER_SCHEDULE), _MOST_STEPS_FACTOR)
    return round(steps * factor)


@dataclass(frozen=True)
class FitConfig(Settings):
    """Options of every fit to images.

    Args:
        sh_degree: SH degree of the result; None keeps the scene's. Highlights need higher bands.
        ssim_weight: λ in (1−λ)·L1 + λ·(1−SSIM); 0.2 as in 3DGS.
        background: RGB behind the scene.
        seed: seed of the order of views.
        engine: "fused" runs whole steps in Rust, or on the GPU in use; "torch" uses autograd over the Rust
            rasteriser and `SelectiveAdam`, with equal results up to rounding.

    Raises:
        InputError: a value out of range.
    """

    sh_degree: Degree | None = None
    ssim_weight: Share = 0.2
    background: Colour = BLACK
    seed: int = 0
    engine: Engine = "fused"


@dataclass(frozen=True)
class RecoverConfig(FitConfig):
    """Options of recovery, in addition to `FitConfig`.

    Args:
        schedule: rates, number of steps and decay.
        steps: number of steps; overrides the schedule's.
        recovery_time: time limit in seconds instead of steps; the result then depends on the machine's speed.
        regularizers: weights of L_anchor and L_shape (`tab:s_recovery`).
        from_points: whether the start is points found in photos, so that steps grow with their count.
        final: whether this is the recovery at the target count; the paper's rounds have another decay.

    Raises:
        InputError: a value out of range.
    """

    schedule: Schedule = TUNED
    steps: AtLeastOne | None = None
    recovery_time: Positive | None = None
    regularizers: Regularizers = REGULARIZERS["trained"]
    from_points: bool = field(default=False, metadata={"setting": False})
    final: bool = field(default=True, metadata={"setting": False})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps is not None and self.recovery_time is not None:
            raise InputError(
                "steps and recovery_time exclude each other; give one", parameter="steps"
            )

    @property
    def horizon(self) -> int:
        """Number of steps of this recovery."""
        if self.steps is not None:
            return self.steps
        if self.final:
            return self.schedule.steps
        return self.schedule.round_steps

    def final_steps(self, scene: Splats, cameras: Cameras, *, of_photos: bool) -> int:
        """Return the steps of the last recovery: as set, the schedule's, or more by need.

        More are needed for points of photos, and for renders of which each shows little of the scene.
        """
        schedule = self.schedule
        if self.steps is not None:
            return self.steps
        if schedule.means_in_scales and self.from_points:
            return count_steps_from_points(len(scene), schedule.steps)
        if not schedule.means_in_scales or of_photos:
            return schedule.steps
        return count_steps_for_renders(scene, cameras, schedule.steps * schedule.for_renders)
