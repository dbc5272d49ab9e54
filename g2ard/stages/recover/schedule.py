"""Learning rates of each attribute, and numbers of steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from g2ard.errors import require

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

_REACH = 0.01
"""Gaussians larger than a hundredth of the image hardly move, unless that is the scene's typical size."""

_UNTRAINED_RMSE = 0.1
"""A start further from its targets must yet become surfaces: large Gaussians have to move."""

_POINTS = 4096
"""Gaussians by which `steps_for` measures views."""

_MOST_TIMES = 2.25
"""Times the schedule's steps, at most: recovery must end in minutes."""


@dataclass(frozen=True)
class Rates:
    """Adam's learning rate of each attribute, in the space it is optimised in.

    What is large in a step's view hardly moves: a Gaussian whose largest standard deviation there
    is σ, as a share of the image's longer side, takes steps of 1/(1 + (σ/reach)¹⁶) times the rate in means
    and rotations, and each of its scales by the σ of that axis alone (`recover.extent`). Many layers
    that move together, as those of a sky do, move the image by the sum of their steps.

    Args:
        means: of the Gaussian's own radius when the schedule says `means_in_scales`, else scene units.
        log_scales: natural-log units.
        quats: components of the unnormalised quaternion.
        logit_opacities: logits.
        sh0: band-0 coefficients.
        shN: higher-band coefficients.
        reach: share of the image's longer side; infinite lets all sizes learn alike. The schedule says it.

    Raises:
        InputError: a value out of range.
    """

    means: float
    log_scales: float
    quats: float
    logit_opacities: float
    sh0: float
    shN: float
    reach: float = field(default=math.inf, metadata={"setting": False})

    def __post_init__(self) -> None:
        for name in ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN"):
            value = getattr(self, name)
            require(name, value, 0 <= value < math.inf, "a rate, at least 0")
        require("reach", self.reach, self.reach > 0, "more than 0")

    def scaled(self, geometry: float, appearance: float) -> Rates:
        """Means, scales and rotations times `geometry`; opacity and SH times `appearance`."""
        return Rates(
            self.means * geometry,
            self.log_scales * geometry,
            self.quats * geometry,
            self.logit_opacities * appearance,
            self.sh0 * appearance,
            self.shN * appearance,
            self.reach,
        )


@dataclass(frozen=True)
class Schedule:
    """Rates and their decay over a horizon fixed in advance.

    Args:
        rates: at the first step.
        steps: the horizon of the final (or only) recovery.
        round_steps: recovery steps of each intermediate round; 0 recovers at the final count only.
        means_in_scales: `rates.means` is a share of each Gaussian's radius, the geometric mean of its longer
            scales, so that the step does not depend on the scene's unit.
        cosine_floor: every rate follows a cosine down to this share of itself; None keeps geometry constant.
        appearance_decay: (rounds, final) share that appearance rates decay to exponentially; 1 keeps them.
        multiplier: of all rates; None chooses it by short trials, which begin at `multiplier_for`.
        reach: see `Rates`; None chooses by the start (`reach_for`).
        reference_extent: `rates.means` holds where the cameras' extent (`Cameras.extent`) is this many scene
            units, and in proportion elsewhere, so that the scene's unit does not matter; None takes it in
            scene units whatever they are.
        guarded: whether a recovery that loses goes back to the best scene, or to its start; else all steps
            are taken and kept.

    Raises:
        InputError: a value out of range.
    """

    rates: Rates
    steps: int
    round_steps: int = 0
    means_in_scales: bool = True
    cosine_floor: float | None = 0.01
    appearance_decay: tuple[float, float] = (1.0, 1.0)
    multiplier: float | None = None
    reach: float | None = None
    reference_extent: float | None = None
    guarded: bool = True

    def __post_init__(self) -> None:
        require("steps", self.steps, self.steps >= 1, "at least 1")
        require("round_steps", self.round_steps, self.round_steps >= 0, "at least 0")
        floor, decay = self.cosine_floor, self.appearance_decay
        require("cosine_floor", floor, floor is None or 0 <= floor <= 1, "a value in [0, 1], or none")
        require("appearance_decay", decay, all(0 < d <= 1 for d in decay), "two values in (0, 1]")
        for name in ("multiplier", "reach", "reference_extent"):
            value = getattr(self, name)
            require(name, value, value is None or value > 0, "more than 0, or none")

    @classmethod
    def named(cls, name: str) -> Schedule:
        """Return a schedule of `SCHEDULES`.

        Raises:
            InputError: an unknown name.

        >>> Schedule.named("default").steps
        1000
        """
        require("schedule", repr(name), name in SCHEDULES, f"one of {', '.join(SCHEDULES)}")
        return SCHEDULES[name]

    def within(self, extent: float) -> Schedule:
        """The schedule for cameras of this extent; where they all stand in one place the rate stays as it is.

        >>> PAPER.within(11.5).rates.means / PAPER.rates.means, TUNED.within(11.5) == TUNED
        (2.0, True)
        """
        if self.reference_extent is None or not extent > 0:
            return self
        means = self.rates.means * extent / self.reference_extent
        return replace(self, rates=replace(self.rates, means=means))

    def scaled(self, steps: int) -> Schedule:
        """The same schedule over a final horizon of `steps`, the rounds' in proportion.

        >>> PAPER.scaled(3000).round_steps
        800
        """
        share = steps / self.steps
        rounds = max(1, round(self.round_steps * share)) if self.round_steps else 0
        return replace(self, steps=steps, round_steps=rounds)

    def at(self, t: float, *, final: bool, multiplier: float = 1.0, reach: float = math.inf) -> Rates:
        """The rates at the share `t` of the horizon, from 0 at the first step to 1 after the last."""
        cosine = 1.0
        if self.cosine_floor is not None:
            cosine = self.cosine_floor + (1 - self.cosine_floor) * 0.5 * (1 + math.cos(math.pi * t))
        decay = self.appearance_decay[1 if final else 0] ** t
        return replace(self.rates.scaled(cosine * multiplier, cosine * decay * multiplier), reach=reach)


