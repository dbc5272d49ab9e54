"""Study of devices: a recovery step by kernel, and a short distillation by stage."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import g2ard._core as _core
from benchmarks.baselines import mcmc
from benchmarks.kinds.raster import GPU, built_in_view, drawn, timed_step
from benchmarks.process import measured
from benchmarks.rows import Row
from benchmarks.score import figures, score
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import Workspace, budget_of
from g2ard.errors import InputError
from g2ard.system import devices

__all__ = ["Devices"]

_STAGES = {
    "project": ("splat",),
    "sort": ("count", "expand", "starts"),
    "draw": ("draw",),
    "loss": ("weigh", "compare", "total", "gradient"),
    "backward": ("backward",),
    "update": ("update",),
}
"""Stage of a step → its kernels, without the prefix `train.`; all other kernels sort."""


@dataclass(frozen=True)
class Devices(Study):
    """A study of a recovery step and of a short `g2ard distill`, in a process of its own, by device.

    Args:
        methods: "cpu"; "gpu", the best adapter, even a software one; "gsplat", a plain loop around gsplat's
            rasteriser that trains as many Gaussians anew, skipped if gsplat or CUDA is missing.
        steps: of the distillation and of the loop.
        image: width and height of the view of the timed step, for scenes without views.
        repeats: timed steps; the fastest is recorded.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {name: name for name in ("cpu", "gpu", "gsplat")}

    steps: int = key(200, least=1)
    image: tuple[int, int] = key((640, 480), least=1)
    repeats: int = key(15, least=1)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio and device."""
        place = Workspace(work, self, scene)
        names = {"cpu": _core.instruction_sets()[0], "gsplat": "gsplat"}
        if "gpu" in self.methods:
            adapters = devices.adapters()
            if not adapters:
                raise InputError("no adapter, or a build without GPU kernels", parameter="methods")
            names["gpu"] = GPU + adapters[0].name
        for ratio in self.ratios:
            for device in self.methods:
                if device != "gsplat" or mcmc.has_gsplat():
                    cell = {"ratio": ratio, "isa": names[device], "threads": _core.num_threads()}
                    yield Cell(cell, partial(self._measured, place, ratio, device))

    def _measured(self, place: Workspace, ratio: float, device: str) -> list[Row]:
        budget = budget_of(len(place.splats), ratio)
        if device == "gsplat":
            return [self._loop(place, budget)]
        return [{**self._step(place, budget, device), **self._distilled(place, budget, device)}]

    def _step(self, place: Workspace, budget: int, device: str) -> Row:
        """Time steps on a random subset of the scene, on a GPU each kernel too."""
        splats = place.splats
        view = place.train_cameras if place.scene.train else built_in_view(splats, *self.image)
        measure = partial(timed_step, drawn(splats, budget, seed=self.seeds[0]), view)
        isa = None if device == "gpu" else _core.instruction_sets()[0]
        try:
            devices.use(device)
            row = measure(isa, self.repeats)
            if device == "gpu":
                devices.use(device, timed=True)
                measure(isa, self.repeats)
                row |= _by_stage(devices.state().seconds, self.repeats)
        finally:
            devices.use("cpu")
        return row

    def _distilled(self, place: Workspace, budget: int, device: str) -> Row:
        """Run `g2ard distill` on a device."""
        scene = place.scene
        with tempfile.TemporaryDirectory(prefix="g2ard-devices-") as folder:
            out = Path(folder) / "run"
            options = {
                "-n": budget,
                "--steps": self.steps,
                "--seed": self.seeds[0],
                "--threads": _core.num_threads(),
                "--device": device,
                "-o": out,
            }
            if scene.train is not None:
                options["--views"] = place.place / scene.train
            if self.size is not None:
                options["--size"] = self.size
            flat = [str(part) for option in options.items() for part in option]
            command = [
                sys.executable,
                "-m",
                "g2ard",
                "distill",
                str(place.place / scene.prior),
                *flat,
            ]
            usage = measured([*command, "--no-page", "-w"], Path(folder) / "log")
            report = json.loads((out / "report.json").read_text(encoding="utf-8"))
            log = (Path(folder) / "log").read_text(encoding="utf-8", errors="replace")
        if "GPU: " in log:
            raise InputError(next(line for line in log.splitlines() if "GPU: " in line))
        seconds, scores = report["seconds"], report["scores"]["recovered"]
        took = sum(one["seconds"] for each in report["rounds"] for one in each["recover"])
        return {
            "count": report["output_count"],
            "steps": self.steps,
            "steps_per_s": self.steps / took,
            "targets_s": seconds["targets"],
            "simplify_s": seconds["simplify"],
            "recover_s": seconds["recover"],
            "score_s": seconds["score"],
            "wall_s": usage.wall_s,
            "cpu_s": usage.cpu_s,
            "peak_mb": usage.peak_mb,
            "psnr": scores["psnr"],
            "ssim": scores["ssim"],
        }

    def _loop(self, place: Workspace, budget: int) -> Row:
        """Train anew with gsplat's rasteriser, without anything of g2ard in the steps."""
        background = place.scene.background
        targets = place.targets(place.train_cameras)
        made, seconds = mcmc.train(
            place.splats, budget, targets, self.steps, gsplat=True, background=background
        )
        scored = figures(score(made, place.targets(next(iter(place.scored.values()))), background))
        return {
            "count": len(made),
            "steps": self.steps,
            "steps_per_s": self.steps / seconds,
            "psnr": scored["psnr"],
            "ssim": scored["ssim"],
        }


def _by_stage(seconds: Mapping[str, float], steps: int) -> Row:
    """Return milliseconds per step by stage, from seconds by kernel.

    >>> _by_stage({"train.splat": 0.1, "scan": 0.2, "train.draw": 0.4}, 100)["sort_ms"]
    2.0
    """
    stage_of = {
        f"train.{kernel}": stage for stage, kernels in _STAGES.items() for kernel in kernels
    }
    row = {f"{stage}_ms": 0.0 for stage in _STAGES}
    for kernel, spent in seconds.items():
        row[f"{stage_of.get(kernel, 'sort')}_ms"] += 1e3 * spent / steps
    return row
