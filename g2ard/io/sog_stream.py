"""SOG scenes in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.io.sanitize import Raw
from g2ard.io.sog_chunk import Chunk, Decoder, means_of
from g2ard.io.stream import SceneStream, file_identity
from g2ard.io.types import Note

__all__ = ["SogStream"]


class SogStream(SceneStream):
    """A scene of one or many chunks; blocks end where chunks do.

    Args:
        path: names the scene.
        counts: Gaussians of each chunk.
        rest: coefficients past band 0, the most of any chunk.
        offset: (3,) float64.
        notes: what was noticed so far.
        files: what the scene is made of.
        opened: gives the chunks, open to be read.
    """

    def __init__(
        self,
        path: Path,
        counts: list[int],
        rest: int,
        offset: NDArray[np.float64],
        notes: tuple[Note, ...],
        files: list[Path],
        opened: Callable[[], AbstractContextManager[list[Chunk]]],
    ) -> None:
        super().__init__(path, sum(counts), rest, offset, notes)
        self._counts, self._rest, self._files, self._opened = counts, rest, files, opened

    def identity(self) -> list[Any]:
        return file_identity(self._files)

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        with self._opened() as chunks:
            for chunk, count in zip(chunks, self._counts, strict=True):
                yield means_of(chunk, count)

    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        with self._opened() as chunks:
            for chunk, count in zip(chunks, self._counts, strict=True):
                if start >= count:
                    start -= count
                    continue
                decoder = Decoder(chunk, count)
                for at in range(start, count, rows):
                    raw = Raw.empty(min(rows, count - at), self._rest)
                    raw.offset = self.offset
                    decoder.fill(slice(at, at + len(raw.means)), raw)
                    yield raw
                start = 0
