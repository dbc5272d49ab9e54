"""Methods on scenes at ratios under matched compute: every cell a row, resumable, with its pictures."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from g2ard import __version__, baselines, io
from g2ard.baselines.pup import rounds as pup_rounds
from g2ard.bench.definition import Definition, Matched, MethodSpec, SceneSpec
from g2ard.bench.process import Usage
from g2ard.bench.score import Scored, pictured, save_jpeg, score
from g2ard.bench.simplify import machine
from g2ard.bench.stand import Stage, Stand, fingerprint
from g2ard.errors import G2ardError, InputError
from g2ard.io.atomic import atomic_output
from g2ard.lpips import Lpips, load_lpips
from g2ard.progress import Progress, silent
from g2ard.recover.presets import preset_for
from g2ard.simplify import METHODS as SIMPLIFIERS
from g2ard.simplify import schedule as paper_rounds

__all__ = ["Cell", "Row", "bench_run", "cells_of", "read_rows", "write_csv"]

_SURVEY = {
    "submethod": "Submethod",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_vgg": "LPIPS",
    "bytes": "Size [Bytes]",
    "count": "#Gaussians",
}
"""Columns that bear the 3DGS compression survey's names, so that its plots take the file as it is."""


@dataclass(frozen=True)
class Row:
    """One cell's figures on one set of views; a line of the CSV.

    Args:
        study: the definition's name.
        scene: the scene's.
        prior: given, lift or trained.
        method: the method's name.
        ratio: prior over compact.
        matched: "steps", "seconds" or "released".
        amount: how many of them.
        seed: of the cell.
        split: which views were scored.
        against: "photos" or "teacher"; the two are never comparable.
        submethod: method and budget in one word.
        input_count: Gaussians before.
        budget: Gaussians asked for.
        count: Gaussians of the result.
        bytes: of the result as float32 arrays, the form a .ply holds.
        psnr: mean over the views, dB.
        ssim: the same.
        lpips_vgg: the same; None without weights.
        lpips_alex: the same.
        luma_drift: mean of |mean luma of the render − the target's|.
        drift95: of the last recovery, in thicknesses of its anchors.
        needle: share of needles.
        views: how many were scored.
        steps: optimiser steps taken.
        reduce_cpu_s: user + system seconds of all reductions, each a whole process.
        reduce_wall_s: by the clock, without a program's start and its files: in one process there is one
            start however many the rounds. A rival program's whole.
        reduce_peak_mb: of the largest.
        recover_cpu_s: of all recoveries, whole processes.
        recover_wall_s: of their loops alone, which is what a limit in seconds counts.
        recover_peak_mb: of the largest.
        adapt_cpu_s: of the adaptation.
        cpu_s: of reductions and recoveries.
        seconds: reduce_wall_s + recover_wall_s.
        version: of g2ard.
        machine: processor and cores.
        error: why there are no figures; "" if there are.
    """

    study: str
    scene: str
    prior: str
    method: str
    ratio: float
    matched: str
    amount: float
    seed: int
    split: str
    against: str
    submethod: str = ""
    input_count: int | None = None
    budget: int | None = None
    count: int | None = None
    bytes: int | None = None
    psnr: float | None = None
    ssim: float | None = None
    lpips_vgg: float | None = None
    lpips_alex: float | None = None
    luma_drift: float | None = None
    drift95: float | None = None
    needle: float | None = None
    views: int | None = None
    steps: int | None = None
    reduce_cpu_s: float | None = None
    reduce_wall_s: float | None = None
    reduce_peak_mb: float | None = None
    recover_cpu_s: float | None = None
    recover_wall_s: float | None = None
    recover_peak_mb: float | None = None
    adapt_cpu_s: float | None = None
    cpu_s: float | None = None
    seconds: float | None = None
    version: str = ""
    machine: str = ""
    error: str = ""


