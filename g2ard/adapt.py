"""New appearance on frozen geometry: what a compact map is reused for (`tab:geobase`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.recover import RecoverConfig, recover
from g2ard.recover.anchors import Regularizers
from g2ard.recover.schedule import PAPER, TUNED, Schedule
from g2ard.splats import Splats
from g2ard.targets import Targets

__all__ = ["AdaptConfig", "Adapted", "adapt"]

_FIRST_STRETCH = 500
_FREE = Regularizers(anchor=0.0, shape=0.0, effective_rank=False)
"""Geometry that cannot move needs nothing to hold it."""


@dataclass(frozen=True)
class AdaptConfig:
    """How appearance is refitted.

    Args:
        steps: at most; 7,000 as in the paper.
        tolerance: dB; a stretch of steps that gains less on the training views is the last; 0 takes all.
        schedule: "default" takes stretches of 500, 1,000, 2,000 … steps, each under a cosine; "paper" takes
            all steps at its rates, which decay to a tenth.
        sh_degree: of the result; None keeps the scene's. A scene without higher bands has no place for shine.
        background: RGB behind the scene.
        seed: of the order of views.

    Raises:
        InputError: no steps, or a negative tolerance.
    """

    steps: int = 7000
    tolerance: float = 0.05
    schedule: Literal["default", "paper"] = "default"
    sh_degree: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or not self.tolerance >= 0:
            raise InputError(f"adapt: {self.steps} steps, tolerance {self.tolerance}: expected ≥ 1 and ≥ 0")
        if self.schedule not in ("default", "paper"):
            raise InputError(f"schedule: expected default or paper, got {self.schedule!r}")

    def stretches(self) -> list[int]:
        """Steps of each stretch, doubling; what would be left over for a shorter one joins the last.

        >>> AdaptConfig().stretches(), AdaptConfig(steps=600).stretches()
        ([500, 1000, 2000, 3500], [600])
        """
        if self.schedule == "paper":
            return [self.steps]
        out, length, left = [], _FIRST_STRETCH, self.steps
        while left >= 2 * length:
            out.append(length)
            left -= length
            length *= 2
        return [*out, left]


@dataclass(frozen=True, eq=False)
class Adapted:
    """A scene with new appearance.

    Args:
        splats: means, rotations and scales of the scene given, bit for bit; new SH and opacities.
        report: steps, seconds, converged, psnr {before, after} over a sample of the training views, and
            stretches [{steps, psnr}].
    """

    splats: Splats
    report: dict[str, Any] = field(default_factory=dict)


def adapt(
    compact: Splats, targets: Targets, config: AdaptConfig | None = None, *, progress: Progress = silent
) -> Adapted:
    """Refit spherical harmonics and opacities to targets; means, rotations and scales stay.

    L = (1−λ)·L1 + λ·(1−SSIM) as in recovery; its anchors have nothing to hold here. What the result shows
    on other trajectories is a direct reading of the geometry's worth.

    Args:
        compact: the scene; its offset counts, cameras are in world coordinates.
        targets: photos, or renders of a scene with the wanted appearance.
        config: see `AdaptConfig`.
        progress: told of every step.

    Returns:
        An `Adapted` with as many Gaussians, in their order.

    Raises:
        InputError: no Gaussians or no views.
    """
    config = config or AdaptConfig()
    base = PAPER if config.schedule == "paper" else TUNED
    state = compact if config.sh_degree is None else compact.with_sh_degree(config.sh_degree)
    first: float | None = None
    stretches: list[dict[str, Any]] = []
    seconds, converged = 0.0, False
    lengths = config.stretches()
    for number, steps in enumerate(lengths):
        done = recover(
            state,
            targets,
            RecoverConfig(
                schedule=_appearance_only(base),
                steps=steps,
                regularizers=_FREE,
                background=config.background,
                seed=config.seed + number,
            ),
            progress=progress,
            stage="adapt",
        )
        before, after = done.report["psnr"]["before"], done.report["psnr"]["after"]
        first = before if first is None else first
        state = replace(done.splats, means=compact.means, quats=compact.quats, scales=compact.scales)
        stretches.append({"steps": steps, "psnr": after})
        seconds += done.report["seconds"]
        converged = after - before < config.tolerance
        if converged:
            break
    return Adapted(
        state,
        {
            "steps": sum(s["steps"] for s in stretches),
            "seconds": seconds,
            "converged": converged,
            "psnr": {"before": first, "after": stretches[-1]["psnr"]},
            "stretches": stretches,
        },
    )


def _appearance_only(schedule: Schedule) -> Schedule:
    return replace(schedule, rates=replace(schedule.rates, means=0.0, log_scales=0.0, quats=0.0))
