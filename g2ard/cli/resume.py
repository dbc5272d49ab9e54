"""Commands that can be stopped: what a stopped run left is gone on from, or replaced when -w says so."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from g2ard.cli.frame import Run
from g2ard.errors import OutputError

OPTIONS = "options.json"
"""In a folder of checkpoints: what they belong to. Alone it is nothing to go on from."""


def check_stopped(run: Run, place: Path, resume: bool, output: Path) -> bool:
    """Before the work: whether there is something to go on from at `place`, a checkpoint or a folder of them.

    Raises:
        OutputError: there is, and neither --resume nor --overwrite says what is to become of it.
        Exit: `output` is there already, and nothing is left to go on with.
    """
    left = left_at(place)
    if resume and not left and not run.overwrite and output.exists():
        run.say(f"{output}: finished already, nothing is left to resume (-w without --resume starts anew)")
        raise typer.Exit
    if resume and not left:
        run.say(f"nothing to go on from ({place}): starts anew")
    if left and not (resume or run.overwrite):
        raise OutputError(f"{place}: left by a stopped run; --resume goes on from it, -w starts anew")
    return resume and left


@contextmanager
def stoppable(run: Run, place: Path, resume: bool) -> Iterator[None]:
    """While it lasts checkpoints may wait at `place`; its end removes them, Ctrl-C says how to go on."""
    if not resume:
        _remove(place)
    try:
        yield
    except KeyboardInterrupt:
        if left_at(place):
            run.kept.append(f"the same command with --resume goes on from {place}")
        raise
    else:
        _remove(place)
    finally:
        if not left_at(place):
            _remove(place)


@contextmanager
def rows_kept(run: Run, table: Path, *, goes_on: bool) -> Iterator[None]:
    """While it lasts a table grows; Ctrl-C says that its rows stay, and whether another call goes on."""
    try:
        yield
    except KeyboardInterrupt:
        if table.exists():
            onward = "the same command goes on" if goes_on else "the same command with -w starts anew"
            run.kept.append(f"{table} holds what is done; {onward}")
        raise


def left_at(place: Path) -> bool:
    """Whether there is a checkpoint, or a folder that holds some."""
    return any(item.name != OPTIONS for item in place.iterdir()) if place.is_dir() else place.exists()


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