@dataclass(frozen=True)
class Cell:
    """What is to be measured, and where its answer lies."""

    definition: Definition
    scene: SceneSpec
    ratio: float
    method: MethodSpec
    matched: Matched
    seed: int

    @cached_property
    def key(self) -> str:
        """Changes with anything that could change the figures."""
        d = self.definition
        shared = (d.name, d.schedule, d.size, d.sh_degree, d.adapt_steps, d.lpips, __version__)
        parts = [asdict(self.scene), asdict(self.method), asdict(self.matched), self.ratio, self.seed]
        return fingerprint([*shared, *parts])

    @property
    def label(self) -> str:
        return f"{self.scene.name} {self.ratio:g}× {self.method.name} ({self.matched.label})"


def bench_run(
    definitions: Sequence[Definition],
    folder: Path,
    *,
    keep: bool = False,
    progress: Progress = silent,
) -> list[Row]:
    """Measure every cell of some studies that `folder` does not hold yet.

    All methods get the same prior, exact budget, training views, optimiser and steps or seconds; each
    reduction and recovery is a process of its own. What a cell found is written as it is done (cells/,
    images/); rows.csv is made anew after each. A cell that fails is a row with its error, and is tried again
    by the next call.

    Args:
        definitions: the studies.
        folder: of the run; need not exist.
        keep: whether intermediate scenes (work/) stay once all cells are done.
        progress: told of every cell.

    Returns:
        The rows, in the order of the definitions.

    Raises:
        InputError: LPIPS weights that cannot be read. Anything else is an error of its cell.
        KeyboardInterrupt: after Ctrl-C; the next call goes on.
    """
    cells = cells_of(definitions)
    (folder / "cells").mkdir(parents=True, exist_ok=True)
    weights = {d.lpips: load_lpips(d.folder / d.lpips) for d in definitions if d.lpips is not None}
    stand: Stand | None = None
    for number, cell in enumerate(cells):
        progress("bench", number, len(cells), {"cell": cell.label})
        if _done(folder, cell):
            continue
        try:
            if stand is None or (stand.definition, stand.scene) != (cell.definition, cell.scene):
                stand = Stand(folder / "work", cell.definition, cell.scene)
            answer = _measure(stand, cell, folder, weights.get(cell.definition.lpips or "", {}))
        except (G2ardError, OSError, MemoryError) as error:
            stand = None
            answer = {"rows": [asdict(_failed(cell, error))], "views": {}}
        _write_json(folder / "cells" / f"{cell.key}.json", {**answer, "label": cell.label})
        write_csv(folder / "rows.csv", _rows(folder, cells))
    progress("bench", len(cells), len(cells), {})
    rows = _rows(folder, cells)
    write_csv(folder / "rows.csv", rows)
    if not keep and not any(row.error for row in rows):
        shutil.rmtree(folder / "work", ignore_errors=True)
    return rows


def cells_of(definitions: Sequence[Definition]) -> list[Cell]:
    """All cells of some studies, in the order they are measured."""
    return [Cell(d, *what) for d in definitions for what in d.cells()]


def _done(folder: Path, cell: Cell) -> bool:
    rows = _read_cell(folder, cell)
    return bool(rows) and not any(row.error for row in rows)


def _read_cell(folder: Path, cell: Cell) -> list[Row]:
    path = folder / "cells" / f"{cell.key}.json"
    return [Row(**row) for row in json.loads(path.read_text())["rows"]] if path.exists() else []


def _rows(folder: Path, cells: Sequence[Cell]) -> list[Row]:
    return [row for cell in cells for row in _read_cell(folder, cell)]


def _head(cell: Cell, prior: str, split: str) -> Row:
    return Row(
        study=cell.definition.name,
        scene=cell.scene.name,
        prior=prior,
        method=cell.method.name,
        ratio=cell.ratio,
        matched=cell.matched.kind,
        amount=cell.matched.amount,
        seed=cell.seed,
        split=split,
        against=cell.scene.targets,
        submethod=f"{cell.method.name}-{cell.ratio:g}x-{cell.matched.label.replace(' ', '')}",
        version=f"g2ard {__version__}",
        machine=machine(),
    )


def _failed(cell: Cell, error: BaseException) -> Row:
    text = " ".join(str(error).split()) or type(error).__name__
    return replace(_head(cell, cell.method.prior or "", ""), error=text)


