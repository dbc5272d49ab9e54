"""Resume an interrupted run, or discard it with `-w`."""

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import typer

from g2ard.cli.run import Run
from g2ard.config.choices import Named
from g2ard.errors import InputError, OutputError
from g2ard.io import check_scene_output
from g2ard.io.atomic import (
    atomic_output,
    drop_empty,
    drop_temporaries,
    hidden_name,
    is_taken,
    parents_made,
)
from g2ard.io.jsonfile import read_json
from g2ard.io.lock import check_unlocked, lock_file, locked
from g2ard.io.paths import file_identity, real_path, user_cache
from g2ard.io.scene_formats import files_of

OPTIONS = "options.json"
"""File in a folder of checkpoints with the options of their run."""


CALL_OPTIONS = (
    *("output", "resume", "keep", "page", "dry_run", "threads", "device"),
    *("memory", "workers", "scheduler", "work", "views_format", "count", "ratio"),
)
"""Options that may differ from a finished run's: also budgets of the same count."""


def is_finished(run: Run, place: Path, resume: bool, output: Path) -> bool:
    """Return whether --resume finds `output` finished; raise an error for other options or inputs."""
    if not resume or run.overwrite or has_checkpoints(place):
        return False
    record = read_record(output)
    if record is None:
        return False
    check_same(run, record, output)
    return True


def check_same(run: Run, record: Mapping[str, Any], output: Path, *others: str) -> None:
    """Raise an `OutputError` unless a finished run had these options and input files.

    Args:
        others: further names of differing options.
    """
    then = record.get("config", {})
    now = json.loads(json.dumps(run.config, default=str))
    different = list(others)
    for name, value in now.items():
        if name in then and name not in CALL_OPTIONS and value != then[name]:
            different.append(name.replace("_", "-"))
    hint = "-w without --resume starts over"
    if different:
        raise OutputError(
            f"finished with other options ({', '.join(different)})", path=output, hint=hint
        )
    changed = _find_changed_files(run, record.get("inputs", {}))
    if changed:
        raise OutputError(f"finished before {min(changed)} changed", path=output, hint=hint)


def _find_changed_files(run: Run, known: Mapping[str, Any]) -> list[str]:
    """Return the files that a run reads and an earlier one found otherwise or not, or that are lost.

    What is in a lost input is not read anew, so that it does not count.
    """
    present = identify_files(run.input_files())
    missing = {path for path in run.named_inputs() if not path.exists()}
    lost = []
    for path in map(Path, known.keys() - present.keys()):
        if path.is_file():
            present |= identify_files([path])
        elif missing.isdisjoint({real_path(path), *real_path(path).parents}):
            lost.append(str(path))
    return lost + [name for name, identity in present.items() if identity != known.get(name)]


def identify_files(files: Iterable[Path]) -> Named:
    """Return the identity of each file by its path, relative to the working folder if it is inside."""
    here = real_path(".")
    absolute = {real_path(path) for path in files}
    paths = sorted(
        path.relative_to(here) if path.is_relative_to(here) else path for path in absolute
    )
    return dict(zip(map(str, paths), file_identity(paths), strict=True))


def read_record(output: Path) -> Named | None:
    """Return the options and inputs of the command that finished the output, or None if that is not known,
    as of an output that was moved or is another file."""
    file = _place_record(output)
    if not (file.is_file() and is_taken(output)):
        return None
    try:
        record = read_json(file)
    except InputError:
        return None
    known = isinstance(record, dict) and record.get("output") == file_identity([output])
    return record if known else None


def _place_record(output: Path) -> Path:
    """Return the file in the user's cache for the record of a finished output."""
    from g2ard.system.keys import key_of

    return user_cache() / "finished" / f"{key_of(str(real_path(output)))}.json"


@contextmanager
def record_finish(run: Run, output: Path) -> Iterator[None]:
    """Record options and inputs when `output` is written, so that --resume finds it finished."""
    inputs = identify_files(run.input_files())
    yield
    if is_taken(output):
        record = {"config": run.config, "inputs": inputs, "output": file_identity([output])}
        text = json.dumps(record, default=str)
        # without a cache, --resume answers that the output exists
        with suppress(OSError, OutputError):
            file = _place_record(output)
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_output(file, overwrite=True) as temporary:
                temporary.write_text(text, encoding="utf-8", newline="\n")


