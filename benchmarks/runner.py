"""The runner of all benchmarks: cells are measured once, and each is written as it is done."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.process import check_measurable, machine
from benchmarks.rows import Row, read_rows, rounded, write_rows
from benchmarks.study import SceneSpec, Study
from g2ard import __version__
from g2ard.progress import Progress, silent

__all__ = ["Cell", "fingerprint", "folder_of", "run", "scene_key"]


@dataclass(frozen=True)
class Cell:
    """One measurement.

    Args:
        names: the columns that tell it from other cells of the study, apart from the scene.
        measure: returns its rows, without those columns.
        views: the kinds of views that it has a row for each of; empty means any rows.
        more: what else its figures depend on.
    """

    names: Mapping[str, Any]
    measure: Callable[[], Iterable[Row]]
    views: tuple[str, ...] = ()
    more: Any = None


def run(
    studies: Sequence[Study],
    folder: Path,
    *,
    keep: bool = False,
    again: bool = False,
    progress: Progress = silent,
) -> list[Row]:
    """Measure every cell of some studies that `folder`/rows.csv does not hold yet.

    A cell that fails is a row with its error, and is tried again by the next call. A cell whose scene,
    settings or version changed is measured anew. Rows of other studies and cells stay.

    Args:
        studies: what to measure.
        folder: of the run; need not exist.
        keep: whether intermediate scenes, in work/, stay once all cells are done.
        again: measure everything anew.
        progress: told of every cell.

    Returns:
        The rows of these studies, in their order.

    Raises:
        InputError: a path with an environment variable that is not set, or a foreign rows.csv.
        G2ardError: the system does not tell what a process took (Windows).
        KeyboardInterrupt: after Ctrl-C; the next call continues.
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
        where = scene_key(study, scene)
        for cell in study.cells(scene, work):
            key = fingerprint([study.settings, where, dict(cell.names), cell.more])
            named = {"study": study.name, "scene": scene.name, **cell.names}
            label = " ".join(_short(value) for name, value in cell.names.items() if name != "seed")
            progress("bench", len(chosen), total, {scene.name: label})
            chosen.append((study, key))
            if not again and _done(held, key, cell.views):
                continue
            about = {"version": f"g2ard {__version__}", "machine": machine(), "cell": key}
            try:
                found = [rounded({**about, **named, **row}) for row in cell.measure()]
            except Exception as error:  # one cell must not end hours of others; its row and the status tell
                text = " ".join(str(error).split()) or type(error).__name__
                found = [rounded({**about, **named, "error": text})]
            own = rounded(named).items()
            held = [row for row in held if row.get("cell") != key and not own <= row.items()] + found
            write_rows(path, _derived(studies, held))
    progress("bench", total, total, {})
    held = _derived(studies, held)
    write_rows(path, held)
    rows = [row for _, key in chosen for row in held if row.get("cell") == key]
    if not keep and not any("error" in row for row in rows):
        for study, scene in places:
            shutil.rmtree(folder_of(work, study, scene), ignore_errors=True)
        with suppress(OSError):  # others' work stays
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
    """Return a short hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


def scene_key(study: Study, scene: SceneSpec) -> str:
    """Return a hash that changes with the scene, its files and its views."""
    stated = {**asdict(scene), "size": study.size, "pool_seed": study.pool_seed, "version": __version__}
    files = () if scene.synth is not None else (scene.prior, scene.train, scene.adapt, *scene.score.values())
    stamps = [_stamp(study.folder / file) for file in files if file is not None]
    return fingerprint({**stated, "files": stamps})


def folder_of(work: Path, study: Study, scene: SceneSpec) -> Path:
    """Return where a scene's intermediate files lie."""
    return work / f"{scene.name.replace('/', '_')}-{scene_key(study, scene)}"


def _stamp(path: Path) -> Any:
    """Return what tells one version of a file or folder from another, without reading it."""
    if not path.exists():
        return None
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in files if f.is_file()]
