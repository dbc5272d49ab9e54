"""Options of recovery."""

from __future__ import annotations

from dataclasses import dataclass, field

from g2ard.config.checks import AtLeastOne, Degree, Positive, Share
from g2ard.config.choices import BLACK, Colour, Engine
from g2ard.config.schema import Settings
from g2ard.errors import InputError
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats
from g2ard.stages.recover.anchors import REGULARIZERS, Regularizers
from g2ard.stages.recover.schedule import TUNED, Schedule, steps_for, steps_from_points


@dataclass(frozen=True)
class FitConfig(Settings):
    """Options of every fit to images.

    Args:
        sh_degree: SH degree of the result; None keeps the scene's. Highlights need higher bands.
        ssim_weight: λ in (1−λ)·L1 + λ·(1−SSIM); 0.2 as in 3DGS.
        background: RGB behind the scene.
        seed: seed of the order of views.
        engine: "fused" runs whole steps in Rust, or on the GPU in use; "torch" uses autograd over the Rust
            rasteriser and `SelectiveAdam`, with equal results up to rounding; "gsplat" is the same on an
            NVIDIA GPU.

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
            raise InputError("steps and recovery_time exclude each other; give one", parameter="steps")

    @property
    def horizon(self) -> int:
        """Number of steps of this recovery."""
        if self.steps is not None:
            return self.steps
        return self.schedule.steps if self.final else self.schedule.round_steps

    def final_steps(self, scene: Splats, cameras: Cameras, *, photos: bool) -> int:
        """Return the steps of the last recovery: as set, the schedule's, or more by need.

        More are needed for points of photos, and for renders of which each shows little of the scene.
        """
        schedule = self.schedule
        if self.steps is not None:
            return self.steps
        if schedule.means_in_scales and self.from_points:
            return steps_from_points(len(scene), schedule.steps)
        if not schedule.means_in_scales or photos:
            return schedule.steps
        return steps_for(scene, cameras, schedule.steps)
