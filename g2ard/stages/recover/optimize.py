"""Recovery: fixed topology, one view a step, anchors frozen at the start."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.scene.cameras import unseeing
from g2ard.scene.splats import Splats
from g2ard.scene.targets import Targets, fingerprint_of
from g2ard.stages.recover.anchors import Anchors, drift95, needle
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.draw import checked_weights
from g2ard.stages.recover.guard import Guard
from g2ard.stages.recover.loop import Loop, Watch, finite
from g2ard.stages.recover.probe import Probe
from g2ard.stages.recover.report import (
    Gain,
    Geometry,
    Look,
    RecoverReport,
    Regularized,
    Trial,
    Validation,
)

__all__ = ["Recovered", "Watch", "recover"]


@dataclass(frozen=True, eq=False)
class Recovered:
    """The recovered scene and what recovery did.

    Args:
        splats: same count and order as the student.
        report: what was done, in numbers.
    """

    splats: Splats
    report: RecoverReport


def recover(
    student: Splats,
    targets: Targets,
    config: RecoverConfig | None = None,
    *,
    weights: ArrayLike | None = None,
    anchors: Anchors | None = None,
    validation: Targets | None = None,
    frozen: NDArray[np.bool_] | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
    stage: str = "recover",
    watch: Watch | None = None,
) -> Recovered:
    """Optimise every attribute of a fixed set of Gaussians against targets (`eq:objective`).

    L = (1−λ)·L1 + λ·(1−SSIM), and every `period` steps + λ_a·L_anchor + λ_s·L_shape. No Gaussian is added
    or removed. Where the steps lose against the student, by PSNR of some training views, recovery goes back,
    and on with a third of the rates; a student that is only made worse is returned as it is.
    A schedule that is not `guarded`, as the paper's, takes all its steps, whatever comes of them.

    Args:
        student: the scene to recover; its offset counts, cameras are in world coordinates.
        targets: photos or teacher renders with their cameras.
        config: see `RecoverConfig`.
        weights: (C,) how often each view is drawn, in proportion; None draws all equally often.
        anchors: frozen geometry; None freezes the student as given. A student that has been recovered before
            wants those of its construction.
        validation: a few views of another kind than `targets` (nearer, or from where people stand), never
            learned from: where they lose, they decide how much of what the steps changed stays, Gaussian by
            Gaussian as it was seen (`recover.guard`), and end a recovery that they only lose by. At
            most eight are looked at.
        frozen: (N,) bool, Gaussians of the student that stay as they are, such as those of another tile; the
            engine must be `fused`. None freezes none.
        checkpoint: a file written every minute and at Ctrl-C; if it is there, recovery goes on from it, and
            the result is bitwise that of never having stopped.
        progress: told of every step, with loss, PSNR of a few training views and steps/s.
        stage: the name progress is reported under.
        watch: called after every step; the time it takes does not count.

    Returns:
        A `Recovered` with as many Gaussians as the student, in its order.

    Raises:
        InputError: no Gaussians, no views, weights that are none, or a checkpoint of another run.
        KeyboardInterrupt: after Ctrl-C, once the checkpoint is written.
    """
    config = config or RecoverConfig()
    if not len(student) or not len(targets.cameras):
        raise InputError(f"{len(student)} Gaussians and {len(targets.cameras)} views: nothing to recover")
    if not targets.cameras.facing(student.means.astype(np.float64) + student.offset).any():
        raise InputError(unseeing(targets.cameras, "the scene"))
    if frozen is not None and (config.engine != "fused" or frozen.shape != (len(student),)):
        raise InputError(
            f"expected bool of shape ({len(student)},) and the engine fused, got {frozen.shape} and "
            f"{config.engine}",
            parameter="frozen",
        )
    if config.sh_degree is not None:
        student = student.with_sh_degree(config.sh_degree)
    anchors = anchors or Anchors.of(student, config.regularizers.in_plane)
    validation = validation if config.schedule.guarded else None
    probe = Probe(targets, config.background)
    before = probe.all_of(student)
    often = checked_weights(weights, len(targets.cameras))
    others = None if validation is None else Probe(validation, config.background).all_of
    guard = Guard(probe.all_of, student, before, others, config.schedule.guarded)
    judged_by = None if validation is None else fingerprint_of(validation)
    loop = Loop(student, targets, config, often, anchors, probe, guard, judged_by, frozen)
    if checkpoint is None or not checkpoint.exists():
        loop.choose_rates(before)
    loop.run(checkpoint, progress, stage, watch)
    end = loop.engine.splats()
    result, after, blend = guard.judge(end)
    prior_views: float | None = 0.0
    if result is end and validation is not None:
        result, prior_views = guard.settle(end, loop.views_seen, loop.done)
        if result is not end:
            after, blend = probe.all_of(result), float(result is not student)
    return Recovered(
        result,
        RecoverReport(
            steps=loop.done,
            seconds=loop.seconds,
            loss=loop.curve(),
            psnr=Gain(before, after),
            multiplier=loop.multiplier,
            reach=finite(loop.reach),
            extent=targets.cameras.extent,
            trials=tuple(map(Trial.of, loop.trials)),
            drift95=drift95(anchors, result.means),
            needle=needle(result.scales),
            geometry=tuple(map(Geometry.of, loop.geometry)),
            regularizers=Regularized.of(loop.regularizers),
            backed_off=tuple(map(Look.of, loop.guard.backed_off)),
            stopped=loop.guard.stopped,
            blend=blend,
            kept_start=blend == 0,
            validation=None
            if validation is None
            else Validation(
                tuple(map(Look.of, guard.validation)), None if prior_views is None else finite(prior_views)
            ),
            skipped={"non_finite": loop.skipped},
            resumed=loop.resumed,
        ),
    )
