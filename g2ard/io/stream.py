"""Scenes read block by block, so that memory does not bound their size."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from g2ard.errors import InputError
from g2ard.io.clean import BLOCK, Raw, Tally

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from g2ard.io.types import Note
    from g2ard.splats import Splats

__all__ = ["STREAMED", "SceneStream", "file_identity", "open_stream"]

STREAMED = ("ply",)
"""Formats of scenes with a function `stream(path)`."""

_ENDS = 1 << 20
"""Bytes at each end of a file that tell it from others of its name, size and time."""


class SceneStream(ABC):
    """A scene as a sequence of rows, any part of which can be read again.

    Attributes:
        path: names the scene in messages.
        count: rows in the source, those that will be dropped included.
        sh_degree: 0–3.
        offset: (3,) float64, world = means + offset.
        notes: what the header told; what the rows told is in `tally`.
        tally: counts over the rows that `blocks` has been through.
    """

    path: Path
    count: int
    sh_degree: int
    offset: NDArray[np.float64]
    notes: tuple[Note, ...]
    tally: Tally

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        """The source's rows from `start` on, `rows` at a time (the last block may be shorter)."""

    @abstractmethod
    def identity(self) -> list[Any]:
        """What tells this source from another, as JSON: files by name, size, time and ends."""

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        """(n, 3) means of all rows in order, in blocks of at most `rows`; not cleaned."""
        return (raw.means for raw in self.raw(rows, 0))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        """All rows from `start` on, cleaned as `g2ard.io.read_scene` cleans them.

        Args:
            rows: rows of the source a block is made of; dropped rows make it shorter.
            start: the first row of the source.
        """
        import numpy as np

        for raw in self.raw(rows, start):
            keep, before = np.ones(len(raw.means), bool), self.tally.dropped
            for first in range(0, len(keep), BLOCK):
                part = slice(first, first + BLOCK)
                keep[part] = self.tally.clean(raw.take(part))
            splats = raw.activated()
            yield splats if self.tally.dropped == before else splats.take(keep)

    def all_notes(self) -> tuple[Note, ...]:
        """What was noticed, once `blocks` is through.

        Raises:
            InputError: there was no row, or none that is finite.
        """
        return (*self.notes, *self.tally.notes(self.path))


def open_stream(path: str | Path) -> SceneStream:
    """A scene to be read block by block.

    Args:
        path: a 3DGS .ply.

    Raises:
        InputError: nothing is there, it is broken, or its format is not streamed.
    """
    from g2ard.io.detect import file_format

    path, found = Path(path), file_format(path)
    if found not in STREAMED:
        raise InputError(
            f"{path}: scenes of this format ({found}) are not read in blocks; convert it to .ply"
        )
    stream: SceneStream = import_module(f"g2ard.io.{found}").stream(path)
    return stream


def file_identity(files: Sequence[Path]) -> list[Any]:
    """Of each file its name, size, time of change and the hash of its ends."""
    identity = []
    for path in files:
        try:
            state = path.stat()
            with path.open("rb") as file:
                digest = hashlib.sha256(file.read(_ENDS))
                file.seek(max(0, state.st_size - _ENDS))
                digest.update(file.read(_ENDS))
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        identity.append([path.name, state.st_size, state.st_mtime_ns, digest.hexdigest()])
    return identity
