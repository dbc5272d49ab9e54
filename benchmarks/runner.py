"""Runner of all benchmarks, which measures each cell once and saves it when it is done."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.process import check_measurable, machine
from benchmarks.rows import Row, read_rows, rounded, write_rows
from benchmarks.study import SceneSpec, Study
from g2ard import __version__
from g2ard.errors import G2ardError
from g2ard.progress import Progress, Say, silent, unsaid

__all__ = ["fingerprint", "folder_of", "run", "scene_key"]


def run(
    studies: Sequence[Study],
    folder: Path,
    *,
    keep: bool = False,
    again: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> list[Row]:
    """Measure all cells that are not in `folder`/rows.csv, and return the rows of the studies in order.

    A failed cell becomes a row with its error and is measured again by the next call. So is a cell whose
    scene, settings or version changed. Rows of other studies are kept.

    Args:
        studies: studies to run.
        folder: folder of the run; need not exist.
        keep: whether to keep intermediate scenes, in work/, after success.
        again: whether to measure all cells again.
        progress: callback per cell.
        say: called with the notes of each scene that is measured.
    """
    for study in studies:
        study.check()
        if study.PROCESSES:
            check_measurable()
    path, work = folder / "rows.csv", folder / "work"
    held = read_rows(path)
    folder.mkdir(parents=True, exist_ok=True)
    places = [(study, scene) for study in studies for scene in study.scenes]
    total = sum(1 for study, scene in places for _ in study.cells(scene, work))
    chosen: list[tuple[Study, str]] = []
    for study, scene in places:
        if again:
            shutil.rmtree(folder_of(work, study, scene) / "stages", ignore_errors=True)
        where, told = scene_key(study, scene), False
        for cell in study.cells(scene, work):
            key = fingerprint([study.settings, where, dict(cell.names), cell.more])
            named = {"study": study.name, "scene": scene.name, **cell.names}
            label = " ".join(_short(value) for name, value in cell.names.items() if name != "seed")
            progress("bench", len(chosen), total, {scene.name: label})
            chosen.append((study, key))
            if not again and _done(held, key, cell.views):
                continue
            if not told:
                with suppress(G2ardError, OSError):  # in its rows
                    for note in study.notes(scene, work):
                        say(f"{scene.name}: {note}")
            told = True
            about = {"version": f"g2ard {__version__}", "machine": machine(), "cell": key}
            try:
                found = [rounded({**about, **named, **row}) for row in cell.measure()]
            except Exception as error:  # reported in its row and by the exit status
                text = " ".join(str(error).split()) or type(error).__name__
                found = [rounded({**about, **named, "error": text})]
            own = rounded(named).items()
            held = [
                row for row in held if row.get("cell") != key and not own <= row.items()
            ] + found
            write_rows(path, _derived(studies, held))
    progress("bench", total, total, {})
    held = _derived(studies, held)
    write_rows(path, held)
    rows = [row for _, key in chosen for row in held if row.get("cell") == key]
    if not keep and not any("error" in row for row in rows):
        for study, scene in places:
            shutil.rmtree(folder_of(work, study, scene), ignore_errors=True)
        with suppress(OSError):  # not empty
            work.rmdir()
    return rows


def _done(held: Sequence[Row], key: str, views: Sequence[str]) -> bool:
    found = [row for row in held if row.get("cell") == key and "error" not in row]
    return bool(found) and set(views) <= {row.get("views_kind") for row in found}


def _derived(studies: Sequence[Study], held: list[Row]) -> list[Row]:
    for study in studies:
        own = [row for row in held if row.get("study") == study.name]
        others = [row for row in held if row.get("study") != study.name]
        held = others + [rounded(row) for row in study.derived(own)]
    return held


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def fingerprint(value: Any) -> str:
    """Return a short hash of a JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def scene_key(study: Study, scene: SceneSpec) -> str:
    """Return a hash that changes with the scene, its files and its views."""
    stated = {
        **asdict(scene),
        "size": study.size,
        "pool_seed": study.pool_seed,
        "version": __version__,
    }
    files = (
        ()
        if scene.synth is not None
        else (scene.prior, scene.train, scene.adapt, *scene.score.values())
    )
    stamps = [_stamp(study.folder / file) for file in files if file is not None]
    return fingerprint({**stated, "files": stamps})


def folder_of(work: Path, study: Study, scene: SceneSpec) -> Path:
    """Return the folder of a scene's intermediate files."""
    return work / f"{scene.name.replace('/', '_')}-{scene_key(study, scene)}"


def _stamp(path: Path) -> Any:
    """Return names, sizes and modification times of a file or folder."""
    if not path.exists():
        return None
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in files if f.is_file()]
