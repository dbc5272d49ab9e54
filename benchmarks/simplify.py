"""Every simplifier at hand, as its user runs it: file to file, a process each, scored on unseen views."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import baselines
from benchmarks import rows as table
from benchmarks.methods import REDUCERS
from benchmarks.process import check_measurable, measured
from benchmarks.raster import cpu_name
from benchmarks.standing import check_protocol, standing_targets
from g2ard import __version__, io
from g2ard.errors import InputError
from g2ard.poses import make_pool
from g2ard.progress import Progress, silent
from g2ard.scene.splats import Splats
from g2ard.scene.splits import split_mask, splits_of
from g2ard.scene.targets import TeacherRenders
from g2ard.stages.evaluate import evaluate

__all__ = [
    "Cell",
    "bench_simplify",
    "find_splat_transform",
    "machine",
    "scene_label",
]

_POOL = 128
_MAX_LOGIT = 20.0
"""An opacity of exactly 1 has no finite logit; here it is 1 − 2e-9, which every peer can read."""


@dataclass(frozen=True)
class Cell:
    """One method on one scene at one ratio; a row of the CSV.

    Args:
        scene: its file's or folder's name (`scene_label`).
        input_count: Gaussians before.
        budget: Gaussians asked for.
        count: Gaussians in the method's output.
        cpu_s: user + system seconds of the whole command, its start and files included.
        wall_s: the same by the clock.
        peak_mb: largest resident size, 10⁶ bytes.
        psnr: mean over the unseen views, dB, against the scene itself.
        ssim: the same.
        views: how many were scored.
        version: of the method's program.
        machine: processor and cores.
        error: why there are no figures; "" if there are.
        views_kind: what it was scored on: "pool", "near" or "standing".
    """

    scene: str
    ratio: float
    method: str
    input_count: int
    budget: int
    count: int | None = None
    cpu_s: float | None = None
    wall_s: float | None = None
    peak_mb: float | None = None
    psnr: float | None = None
    ssim: float | None = None
    views: int | None = None
    version: str = ""
    machine: str = ""
    error: str = ""
    views_kind: str = "pool"

    @property
    def key(self) -> tuple[str, float, str, str]:
        """What tells it from other rows."""
        return self.scene, self.ratio, self.method, self.views_kind


def scene_label(path: Path) -> str:
    """A short name that tells scenes apart: a folder's with its parent's, a file's without its extension.

    >>> scene_label(Path("data/guitar.compressed.ply"))
    'guitar'
    """
    return f"{path.absolute().parent.name}/{path.name}" if path.is_dir() else path.name.split(".")[0]


def machine() -> str:
    """Processor and cores, as recorded in every row."""
    return f"{cpu_name()}, {os.cpu_count()} cores"


def bench_simplify(
    scenes: Sequence[Path],
    csv_path: Path,
    *,
    ratios: Sequence[float] = (5, 10, 20, 30),
    methods: Sequence[str] = REDUCERS,
    views: Path | None = None,
    splat_transform: Path | None = None,
    seed: int = 0,
    protocol: str = "pool",
    progress: Progress = silent,
) -> list[Cell]:
    """Measure every scene × ratio × method that `csv_path` does not hold yet; append rows as they are done.

    The scene is written as .ply once; each method reads that and writes its own. Under the protocol "pool"
    every 8th of a pool of 128 poses is scored, or the views' own test split; `default` gets the others, so
    nothing it used is scored. Under "standing" each method runs as its user runs it (`default` with a pool
    of its own, unless `views` are given) and is scored on views of other kinds, which it never sees, one row
    each (`benchmarks.standing.standing_views`). "both" is both.

    Args:
        scenes: anything `g2ard.io.read_scene` reads.
        csv_path: where the rows go. Rows without an error are kept and not measured again; failed ones are.
        ratios: the budget is round(N / ratio).
        methods: of `benchmarks.methods.REDUCERS`; leave out peers that are not installed.
        views: to train and score on; None makes a pool for each scene.
        splat_transform: its program; needed for its two methods.
        seed: of the pool.
        protocol: "pool", "standing" or "both".
        progress: told after each cell.

    Returns:
        The rows of these scenes, ratios and methods; a method that fails is a row with its error.

    Raises:
        InputError: a scene, the views or the CSV cannot be read, an unknown method or protocol.
        G2ardError: the system does not tell what a process took (Windows).
    """
    check_measurable()
    kinds = check_protocol(protocol)
    unknown = [m for m in methods if m not in REDUCERS]
    if unknown:
        raise InputError(f"methods: expected some of {', '.join(REDUCERS)}, got {', '.join(unknown)}")
    done = {cell.key: cell for cell in table.read(csv_path, Cell) if not cell.error}
    table.rewrite(csv_path, done.values(), Cell)
    wanted = [
        (p, (scene_label(p), float(r), m, k)) for p in scenes for r in ratios for m in methods for k in kinds
    ]
    total, finished = len(wanted), sum(key in done for _, key in wanted)
    versions = {m: _version(m, splat_transform) for m in methods}
    for scene in scenes:
        missing: dict[tuple[str, float, str], list[str]] = {}
        for path, key in wanted:
            if path == scene and key not in done:
                missing.setdefault(key[:3], []).append(key[3])
        if not missing:
            continue
        with tempfile.TemporaryDirectory(prefix="g2ard-bench-") as folder:
            workspace = _Workspace(Path(folder), scene, views, splat_transform, seed, kinds)
            for name, some in missing.items():
                about: dict[str, Any] = {"version": versions[name[2]], "machine": machine()}
                cells = [replace(cell, **about) for cell in workspace.measure(*name, some)]
                table.append(csv_path, cells)
                done |= {cell.key: cell for cell in cells}
                finished += len(cells)
                progress("bench simplify", finished, total, {name[0]: f"{name[1]:g}× {name[2]}"})
    return [done[key] for _, key in wanted]


class _Workspace:
    """One scene, written out, with its views; measures methods on it."""

    def __init__(
        self,
        folder: Path,
        scene: Path,
        views: Path | None,
        splat_transform: Path | None,
        seed: int,
        kinds: Sequence[str],
    ) -> None:
        self.folder, self.given, self.seed = folder, views, seed
        self.splats, self.splat_transform = _readable(scene), splat_transform
        self.source, self.targets = folder / "scene.ply", dict[str, TeacherRenders]()
        io.write_splats(self.source, self.splats)
        if "pool" in kinds:
            found = self.pool
            test = split_mask(views, found.cameras.names, "test", stated=found.splits)
            self.targets["pool"] = TeacherRenders(self.splats, found.cameras.take(test), lazy=True)
        if set(kinds) - {"pool"}:
            self.targets |= standing_targets(self.splats, scene, seed)

    @cached_property
    def pool(self) -> io.ViewSet:
        return _views(self.splats, self.given, self.seed)

    @cached_property
    def views(self) -> Path:
        path = self.folder / "views.json"
        io.write_views(path, self.pool.cameras, splits=self.pool.splits)
        return path

    def measure(self, scene: str, ratio: float, method: str, kinds: Sequence[str]) -> list[Cell]:
        """A row for each kind of views; what is run alike for several runs once."""
        n = len(self.splats)
        budget = max(1, int(np.floor(n / ratio + 0.5)))
        ran: dict[bool, tuple[dict[str, Any], Splats | None]] = {}
        cells = []
        for kind in kinds:
            cell = Cell(scene, ratio, method, n, budget, views_kind=kind)
            if kind not in self.targets:
                cells.append(replace(cell, error=f"no place for {kind} views"))
                continue
            own = kind != "pool" and method == "default" and self.given is None
            if own not in ran:
                ran[own] = self.run(method, budget, own)
            figures, small = ran[own]
            if small is not None:
                score = evaluate(small, self.targets[kind])
                figures = {**figures, "psnr": score.psnr, "ssim": score.ssim, "views": len(score.views)}
            cells.append(replace(cell, **figures))
        return cells

    def run(self, method: str, budget: int, own: bool) -> tuple[dict[str, Any], Splats | None]:
        """What it took and made, or the error."""
        output = self.folder / "out.ply"
        output.unlink(missing_ok=True)
        try:
            usage = measured(self.command(method, budget, output, own), self.folder / "log")
            small = io.read_splats(output)
        except (InputError, OSError) as e:
            return {"error": " ".join(str(e).split())}, None
        return {**asdict(usage), "count": len(small)}, small

    def command(self, method: str, budget: int, output: Path, own: bool) -> list[str]:
        """As its user would type it; `own`: with the views that it makes itself."""
        source, python = str(self.source), [sys.executable, "-m"]
        if method.startswith("splat-transform"):
            if self.splat_transform is None:
                raise InputError("splat-transform: not found")
            mode = "--decimate-adaptive" if method.endswith("adaptive") else "--decimate"
            options = [str(self.splat_transform), "-q", "-w", "-g", "cpu"]
            return [*options, source, mode, str(budget), str(output)]
        if method in baselines.METHODS:
            views = ["--views", str(self.views)] if method in baselines.NEED_VIEWS else []
            return [*python, "benchmarks.baselines", method, source, str(budget), str(output), *views]
        flags = {
            "default": [] if own else ["--views", str(self.views)],
            "no-views": ["--no-views"],
            "fast": ["--method", "fast"],
            "paper": ["--method", "paper"],
        }[method]
        return [*python, "g2ard", "simplify", source, "-n", str(budget), "-o", str(output), "-q", *flags]


def _readable(scene: Path) -> Splats:
    splats = io.read_splats(scene)
    return replace(splats, logit_opacities=np.clip(splats.logit_opacities, -_MAX_LOGIT, _MAX_LOGIT))


def _views(splats: Splats, views: Path | None, seed: int) -> io.ViewSet:
    """The views given, or a pool; each with its split."""
    found = io.ViewSet(make_pool(splats, _POOL, seed=seed)) if views is None else io.read_view_set(views)
    return replace(found, splits=splits_of(views, found.cameras.names, found.splits))


def _version(method: str, splat_transform: Path | None) -> str:
    if not method.startswith("splat-transform"):
        return f"g2ard {__version__}"
    if splat_transform is None:
        return ""
    told = subprocess.run(
        [splat_transform, "--version"], capture_output=True, encoding="utf-8", errors="replace", check=False
    )
    lines = (told.stdout or told.stderr).splitlines()
    return lines[0].strip() if lines else ""


def find_splat_transform(given: Path | None) -> Path | None:
    """The program given, else the one on PATH; None without either."""
    found = shutil.which(given or "splat-transform")
    if given is not None and found is None:
        raise InputError(f"{given}: no such program")
    return Path(found) if found else None
