"""Steps from scene to scene, whose results a folder keeps by content."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from g2ard.arrays import Values
from g2ard.progress import Progress, silent
from g2ard.rendering.targets import Targets, fill, fingerprint_of
from g2ard.scene.splats import ARRAYS, Splats
from g2ard.stages.recover import checkpoint
from g2ard.stages.recover.anchors import Anchors
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import recover
from g2ard.stages.recover.report import RecoverReport
from g2ard.stages.simplify.reduce import SimplifyReport
from g2ard.system.keys import key_of

R = TypeVar("R", RecoverReport, SimplifyReport)
_Result = tuple[Splats, R, dict[str, Values]]
_WITHIN = ".checkpoint.npz"


class Steps:
    """Steps of a run: each is computed unless the folder, if any, holds its result.

    A result's file name contains a hash of the step's scene, settings and other inputs, so a run with other
    settings computes only the steps that depend on them. `resumed` is the time in seconds that earlier calls
    spent on these steps, None without any; `filling` the time spent on rendering targets.
    """

    def __init__(self, folder: Path | None, progress: Progress = silent) -> None:
        self._folder = folder
        self._progress = progress
        self.resumed: float | None = None
        self.filling = 0.0

    def run(
        self,
        name: str,
        scene: Splats,
        settings: Callable[[], object],
        kind: type[R],
        step: Callable[[Path | None], _Result[R]],
    ) -> _Result[R]:
        """Return the scene after a step, a report of this kind, and other arrays.

        Args:
            settings: returns all that the result depends on besides `scene`, see `key_of`.
            step: takes the file for checkpoints within the step.
        """
        if self._folder is None:
            return step(None)
        key = key_of([name, scene, settings()])
        file, within = (self._folder / f"{name}-{key}{end}" for end in (".npz", _WITHIN))
        for each in (file, within):
            checkpoint.drop_damaged(each)
        if file.exists():
            meta, arrays = checkpoint.load(file, key)
            made = replace(scene, **{array: arrays.pop(array) for array in ARRAYS})
            result = made, kind.of(meta["report"]), arrays
            self._count(result[1].seconds)
        else:
            made, report, others = result = step(within)
            kept = {array: getattr(made, array) for array in ARRAYS}
            checkpoint.save(file, key, {"report": report.as_dict()}, {**kept, **others})
            self._count(getattr(report, "resumed", None))
        within.unlink(missing_ok=True)
        return result

    def recover(
        self,
        name: str,
        student: Splats,
        targets: Targets,
        config: RecoverConfig,
        *,
        built: Splats | None = None,
        weights: Values | None = None,
        validation: Targets | None = None,
        filled: bool = True,
        **options: Any,
    ) -> tuple[Splats, RecoverReport]:
        """Recover a scene, like `recover`.

        Args:
            built: the scene before any recovery.
            filled: whether to render targets first, see `fill`.
        """

        def settings() -> object:
            views = [
                None if each is None else fingerprint_of(each) for each in (targets, validation)
            ]
            return config, views, built, weights

        def step(within: Path | None) -> _Result[RecoverReport]:
            if filled:
                self.fill(targets, validation)
            options["anchors"] = (
                None if built is None else Anchors.of(built, config.regularizers.in_plane)
            )
            options.update(weights=weights, validation=validation, checkpoint=within)
            options.setdefault("progress", self._progress)
            done = recover(student, targets, config, **options)
            return done.splats, done.report, {}

        return self.run(name, student, settings, RecoverReport, step)[:2]

    def fill(self, *targets: Targets | None) -> None:
        """Render targets before steps that must run, so that all of them take equal time."""
        began = time.monotonic()
        for each in filter(None, targets):
            fill(each, self._progress)
        self.filling += time.monotonic() - began

    def _count(self, seconds: float | None) -> None:
        if seconds is not None:
            self.resumed = (self.resumed or 0.0) + seconds
