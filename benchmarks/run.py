"""Methods on scenes at ratios under matched compute: every cell a row, resumable, with its pictures."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from benchmarks.definition import Definition
from benchmarks.pipeline import Cell, Pipeline
from benchmarks.process import check_measurable
from benchmarks.run_rows import Row, with_deltas, write_csv
from benchmarks.score import Scored, pictured, save_jpeg, score
from benchmarks.simplify import machine
from benchmarks.workspace import Workspace, folder_of
from g2ard import __version__, io
from g2ard.errors import InputError
from g2ard.io.atomic import atomic_output
from g2ard.progress import Progress, silent
from g2ard.rendering.lpips import Lpips, load_lpips
from g2ard.stages.recover.anchors import needle

__all__ = ["bench_run", "cells_of"]


def bench_run(
    definitions: Sequence[Definition],
    folder: Path,
    *,
    keep: bool = False,
    again: bool = False,
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
        keep: whether these studies' intermediate scenes, in work/, stay once all cells are done.
        again: measure what `folder` holds anew.
        progress: told of every cell.

    Returns:
        The rows, in the order of the definitions.

    Raises:
        InputError: a path with an environment variable that is not set, LPIPS weights that cannot be
            read. What goes wrong in a cell is its row's error.
        G2ardError: the system does not tell what a process took (Windows).
        KeyboardInterrupt: after Ctrl-C; the next call goes on.
    """
    check_measurable()
    for definition in definitions:
        definition.require_variables()
    cells = cells_of(definitions)
    (folder / "cells").mkdir(parents=True, exist_ok=True)
    weights = {
        (d.lpips, d.lpips_input): load_lpips(d.folder / d.lpips, scaled=d.lpips_input == "scaled")
        for d in definitions
        if d.lpips is not None
    }
    workspace: Workspace | None = None
    if again:
        for definition in definitions:
            for scene in definition.scenes:
                shutil.rmtree(folder_of(folder / "work", definition, scene) / "stages", ignore_errors=True)
    for number, cell in enumerate(cells):
        progress("bench", number, len(cells), {"cell": cell.label})
        if not again and _done(folder, cell):
            continue
        try:
            if workspace is None or (workspace.definition, workspace.scene) != (cell.definition, cell.scene):
                workspace = Workspace(folder / "work", cell.definition, cell.scene)
            networks = weights.get((cell.definition.lpips or "", cell.definition.lpips_input), {})
            answer = _measure(workspace, cell, folder, networks)
        except Exception as error:  # one cell must not end hours of others; its row and the exit status tell
            workspace = None
            answer = {"rows": [asdict(_failed(cell, error))], "views": {}}
        _write_json(folder / "cells" / f"{cell.key}.json", {**answer, "label": cell.label})
        write_csv(folder / "rows.csv", _rows(folder, cells) + _others(folder, cells))
    progress("bench", len(cells), len(cells), {})
    rows = _rows(folder, cells)
    write_csv(folder / "rows.csv", rows + _others(folder, cells))
    if not keep and not any(row.error for row in rows):
        for definition in definitions:
            for scene in definition.scenes:
                shutil.rmtree(folder_of(folder / "work", definition, scene), ignore_errors=True)
        with suppress(OSError):  # others' work stays
            (folder / "work").rmdir()
    return rows


def cells_of(definitions: Sequence[Definition]) -> list[Cell]:
    """All cells of some studies, in the order they are measured."""
    return [Cell(d, *what) for d in definitions for what in d.cells()]


def _done(folder: Path, cell: Cell) -> bool:
    rows = _read_cell(folder, cell)
    return bool(rows) and not any(row.error for row in rows)


def _read_cell(folder: Path, cell: Cell) -> list[Row]:
    path = folder / "cells" / f"{cell.key}.json"
    return (
        [Row(**row) for row in json.loads(path.read_text(encoding="utf-8"))["rows"]] if path.exists() else []
    )


def _rows(folder: Path, cells: Sequence[Cell]) -> list[Row]:
    return with_deltas([row for cell in cells for row in _read_cell(folder, cell)])


def _others(folder: Path, cells: Sequence[Cell]) -> list[Row]:
    """Rows of what else `folder` holds, by study and label; of one cell measured on other files, the last."""
    ours = {(cell.definition.name, cell.label, cell.seed) for cell in cells}
    found: dict[tuple[str, str, int], list[Row]] = {}
    for path in sorted((folder / "cells").glob("*.json"), key=lambda p: p.stat().st_mtime_ns):
        held = json.loads(path.read_text(encoding="utf-8"))
        rows = [Row(**row) for row in held["rows"]]
        if rows:
            found[rows[0].study, held["label"], rows[0].seed] = rows
    return with_deltas([row for key in sorted(found) if key not in ours for row in found[key]])


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


def _measure(workspace: Workspace, cell: Cell, folder: Path, lpips: dict[str, Lpips]) -> dict[str, Any]:
    work = Pipeline(workspace, cell)
    result = work.run()
    splats = io.read_splats(result.output)
    if len(splats) != work.budget:
        raise InputError(f"{len(splats)} Gaussians came out, {work.budget} were asked for")
    figures = {
        "input_count": work.count,
        "budget": work.budget,
        "count": len(splats),
        "bytes": splats.nbytes,
        "drift95": work.last.get("drift95", 0.0),  # what was not recovered has not moved
        "needle": needle(splats.scales),
        "steps": work.steps,
        "reduce_cpu_s": work.reducing.cpu,
        "reduce_wall_s": work.reducing.wall,
        "reduce_peak_mb": work.reducing.peak,
        "recover_cpu_s": work.recovering.cpu,
        "recover_wall_s": work.recovering.wall,
        "recover_peak_mb": work.recovering.peak,
        "select_cpu_s": work.selecting.cpu if cell.method.policy else None,
        "select_peak_mb": work.selecting.peak if cell.method.policy else None,
        "adapt_cpu_s": work.adapting.cpu if cell.definition.adapt_steps else None,
        "adapt_peak_mb": work.adapting.peak if cell.definition.adapt_steps else None,
        "cpu_s": work.selecting.cpu + work.reducing.cpu + work.recovering.cpu,
        "seconds": work.selecting.wall + work.reducing.wall + work.recovering.wall,
    }
    rows, views = [], {}
    for split, targets in workspace.test.items():
        _picture_targets(folder, workspace, split)
        pictures = folder / "images" / cell.key / split
        scored = score(
            splats,
            targets,
            cell.scene.background,
            lpips=lpips,
            settings=workspace.settings,
            eight_bit=cell.definition.eight_bit,
            pictures=pictures,
        )
        measured: dict[str, Any] = {**figures, **_means(scored)}
        rows.append(asdict(replace(_head(cell, work.prior, split), **measured)))
        views[split] = [asdict(view) for view in scored.views]
    return {"rows": rows, "views": views, "scene_key": workspace.key, "dropped": workspace.dropped}


def _means(scored: Scored) -> dict[str, Any]:
    names = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
    means: dict[str, Any] = {name: scored.mean(name) for name in names}
    counted = {"views": len(scored.counted), "black": scored.black}
    return {**means, **counted, "luma_drift": scored.luma_drift}


def _picture_targets(folder: Path, workspace: Workspace, split: str) -> None:
    targets = workspace.test[split]
    for view in pictured(len(targets.cameras)):
        path = folder / "images" / workspace.key / split / f"{view}.jpg"
        if not path.exists():
            save_jpeg(path, targets[view])


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(content), encoding="utf-8", newline="\n")
