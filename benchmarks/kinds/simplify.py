"""Study of simplifiers as users run them: from file to file in a process, scored on held-out views."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from benchmarks import baselines
from benchmarks.kinds.methods import REDUCERS
from benchmarks.process import Usage, measured, splat_transform, version_of
from benchmarks.rows import Row
from benchmarks.score import figures, score
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import PROTOCOLS, Workspace, budget_of, kinds_for
from g2ard import io
from g2ard.scene.splats import Splats

__all__ = ["Simplify"]

_SPARK = ["node", str(Path(baselines.__file__).with_name("spark.mjs"))]
_SPLAT_TRANSFORM = ("splat-transform", "splat-transform-adaptive")
_FLAGS = {
    "default": [],
    "no-views": ["--no-views"],
    "fast": ["--method", "fast"],
    "paper": ["--method", "paper"],
}
"""Method of g2ard → its flags."""
_GROWTHS = {f"growth-{growth:g}": growth for growth in (1, 1.25, 1.6, 2, 2.5, 3.2, 4)}
"""`default` with one growth for all merged Gaussians, instead of one that depends on their surroundings."""
_FLAGS |= {
    name: ["--set", "surface_depth=inf", "--set", f"max_growth={growth:g}"]
    for name, growth in _GROWTHS.items()
}
_DISTIL = {
    "distill-60": ["--steps", "60"],
    "distill-240": ["--steps", "240"],
    "distill-fast": ["--schedule", "fast"],
    "distill": [],
    "distill-best": ["--schedule", "best"],
}
"""`distill` by its flags: what recovery adds, in views of its own."""
_OWN = ("default", *_GROWTHS)
"""Methods that look from views of their own."""


@dataclass(frozen=True)
class Simplify(Study):
    """A study of simplifiers without recovery; `distill` can join them.

    Scored are every 8th pose of a generated pool, or the test split of the scene's views, which no method
    uses. "near" and "standing" views are of other kinds than any that a method sees; on them `default` runs
    with a pool of its own, as its user runs it.

    Args:
        protocol: kinds of views to score: "pool", "standing" (near and standing views), "anywhere", "other"
            (these three), or "all".
        scales: multiples of the views' size at which they are scored, with a row each.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {
        name: name for name in (*REDUCERS, "spark", *_GROWTHS, *_DISTIL)
    }
    PROCESSES: ClassVar[bool] = True

    protocol: str = key("all", choices=tuple(PROTOCOLS), axis=True)
    scales: tuple[float, ...] = key((1.0,), least=0.1)

    @classmethod
    def default_methods(cls) -> list[str]:
        """Return all methods, except other programs that are not installed."""
        missing = set[str]() if shutil.which("splat-transform") else {*_SPLAT_TRANSFORM}
        if not (shutil.which("node") and version_of(*_SPARK).startswith("Spark")):
            missing.add("spark")
        return [name for name in cls.METHODS if name not in (*missing, *_GROWTHS, *_DISTIL)]

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per ratio and method."""
        place, kinds = Workspace(work, self, scene), kinds_for(self.protocol, scene)
        for ratio in self.ratios:
            for method in self.methods:
                names = {"ratio": ratio, "method": method}
                yield Cell(names, partial(self._measured, place, ratio, method, kinds), kinds)

    def _measured(
        self, place: Workspace, ratio: float, method: str, kinds: tuple[str, ...]
    ) -> Iterator[Row]:
        budget = budget_of(len(place.splats), ratio)
        # methods that run alike for several kinds run once
        ran: dict[bool, tuple[Usage, Splats]] = {}
        for kind in kinds:
            row = {"views_kind": kind, "input_count": len(place.splats), "budget": budget}
            if method.startswith("splat-transform"):
                row["version"] = version_of(splat_transform()[0])
            if method == "spark":
                row["version"] = version_of(*_SPARK)
            if kind not in place.kinds_of_views:
                yield {**row, "views": 0}  # no place for them in this scene
                continue
            own = kind != "pool" and method in _OWN and place.scene.train is None
            if own not in ran:
                ran[own] = self._run(place, method, budget, own)
            usage, small = ran[own]
            for scale in self.scales:
                scored = score(small, place.scaled(kind, scale), place.scene.background)
                told = {"scale": scale} if len(self.scales) > 1 else {}
                yield {**row, **told, **asdict(usage), "count": len(small), **figures(scored)}

    def _run(self, place: Workspace, method: str, budget: int, own: bool) -> tuple[Usage, Splats]:
        with tempfile.TemporaryDirectory(prefix="g2ard-bench-") as folder:
            output = Path(folder) / ("run" if method in _DISTIL else "out.ply")
            usage = measured(
                self._command(place, method, budget, output, own), Path(folder) / "log"
            )
            return usage, io.read_splats(output / "scene.ply" if method in _DISTIL else output)

    def _command(
        self, place: Workspace, method: str, budget: int, output: Path, own: bool
    ) -> list[str]:
        """Return the command as its user types it; `own` means with the views that it makes itself."""
        source, python = str(place.prior_file), [sys.executable, "-m"]
        if method.startswith("splat-transform"):
            mode = "--decimate-adaptive" if method.endswith("adaptive") else "--decimate"
            return splat_transform(source, mode, str(budget), str(output))
        if method == "spark":
            return [*_SPARK, source, str(budget), str(output)]
        if method in baselines.METHODS:
            job = {"kind": "reduce", "method": method, "count": budget, "seed": 0, "scene": source}
            job |= {"views": str(place.train), "indoor": place.scene.indoor, "output": str(output)}
            path = output.with_name("job.json")
            path.write_text(json.dumps(job), encoding="utf-8", newline="\n")
            return [*python, "benchmarks.kinds.worker", str(path)]
        if method in _DISTIL:
            command = [*python, "g2ard", "distill", source, "-n", str(budget), "--views", "made"]
            return [*command, *_DISTIL[method], "--device", "cpu", "-q", "-o", str(output)]
        views = ["--views", str(place.train)] if method in _OWN and not own else []
        command = [*python, "g2ard", "simplify", source, "-n", str(budget), "-o", str(output), "-q"]
        return [*command, *_FLAGS[method], *views]
