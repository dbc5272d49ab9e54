"""The folder of a `distill` run: its files, and earlier runs in it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from g2ard.cli.frame import Run
from g2ard.cli.resume import OPTIONS, check_stopped, left_at
from g2ard.config.choices import ViewFormat
from g2ard.errors import InputError, OutputError
from g2ard.io import write_views
from g2ard.io.atomic import atomic_output, check_output
from g2ard.io.scene_formats import FORMATS
from g2ard.jobs.budget import DEVICES
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.io import ViewSet
    from g2ard.jobs.budget import Budget
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats

WORK = ".unfinished"
"""Folder in a run's folder for finished rounds and checkpoints."""
KEPT = Path("simplified", "scene.ply")
"""The simplified scene, with --keep, for `evaluate --anchors`."""
VIEW = "view.html"
"""The run's viewer page."""
REPORT = "report.json"
"""The run's numbers, written last."""

_VIEWS: dict[ViewFormat, str] = {
    "inria": "cameras.json",
    "nerfstudio": "transforms.json",
    "colmap": "colmap",
}
"""Names of generated views for other programs, beside views.json."""

_OF_THE_CALL = (
    *("output", "resume", "keep", "view", "dry_run", "threads", "device"),
    *("memory", "workers", "scheduler", "work", "views_format"),
)
"""Options that may change when a run is resumed. `device` may change except to or from CUDA."""
_OF_THE_BUDGET = ("count", "ratio")
"""Budget options; each folder has one budget."""


def write_pool(run: Run, folder: Path, pool: ViewSet) -> None:
    """Write generated views, also in the format of --views-format."""
    write_views(folder / "views.json", pool.cameras, splits=pool.splits, overwrite=True)
    also: ViewFormat = run.config["views_format"]
    if also in _VIEWS:
        run.write_views(folder / _VIEWS[also], pool.cameras, also, pool.splits, overwrite=True)


def write_report(folder: Path, report: dict[str, Any]) -> None:
    with atomic_output(folder / REPORT, overwrite=True) as temporary:
        temporary.write_text(json.dumps(report, indent=2, default=str) + "\n", encoding="utf-8", newline="\n")


def write_view(
    place: Path, splats: Splats, cameras: Cameras, background: tuple[float, float, float]
) -> tuple[int | None, str]:
    """Write view.html beside `place`, the scene's file, unless browsers would not draw it smoothly.

    Returns:
        Size of the page in bytes, None if it was not written, and a line to print.
    """
    from g2ard.jobs.viewer_frame import frame_with
    from g2ard.viewer import write_page

    path, count, most = place.with_name(VIEW), len(splats), DEVICES["web"]
    if count > most:
        path.unlink(missing_ok=True)
        return None, f"{path} skipped: over {most:,} Gaussians (`g2ard view` writes it anyway)"
    stand = frame_with(splats, cameras)
    shown = [(f"{place.name}: {plural(count, 'Gaussian')}", stand.of(splats))]
    written = write_page(path, shown, start=stand.start, background=background, overwrite=True)
    return written.bytes, f"view: {path} ({written.bytes / 1e6:.2f} MB)"


def check_place(run: Run, place: Path, budget: Budget, given: bool, resume: bool) -> None:
    """Raise an `OutputError` unless the run may write to the folder of `place`, its scene file.

    Args:
        given: whether views are given; otherwise views.json is written too.
    """
    folder = place.parent
    views = [] if given else [folder / "views.json"]
    run.spare_inputs(place, *_other_scenes(place), folder / KEPT, *views)
    left = left_at(folder / WORK)
    killed = folder.is_dir() and [path.name for path in folder.iterdir()] == [WORK]
    if not left and not (resume and _is_finished(place)) and not killed:
        check_output(folder, run.overwrite, folder=True)
    if left or not resume:
        check_stopped(run, folder / WORK, resume, place)
    if resume and left:
        _check_same(run, folder, folder / WORK / OPTIONS, budget, "begun")
    elif is_done(run, place, resume):
        _check_same(run, folder, folder / REPORT, budget, "finished")


def is_done(run: Run, place: Path, resume: bool) -> bool:
    """Return whether --resume finds a finished run."""
    return resume and not run.overwrite and _is_finished(place)