@dataclass
class _Spent:
    """What the stages of one kind took together."""

    cpu: float = 0.0
    wall: float = 0.0
    peak: float = 0.0

    def add(self, usage: Usage, wall: float | None = None) -> None:
        self.cpu += usage.cpu_s
        self.wall += usage.wall_s if wall is None else wall
        self.peak = max(self.peak, usage.peak_mb)


def _measure(stand: Stand, cell: Cell, folder: Path, lpips: dict[str, Lpips]) -> dict[str, Any]:
    work = _Pipeline(stand, cell)
    result = work.run()
    splats = io.read_splats(result.output)
    if len(splats) != work.budget:
        raise InputError(f"{len(splats)} Gaussians came out, {work.budget} were asked for")
    figures = {
        "input_count": work.count,
        "budget": work.budget,
        "count": len(splats),
        "bytes": splats.nbytes,
        "drift95": work.last.get("drift95"),
        "needle": work.last.get("needle"),
        "steps": work.steps,
        "reduce_cpu_s": work.reducing.cpu,
        "reduce_wall_s": work.reducing.wall,
        "reduce_peak_mb": work.reducing.peak,
        "recover_cpu_s": work.recovering.cpu,
        "recover_wall_s": work.recovering.wall,
        "recover_peak_mb": work.recovering.peak,
        "adapt_cpu_s": work.adapting.cpu if cell.definition.adapt_steps else None,
        "cpu_s": work.reducing.cpu + work.recovering.cpu,
        "seconds": work.reducing.wall + work.recovering.wall,
    }
    rows, views = [], {}
    for split, targets in stand.test.items():
        _picture_targets(folder, stand, split)
        pictures = folder / "images" / cell.key / split
        scored = score(splats, targets, cell.scene.background, lpips=lpips, pictures=pictures)
        measured: dict[str, Any] = {**figures, **_means(scored)}
        rows.append(asdict(replace(_head(cell, work.prior, split), **measured)))
        views[split] = [asdict(view) for view in scored.views]
    return {"rows": rows, "views": views, "scene_key": stand.key}


def _means(scored: Scored) -> dict[str, Any]:
    names = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
    means: dict[str, Any] = {name: scored.mean(name) for name in names}
    return {**means, "luma_drift": scored.luma_drift, "views": len(scored.views)}


def _picture_targets(folder: Path, stand: Stand, split: str) -> None:
    targets = stand.test[split]
    for view in pictured(len(targets.cameras)):
        path = folder / "images" / stand.key / split / f"{view}.jpg"
        if not path.exists():
            save_jpeg(path, targets[view])


