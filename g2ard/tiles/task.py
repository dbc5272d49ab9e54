"""Tasks: pure functions from files to one file, named by what decides its content."""

from __future__ import annotations

import gc
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Arrays", "Task", "load", "run_task"]

Arrays = dict[str, NDArray[Any]]
"""What a task makes and reads: arrays by name, one .npz file."""

_VERSION = 3
"""Of what the functions make: raised when a change of theirs makes files of before useless."""


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


def run_task(task: Task) -> Path:
    """Run a task unless its file is there; the file appears whole or not at all.

    Raises:
        InputError: of the function.
        OutputError: the disk refuses.
    """
    from g2ard.io.atomic import atomic_output

    if task.output.exists():
        return task.output
    module, name = task.function.split(":")
    arrays: Arrays = getattr(import_module(module), name)(task.arguments, task.inputs, task.places)
    with atomic_output(task.output, overwrite=True) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    del arrays
    gc.collect()  # scenes and their cores hold each other
    return task.output


def load(path: Path, *names: str) -> list[NDArray[Any]]:
    """Some arrays of a task's file."""
    with np.load(path, allow_pickle=False) as arrays:
        return [arrays[name] for name in names]
