"""Resume an interrupted run, or discard it with `-w`."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from g2ard.cli.frame import Run
from g2ard.errors import OutputError
from g2ard.io import check_scene_output

OPTIONS = "options.json"
"""File in a folder of checkpoints with the options of their run."""


def check_scene_run(run: Run, place: Path, resume: bool, output: Path) -> None:
    """Check that the command may write the scene `output`, or resume from the checkpoints at `place`."""
    if left_at(place) or not (resume and output.exists()):
        check_scene_output(output, run.overwrite)
    check_stopped(run, place, resume, output)


def check_stopped(run: Run, place: Path, resume: bool, output: Path) -> None:
    """Check that checkpoints at `place` may be resumed or replaced; exit if `output` is finished."""
    left = left_at(place)
    if resume and not left and not run.overwrite and output.exists():
        run.say(f"{output}: already finished; -w without --resume starts over")
        raise typer.Exit
    if resume and not left:
        run.say(f"{output}: nothing to resume, starting over")
    if left and not (resume or run.overwrite):
        raise OutputError("left by an interrupted run; --resume continues it, -w starts over", path=place)


@contextmanager
def stoppable(run: Run, place: Path, resume: bool) -> Iterator[None]:
    """Keep checkpoints at `place` if the command is interrupted, and remove them when it succeeds."""
    if not resume:
        _remove(place)
    try:
        yield
    except KeyboardInterrupt:
        if left_at(place):
            run.kept.append(f"run the same command with --resume to continue from {place}")
        raise
    else:
        _remove(place)
    finally:
        if not left_at(place):
            _remove(place)


def left_at(place: Path) -> bool:
    """Return whether `place` is a checkpoint or a folder with checkpoints."""
    return any(item.name != OPTIONS for item in place.iterdir()) if place.is_dir() else place.exists()


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