def tell_finished(run: Run, place: Path) -> dict[str, Any]:
    """Say that a run is finished, and return its report."""
    from g2ard.io.jsonfile import read_json

    run.say(f"{place.parent}: already finished; -w without --resume starts over")
    return read_json(place.parent / REPORT)


def tell_anew(run: Run, folder: Path, resume: bool) -> None:
    """Say that --resume starts over if there is nothing to resume."""
    if resume and not left_at(folder / WORK):
        run.say(f"{folder}: nothing to resume, starting over")


@contextmanager
def work_folder(run: Run, output: Path, resume: bool, counts: tuple[int, int] = (0, 0)) -> Iterator[Path]:
    """Create the folder for checkpoints; after an error or Ctrl-C, keep it only if it can be resumed.

    Args:
        counts: Gaussians of the dense scene and of the result.
    """
    work, made = output / WORK, not output.exists()
    if not resume:
        shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    note_options(run, work, {"input_count": counts[0], "output_count": counts[1]})
    try:
        yield work
    except (Exception, KeyboardInterrupt) as error:
        if left_at(work) and (resume or isinstance(error, KeyboardInterrupt)):
            run.kept.append(f"run the same command with --resume to continue in {output}")
            if not isinstance(error, KeyboardInterrupt | InputError):
                run.say(run.kept[-1])
        else:
            shutil.rmtree(output if made else work, ignore_errors=True)
        raise


def note_options(run: Run, work: Path, told: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Write the run's options beside its checkpoints, unless there are checkpoints already."""
    work.mkdir(parents=True, exist_ok=True)
    if not left_at(work):
        (work / OPTIONS).write_text(
            json.dumps({**told, "config": run.config}, default=str), encoding="utf-8", newline="\n"
        )


def check_same_options(run: Run, work: Path, besides: Sequence[str] = ()) -> None:
    """Raise an `OutputError` if the interrupted run had other options, except for those in `besides`."""
    _check_same(run, work, work / OPTIONS, None, "begun", besides)


def stopped_run(folder: Path) -> dict[str, Any] | None:
    """Describe an interrupted run (checkpoints, counts, options), or return None without one."""
    from g2ard.io.jsonfile import read_json

    work = folder / WORK
    if not left_at(work):
        return None
    told = read_json(work / OPTIONS) if (work / OPTIONS).exists() else {}
    kept = sorted(path.name.removesuffix(".npz") for path in work.glob("[!.]*.npz"))
    return {"path": str(folder), "kind": "stopped run", "kept": kept, **told}


def drop_older(place: Path) -> None:
    """Remove an earlier run's scenes in other formats, since a folder holds one scene."""
    for other in _other_scenes(place):
        other.unlink(missing_ok=True)


def _other_scenes(place: Path) -> list[Path]:
    """Return the scene's file names in other formats."""
    return [path for name in FORMATS if (path := place.with_name(f"scene.{name}")) != place]


def _is_finished(place: Path) -> bool:
    return place.exists() and (place.parent / REPORT).exists() and not left_at(place.parent / WORK)


def _check_same(
    run: Run, folder: Path, told: Path, budget: Budget | None, how: str, besides: Sequence[str] = ()
) -> None:
    """Raise an `OutputError` if a run's recorded options differ."""
    from g2ard.io.jsonfile import read_json

    if not told.exists():
        return
    before = read_json(told)
    if other := [name for name in _others(run, before, budget) if name not in besides]:
        raise OutputError(
            f"{how} with other options ({', '.join(other)})",
            path=folder,
            hint="-w without --resume starts over",
        )


def _others(run: Run, before: Mapping[str, Any], budget: Budget | None) -> list[str]:
    """Return the names of options whose values differ."""
    then = before.get("config", {})
    now = json.loads(json.dumps(run.config, default=str))
    names = [name for name in now if name in then and name not in (*_OF_THE_CALL, *_OF_THE_BUDGET)]
    found = [name.replace("_", "-") for name in names if now[name] != then[name]]
    if "cuda" in (now["device"], then.get("device")) and now["device"] != then.get("device"):
        found.append("device")
    return found if budget is None or _is_budget(budget, before) else ["budget", *found]


def _is_budget(budget: Budget, before: Mapping[str, Any]) -> bool:
    """Return whether a run's count is that of the budget; measured budgets are compared by their options."""
    if budget.is_measured or "output_count" not in before:
        return True
    try:
        return budget.of(before["input_count"]) == before["output_count"]
    except InputError:
        return False