def began_output(place: Path, output: Path) -> bool:
    """Return whether a killed run with checkpoints at `place` began to write `output`, a file or a folder.

    It left its lock or checkpoints, and everything in the output is younger.
    """
    kept = _list_times(place) + _list_times(lock_file(place.parent, _locked_name(place, output)))
    written = _list_times(output)
    return bool(kept) and output.exists() and min(kept) <= min(written, default=min(kept))


def _list_times(place: Path) -> list[int]:
    """Return when a file, or each file in a folder, was written last."""
    return [path.stat().st_mtime_ns for path in (place, *place.rglob("*")) if path.is_file()]


def drop_ended(run: Run, place: Path, resume: bool, output: Path) -> bool:
    """Remove checkpoints of a run that was killed after it recorded its output, and return whether it was."""
    record = read_record(output) if resume and not run.overwrite and place.exists() else None
    if record is None:
        return False
    check_same(run, record, output)
    check_unlocked(place.parent, _locked_name(place, output))
    _remove(place)
    _drop_temporaries(place, output)
    return True


def place_checkpoint(output: Path, ending: str) -> Path:
    """Return the hidden place for checkpoints of a scene, beside its file or SOG folder."""
    whole = output.parent if output.name == "meta.json" else output
    return whole.parent / hidden_name(whole.name, ending)


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
    from g2ard.stages.recover.checkpoint import drop_damaged

    check_unlocked(place.parent, _locked_name(place, output))
    if is_finished(run, place, resume, output):
        run.say(f"{output}: already finished; -w without --resume starts over")
        raise typer.Exit
    if resume and place.is_file():
        drop_damaged(place)
    left = has_checkpoints(place)
    if resume and not left:
        run.say(f"{output}: nothing to resume, starting over")
    if left and not (resume or run.overwrite):
        raise OutputError(
            "left by an interrupted run; --resume continues it, -w starts over", path=place
        )


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
            with (
                keep_checkpoints(run, place, resume, output, f"from {place}"),
                record_finish(run, output),
            ):
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
def keep_checkpoints(run: Run, place: Path, resume: bool, what: Path, where: str) -> Iterator[None]:
    """Remove checkpoints at `place` unless they are resumed; after an error or Ctrl-C say `where` they are.

    Args:
        what: output that the command writes.
    """
    if not resume:
        _remove(place)
    elif has_checkpoints(place):
        tell_start(run, place, what)
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        if has_checkpoints(place) and not (resume and isinstance(error, InputError)):
            run.kept.append(f"run the same command with --resume to continue {where}")
        raise
    else:
        _remove(place)
    finally:
        if not has_checkpoints(place):
            _remove(place)


def tell_start(run: Run, place: Path, what: Path) -> None:
    """Say where a resumed run continues: after its finished steps, or from a step of recovery."""
    from g2ard.stages.recover.checkpoint import count_steps

    done = list_finished_steps(place)
    steps = None if place.is_dir() else count_steps(place)
    where = f"from {place}"
    if done:
        where = f"after {', '.join(done)}"
    elif steps is not None:
        where = f"from step {steps:,}"
    run.say(f"{what}: continues {where}")


def list_finished_steps(place: Path) -> list[str]:
    """Return the names of finished steps in a folder of checkpoints."""
    # the name, and a hash of 16 digits
    stems = (path.stem for path in sorted(place.glob("[!.]*.npz")))
    return list(dict.fromkeys(stem[:-17] for stem in stems if not stem.endswith(".checkpoint")))


def has_checkpoints(place: Path) -> bool:
    """Return whether `place` is a checkpoint or a folder with checkpoints."""
    if not place.is_dir():
        return place.exists()
    return any(item.name != OPTIONS for item in place.iterdir())


def _remove(place: Path) -> None:
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