TUNED = Schedule(
    rates=Rates(means=0.05, log_scales=6e-2, quats=1.5e-2, logit_opacities=7e-2, sh0=3e-2, shN=3e-3),
    steps=1000,
)
"""Rates in the Gaussian's own unit and a cosine to 1 %; `docs/decisions.md` holds the figures behind it."""

PAPER = Schedule(
    rates=Rates(means=9.2e-4, log_scales=5e-3, quats=1e-3, logit_opacities=5e-3, sh0=2.5e-3, shN=1.25e-4),
    steps=30_000,
    round_steps=8_000,
    means_in_scales=False,
    cosine_floor=None,
    appearance_decay=(0.36, 0.1),
    multiplier=1.0,
    reach=math.inf,
    reference_extent=5.75,
    guarded=False,
)
"""The supplement's `tab:s_config`: 8,000 steps a round, 30,000 at the end; the rates it leaves out are 3DGS's
own. Its rate of means bears no unit: 3DGS's is 1.6e-4 times the cameras' extent, 9.2e-4 is that at an extent
of 5.75, and so it is read here (`docs/decisions.md`). `PAPER.scaled(3000)` is the same at a tenth of the
length."""

SCHEDULES: dict[str, Schedule] = {
    "fast": replace(TUNED, steps=300),
    "default": TUNED,
    "best": replace(TUNED, steps=6000),
    "paper": PAPER,
}


def multiplier_for(start_rmse: float, least: float = 1 / 3) -> float:
    """A guess at the rate multiplier from the RMSE before recovery: 1 from 0.039 up, a third from 0.013 down.

    The better a start already is, the smaller the steps that improve it. A third is the `least` that trials
    begin at; where there is no time for trials, starts that are nearly there want less.

    >>> multiplier_for(0.05), round(multiplier_for(0.026), 3), round(multiplier_for(0.001), 3)
    (1.0, 0.667, 0.333)
    """
    return min(1.0, max(least, start_rmse / 0.039))


def reach_for(start_rmse: float, typical: float) -> float:
    """`Schedule.reach` of a start: .01, or the typical size if that is more; no limit for an untrained start.

    Args:
        start_rmse: before recovery.
        typical: see `g2ard.stages.recover.sizes.typical_share`.

    >>> reach_for(0.02, 0.005), reach_for(0.05, 0.04), reach_for(0.15, 0.005)
    (0.01, 0.04, inf)
    """
    return max(_REACH, typical) if start_rmse < _UNTRAINED_RMSE else math.inf


def steps_for(scene: Splats, cameras: Cameras, steps: int) -> int:
    """Return `steps` times 1/√share for views that hold a share of the scene.

    An object is whole in every view of an orbit; in a room or on a path a view holds a tenth. At equal steps
    its Gaussians would learn a tenth as often; the root is the middle between that and equal time.

    Args:
        scene: what is to be recovered.
        cameras: the views it learns from, in world coordinates.
        steps: the schedule's.

    Returns:
        Between `steps` and 2.25 times that.

    >>> import numpy as np
    >>> from g2ard.scene.cameras import Cameras, look_at
    >>> from g2ard.scene.splats import Splats
    >>> line = Splats.create([[0, 0, 0], [9, 0, 0], [0, 0, 9], [-9, 0, 0]], scales=np.ones((4, 3)))
    >>> K = [[50, 0, 32], [0, 50, 32], [0, 0, 1]]
    >>> view = Cameras.from_lists([look_at([0, -3, 0], [0, 0, 0])], [K], [(64, 64)], ["a"])
    >>> steps_for(line, view, 1000)
    2000
    """
    import numpy as np

    some = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), _POINTS)).round().astype(int))
    points = scene.means[some].astype(np.float64) + scene.offset
    return round(steps / math.sqrt(max(cameras.usual_share(points), 1 / _MOST_TIMES**2)))
