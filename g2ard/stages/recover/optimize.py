"""Recovery: fixed topology, one view per step, anchors frozen at the start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from numpy.typing import ArrayLike

from g2ard.arrays import Mask
from g2ard.errors import InputError
from g2ard.progress import Progress, plural, silent
from g2ard.rendering.exposure import Exposure
from g2ard.rendering.targets import RENDERS, Targets, fingerprint_of, kinds_of
from g2ard.scene.cameras import unseeing
from g2ard.scene.shape import needle_share
from g2ard.scene.splats import Splats, unit_quats
from g2ard.stages.recover.anchors import Anchors, drift95
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.guard import Guard
from g2ard.stages.recover.loop import Loop, Watch, check_weights, write_finite
from g2ard.stages.recover.probe import Probe, find_harmful_changes, score_by_kind
from g2ard.stages.recover.report import Gain, Geometry, Look, RecoverReport, Trial, Validation
from g2ard.system.shown import Shown

__all__ = ["Recovered", "Watch", "recover"]

_SAME_PSNR = 10 * math.log10(12 * 255**2)
"""PSNR from which no image can show a gain, 58.9 dB: the error of rounding to 8 bits."""


@dataclass(frozen=True, eq=False)
class Recovered(Shown):
    """A recovered scene and a report.

    Args:
        splats: the scene, in count and order of the student.
        report: figures of the recovery.
    """

    splats: Splats
    report: RecoverReport

    def __repr__(self) -> str:
        done = self.report
        return f"Recovered({plural(len(self.splats), 'Gaussian')}, {done.psnr}, {plural(done.steps, 'step')})"


def recover(
    student: Splats,
    targets: Targets,
    config: RecoverConfig | None = None,
    *,
    weights: ArrayLike | None = None,
    anchors: Anchors | None = None,
    validation: Targets | None = None,
    frozen: Mask | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
    stage: str = "recover",
    watch: Watch | None = None,
    skip_same: bool = False,
    time_left: Callable[[], float] | None = None,
) -> Recovered:
    """Optimise every attribute of a fixed set of Gaussians against targets (`eq:objective`).

    L = (1−λ)·L1 + λ·(1−SSIM), plus λ_a·L_anchor + λ_s·L_shape every `period` steps. If PSNR on a sample of
    training views falls below the student's, recovery returns to the best scene and continues at a third of
    the learning rates. A schedule that is not `guarded`, such as the paper's, always takes all its steps.

    Args:
        student: the scene; the result has the offset and float32 means of `student.narrowed()`.
        validation: views of other kinds (`Cameras.kinds`) than `targets`, such as near ones, not trained on.
            Changes are scaled back per Gaussian by how often it was seen, as far as these views gain, and
            Gaussians that made them worse go back (`recover.guard`). At most eight views per kind are scored
            during the steps.
        stage: stage name for progress.
        skip_same: take no step if the student already renders as the targets.
        time_left: returns the time limit in seconds when the steps begin, in place of the config's.

    Other arguments, results and errors are those of `g2ard.recover`.
    """
    config = config or RecoverConfig()
    student = student.narrowed()
    unit = unit_quats(student.quats)
    if unit is not student.quats:
        student = replace(student, quats=unit)
    if not len(student) or not len(targets.cameras):
        raise InputError(
            f"nothing to recover: got {len(student)} Gaussians and {len(targets.cameras)} views"
        )
    if not targets.cameras.facing(student.positions).any():
        raise InputError(unseeing(targets.cameras, "the scene"))
    if frozen is not None and (config.engine != "fused" or frozen.shape != (len(student),)):
        raise InputError(
            f"expected shape ({len(student)},) and engine fused, got {frozen.shape} and {config.engine}",
            parameter="frozen",
        )
    if config.sh_degree is not None:
        student = student.with_sh_degree(config.sh_degree)
    anchors = anchors or Anchors.of(student, config.regularizers.in_plane)
    if not config.schedule.guarded:
        validation = None
    probe = Probe(targets, config.background)
    progress(stage, 0, 0)
    before = probe.score(student)
    view_weights = check_weights(weights, len(targets.cameras))
    exact = skip_same and before >= _SAME_PSNR and config.schedule.guarded
    if exact:
        validation = None
    if validation is None:
        others = None
    else:
        others = score_by_kind(validation, config.background)

    def harmful(scene: Splats) -> Mask | None:
        if validation is None:
            return None
        return find_harmful_changes(student, scene, validation, targets, config.background)

    guard = Guard(
        probe.score,
        student,
        before,
        others,
        harmful,
        config.schedule.guarded,
    )
    if validation is None:
        validation_key = None
    else:
        validation_key = fingerprint_of(validation)
    end = result = student
    after = before
    blend = 1.0
    seen = None
    loop = Loop(
        student,
        targets,
        config,
        view_weights,
        anchors,
        probe,
        guard,
        validation_key,
        frozen,
        time_left,
    )
    if not exact:
        if checkpoint is None or not checkpoint.exists():
            loop.choose_rates(before)
        end, seen = loop.run(checkpoint, progress, stage, watch)
        progress(stage, 0, 0)
        result, after, blend = guard.choose_by_training(end)
    limited = config.recovery_time is not None and not exact
    if limited and result is end:
        pace = guard.measure_pace(loop.done, after)
    else:
        pace = None
    prior_views: float | None = 0.0
    if result is end and seen is not None:
        result, prior_views = guard.choose_by_validation(end, seen, loop.done)
        if result is not end:
            after = probe.score(result)
            blend = float(result is not student)
    validated = None
    if validation is not None:
        if prior_views is None:
            shrunk = None
        else:
            shrunk = write_finite(prior_views)
        validated = Validation(tuple(map(Look.of, guard.validation)), shrunk)
    return Recovered(
        result,
        RecoverReport(
            steps=loop.done,
            seconds=loop.seconds,
            loss=loop.curve(),
            psnr=Gain(guard.before, after, probe.scored_in),
            multiplier=loop.multiplier,
            reach=write_finite(loop.reach),
            extent=targets.cameras.extent,
            trials=tuple(map(Trial.of, loop.trials)),
            drift95=drift95(anchors, result.means),
            needle=needle_share(result.scales),
            geometry=tuple(map(Geometry.of, loop.geometry)),
            regularizers=loop.regularizers,
            backed_off=tuple(map(Look.of, loop.guard.backed_off)),
            stopped=loop.guard.stopped,
            blend=blend,
            kept_start=blend == 0,
            validation=validated,
            skipped={"non_finite": loop.skipped},
            exposure=None if loop.exposures is None else Exposure.over(loop.exposures, targets),
            resumed=loop.resumed,
            planned=_count_planned_steps(config, student, targets) if limited else None,
            pace=pace,
        ),
    )


def _count_planned_steps(config: RecoverConfig, student: Splats, targets: Targets) -> int:
    """Return the steps that a recovery takes without a time limit."""
    if not config.final:
        return config.horizon
    return config.final_steps(student, targets.cameras, of_photos=kinds_of(targets) != RENDERS)
