"""Resume an interrupted run, or discard it with `-w`."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from g2ard.cli.frame import Run
from g2ard.errors import InputError, OutputError
from g2ard.io import check_scene_output
from g2ard.io.atomic import drop_empty, drop_temporaries, hidden_name, is_taken, parents_made
from g2ard.io.lock import check_unlocked, lock_file, locked
from g2ard.io.scene_formats import files_of

OPTIONS = "options.json"
"""File in a folder of checkpoints with the options of their run."""


def is_finished(run: Run, place: Path, resume: bool, output: Path) -> bool:
    """Return whether --resume finds `output` finished; raise an error if an input changed since then."""
    if not resume or run.overwrite or left_at(place) or not is_taken(output):
        return False
    made = output.stat().st_mtime_ns
    for path in run.input_files():
        if path.stat().st_mtime_ns > made:
            raise finished_before(output, path)
    return True


def began_output(place: Path, output: Path) -> bool:
    """Return whether a killed run with checkpoints at `place` began to write `output`, a file or a folder.

    It left its lock or checkpoints, and everything in the output is younger.
    """
    lock = lock_file(place.parent, _locked_name(place, output))
    kept, written = (
        [path.stat().st_mtime_ns for place in places for path in (place, *place.rglob("*")) if path.is_file()]
        for places in ((place, lock), (output,))
    )
    return bool(kept) and output.exists() and all(min(kept) <= time for time in written)  # or none yet


def drop_ended(run: Run, place: Path, resume: bool, last: Path) -> bool:
    """Remove checkpoints of a run that was killed after its last output `last`, and return whether it was."""
    ended = resume and not run.overwrite and began_output(place, last)
    if ended:
        check_unlocked(place.parent, _locked_name(place, last))
        _remove(place)
        _drop_temporaries(place, last)
    return ended


def checkpoint_beside(output: Path, ending: str) -> Path:
    """Return the hidden place for checkpoints of a scene, beside its file or SOG folder."""
    whole = output.parent if output.name == "meta.json" else output
    return whole.parent / hidden_name(whole.name, ending)


def finished_before(output: Path, changed: Path) -> OutputError:
    """Return the error of a finished output whose input is another file now."""
    return OutputError(
        f"finished before {changed} changed", path=output, hint="-w without --resume starts over"
    )


def check_scene_run(run: Run, place: Path, resume: bool, output: Path) -> None:
    """Check that the command may write the scene `output`, or resume from the checkpoints at `place`."""
    run.claim("--output", *files_of(output))
    run.claim("--resume", place, folder=True)
    drop_ended(run, place, resume, output)
    if not is_finished(run, place, resume, output):
        run.overwrite |= resume and began_output(place, place.parent / _locked_name(place, output))
        check_scene_output(output, run.overwrite)
    check_stopped(run, place, resume, output)


def check_stopped(run: Run, place: Path, resume: bool, output: Path) -> None:
    """Check that checkpoints at `place` may be resumed or replaced; exit if `output` is finished."""
    check_unlocked(place.parent, _locked_name(place, output))
    if is_finished(run, place, resume, output):
        run.say(f"{output}: already finished; -w without --resume starts over")
        raise typer.Exit
    left = left_at(place)
    if resume and not left:
        run.say(f"{output}: nothing to resume, starting over")
    if left and not (resume or run.overwrite):
        raise OutputError("left by an interrupted run; --resume continues it, -w starts over", path=place)


@contextmanager
def stoppable(run: Run, place: Path, resume: bool, output: Path) -> Iterator[None]:
    """Remove checkpoints at `place` when the command succeeds, and name them when it does not.

    No other run may write `output` meanwhile.
    """
    made = parents_made(place)
    try:
        with locked(place.parent, _locked_name(place, output)):
            if is_taken(output) and not run.overwrite:  # another run wrote it since it was checked
                raise OutputError("exists", path=output, hint="{overwrite=True} replaces it")
            _drop_temporaries(place, output)
            with kept(run, place, resume, output, f"from {place}"):
                yield
    finally:
        drop_empty(made)


def _locked_name(place: Path, output: Path) -> str:
    """Return the name beside `place` of the output, or of the folder that holds it."""
    return output.name if output.parent == place.parent else output.parent.name


def _drop_temporaries(place: Path, output: Path) -> None:
    """Remove what a killed run left of checkpoints and outputs."""
    drop_temporaries(place.parent, place.name, _locked_name(place, output))
    if output.parent != place.parent:
        drop_temporaries(output.parent)


@contextmanager
def kept(run: Run, place: Path, resume: bool, what: Path, where: str) -> Iterator[None]:
    """Remove checkpoints at `place` unless they are resumed; after an error or Ctrl-C say `where` they are.

    Args:
        what: output that the command writes.
    """
    if not resume:
        _remove(place)
    elif left_at(place):
        say_from(run, place, what)
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        if left_at(place) and not (resume and isinstance(error, InputError)):
            run.kept.append(f"run the same command with --resume to continue {where}")
        raise
    else:
        _remove(place)
    finally:
        if not left_at(place):
            _remove(place)


def say_from(run: Run, place: Path, what: Path) -> None:
    """Say where a resumed run continues: after its finished steps, or from a step of recovery."""
    from g2ard.stages.recover.checkpoint import steps_at

    done = finished_steps(place)
    steps = None if place.is_dir() else steps_at(place)
    where = f"after {', '.join(done)}" if done else f"from {place if steps is None else f'step {steps:,}'}"
    run.say(f"{what}: continues {where}")


def finished_steps(place: Path) -> list[str]:
    """Return the names of finished steps in a folder of checkpoints."""
    stems = (path.stem for path in sorted(place.glob("[!.]*.npz")))  # the name, and a hash of 16 digits
    return list(dict.fromkeys(stem[:-17] for stem in stems if not stem.endswith(".checkpoint")))


def left_at(place: Path) -> bool:
    """Return whether `place` is a checkpoint or a folder with checkpoints."""
    return any(item.name != OPTIONS for item in place.iterdir()) if place.is_dir() else place.exists()


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
