"""Tasks: pure functions from files to one file, named by what decides its content."""

from __future__ import annotations

import gc
import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError

__all__ = ["Arrays", "Task", "is_whole", "load", "run_task"]

Arrays = dict[str, NDArray[Any]]
"""What a task makes and reads: arrays by name, one .npz file."""

_VERSION = 3
"""Of what the functions make: raised when a change of theirs makes files of before useless."""

_DAMAGED = (zipfile.BadZipFile, zlib.error, ValueError, EOFError, LookupError, RuntimeError)
"""What readers of arrays raise where a file's bytes are not those that were written."""


@dataclass(frozen=True)
class Task:
    """A call of a function whose result is kept in a file.

    The file's name holds a hash of the function, its arguments and the names of the files that it reads,
    which hold the hashes of theirs. So a file that is there need not be made again, whoever made it.

    Args:
        function: "module:name" of a function (arguments, inputs, places) → arrays.
        label: begins the file's name.
        folder: where the file goes.
        arguments: what JSON holds.
        inputs: files of other tasks that it reads, by name.
        places: files and folders that `arguments` decide the content of, and that may be moved.
        cost: how much work it is, in any one unit, for progress.
    """

    function: str
    label: str
    folder: Path
    arguments: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Path | list[Path]] = field(default_factory=dict)
    places: Mapping[str, Path] = field(default_factory=dict)
    cost: int = 1

    @property
    def key(self) -> str:
        """16 hexadecimal digits that name what the task makes."""
        names = {
            name: [path.name for path in (paths if isinstance(paths, list) else [paths])]
            for name, paths in self.inputs.items()
        }
        content = [_VERSION, self.function, dict(self.arguments), names]
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def output(self) -> Path:
        """The file."""
        return self.folder / f"{self.label}-{self.key}.npz"

    @property
    def done(self) -> bool:
        """Whether the file is there, and whole as far as its table of contents tells."""
        return is_whole(self.output)


def run_task(task: Task) -> Path:
    """Run a task unless it is done; the file appears whole or not at all.

    Raises:
        InputError: of the function.
        OutputError: the disk refuses.
    """
    from g2ard.io.atomic import atomic_output

    if task.done:
        return task.output
    module, name = task.function.split(":")
    arrays: Arrays = getattr(import_module(module), name)(task.arguments, task.inputs, task.places)
    with atomic_output(task.output, overwrite=True) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    del arrays
    gc.collect()  # scenes and their cores hold each other
    return task.output


def is_whole(path: Path) -> bool:
    """Whether a file of arrays is there with its end, which holds the table of contents."""
    try:
        with zipfile.ZipFile(path):
            return True
    except (OSError, ValueError, zipfile.BadZipFile):
        return False


def load(path: Path, *names: str) -> list[NDArray[Any]]:
    """Some arrays of a task's file.

    Raises:
        InputError: its contents are not those that were written.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return [arrays[name] for name in names]
    except _DAMAGED as error:
        raise InputError(
            f"{path}: its contents are not those that were written; once it is removed, the same command "
            "makes it again"
        ) from error