class _Pipeline:
    """One cell's stages, from the prior to the scene that is scored."""

    def __init__(self, stand: Stand, cell: Cell) -> None:
        self.stand, self.cell = stand, cell
        self.source = stand.prior(cell.method.prior)
        self.prior = cell.method.prior or stand.kinds[0]
        splats = io.read_splats(self.source.output)
        self.count = len(splats)
        self.budget = max(1, math.floor(self.count / cell.ratio + 0.5))
        self.regularizers = self._regularizers(splats)
        self.sh_degree = cell.definition.sh_degree
        if self.sh_degree is None and cell.scene.targets == "photos":
            self.sh_degree = 3
        self.reducing, self.recovering, self.adapting = _Spent(), _Spent(), _Spent()
        self.steps = 0
        self.last: dict[str, Any] = {}

    def _regularizers(self, prior: Any) -> dict[str, Any]:
        method = self.cell.method
        chosen, _ = preset_for(method.preset, prior)
        if method.anchor is not None:
            chosen = replace(chosen, anchor=method.anchor)
        if method.shape is not None:
            chosen = replace(chosen, shape=method.shape, effective_rank=method.shape > 0)
        return asdict(chosen)

    def counts(self) -> list[int]:
        """Of each round; the last is the budget."""
        rounds = self.cell.method.rounds
        if rounds == "paper":
            return paper_rounds(self.count, self.budget) or [self.budget]
        return pup_rounds(self.count, self.budget) if rounds == "pup" else [self.budget]

    def run(self) -> Stage:
        """The scene that is scored."""
        method, stand = self.cell.method, self.stand
        views = stand.train
        if method.policy is not None:
            views = stand.select(self.source, method.policy, method.k, self.cell.seed)
        state, flags = self.source, None
        counts = self.counts()
        for number, count in enumerate(counts):
            state = self._reduce(state, views, count, flags)
            if method.reduce in (*SIMPLIFIERS, "no-views"):
                flags = state.output.with_name("flags.npy")
            state = self._recover(state, views, number, len(counts))
        if self.cell.definition.adapt_steps:
            state = stand.readapt(state, self.sh_degree, self.cell.seed)
            self.adapting.add(state.usage)
        return state

    def _reduce(self, state: Stage, views: Path, count: int, flags: Path | None) -> Stage:
        method = self.cell.method
        job: dict[str, Any] = {"method": method.reduce, "count": count, "seed": self.cell.seed}
        if method.reduce not in baselines.METHODS:
            job |= {"budget": self.budget, "protection": method.protection}
        done = self.stand.reduce(state, views, job, flags)
        self.reducing.add(done.usage, done.report.get("seconds"))
        return done

    def _recover(self, state: Stage, views: Path, number: int, rounds: int) -> Stage:
        spend = self._spend(number, rounds)
        if spend is None:
            return state
        job = {
            **spend,
            "regularizers": self.regularizers,
            "sh_degree": self.sh_degree,
            "final": number == rounds - 1,
            "seed": self.cell.seed,
        }
        done = self.stand.recover(state, views, job)
        self.recovering.add(done.usage, done.report["seconds"])
        self.steps += done.report["steps"]
        self.last = done.report
        return done

    def _spend(self, number: int, rounds: int) -> dict[str, Any] | None:
        """Rates, and steps or seconds, of the recovery after a round; None where there is none."""
        method, matched = self.cell.method, self.cell.matched
        final = number == rounds - 1
        if matched.kind == "released":
            if not method.released_steps:
                return None
            steps = method.released_steps if final or method.rounds == "pup" else 8_000
            return {"schedule": method.released_schedule, "steps": steps, "seconds": None}
        schedule = self.cell.definition.schedule
        early = method.round_share / (rounds - 1) if rounds > 1 else 0.0
        if matched.kind == "steps":
            each = int(early * matched.amount)
            steps = int(matched.amount) - each * (rounds - 1) if final else each
            return {"schedule": schedule, "steps": steps, "seconds": None} if steps else None
        left = matched.amount - self.reducing.wall - self.recovering.wall
        if left <= 0:
            raise InputError(
                f"no time left to recover: reduction took {self.reducing.wall:.1f} of {matched.amount:g} s"
            )
        remaining = 1 - early * number
        limit = left if final else left * early / remaining
        return {"schedule": schedule, "steps": None, "seconds": round(limit, 3)}


def read_rows(path: Path) -> list[Row]:
    """The rows of a run's rows.csv.

    Raises:
        InputError: it is not one that `bench_run` wrote.
    """
    types = {f.name: str(f.type) for f in fields(Row)}
    names = {_SURVEY.get(name, name): name for name in types}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            if set(lines.fieldnames or ()) != set(names):
                raise InputError(f"{path}: not a CSV of `g2ard bench run`")
            return [Row(**{names[k]: _typed(v, types[names[k]]) for k, v in line.items()}) for line in lines]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: not a CSV of `g2ard bench run`: {error}") from None


def _typed(text: str, kind: str) -> Any:
    if kind == "str":
        return text
    if not text:
        return None
    return int(text) if kind.startswith("int") else float(text)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows, whole or not at all."""
    with atomic_output(path, overwrite=True) as temporary, temporary.open("w", newline="") as file:
        names = [f.name for f in fields(Row)]
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([_SURVEY.get(name, name) for name in names])
        for row in rows:
            values = [getattr(row, name) for name in names]
            writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in values])


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(content))
