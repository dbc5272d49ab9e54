"""Scenes in blocks, for scenes larger than memory."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import RenderModel
from g2ard.io.paths import file_identity
from g2ard.io.sanitize import BLOCK, Raw, Tally
from g2ard.io.types import Note, Scene
from g2ard.scene.splats import Splats
from g2ard.scene.transform import one_model

_DEGREE_OF_REST = {0: 0, 3: 1, 8: 2, 15: 3}


class SceneStream(ABC):
    """Scene that can be read from any row.

    Attributes:
        path: path for messages.
        count: rows in the source, including those that will be dropped.
        sh_degree: 0–3.
        offset: (3,) float64, world = means + offset.
        notes: notes on the header.
        render_model: see `Splats`; may be changed before reading.
        tally: counts over the rows that `blocks` has read.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        rest: int = 0,
        offset: NDArray[np.float64] | None = None,
        notes: tuple[Note, ...] = (),
        render_model: RenderModel = "classic",
    ) -> None:
        self.path, self.count, self.notes, self.tally = path, count, notes, Tally()
        self.render_model = render_model
        self.sh_degree = _DEGREE_OF_REST[rest]
        self.offset = np.zeros(3) if offset is None else offset

    def identity(self) -> list[Any]:
        """Return JSON that identifies this source, see `file_identity`."""
        return file_identity([self.path])

    @abstractmethod
    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        """Yield the (n, 3) means of all rows in blocks, without cleaning."""

    @abstractmethod
    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        """Yield rows from `start` in blocks of at most `rows`, cleaned as in `g2ard.io.read_scene`."""

    def all_notes(self) -> tuple[Note, ...]:
        """Return all notes once `blocks` has finished; raise an `InputError` if no row is finite."""
        return (*self.notes, *self.tally.notes(self.path))

    def whole(self) -> Scene:
        """Read all rows into memory."""
        raw, kept = Raw.empty(self.count, (self.sh_degree + 1) ** 2 - 1), 0
        for block in self.blocks(BLOCK):
            raw.take(slice(kept, kept := kept + len(block))).fill(block)
        notes = self.all_notes()
        return Scene(raw.take(slice(kept)).activated(self.render_model, self.offset), notes)


class RawStream(SceneStream):
    """Scene whose rows must be cleaned."""

    @abstractmethod
    def raw(self, rows: int, start: int) -> Iterator[Raw]:
        """Yield the source's rows from `start`, at most `rows` at a time; callers may change the arrays."""

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        return (raw.means for raw in self.raw(rows, 0))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for raw in self.raw(rows, start):
            keep, before = np.ones(len(raw.means), bool), self.tally.dropped
            for first in range(0, len(keep), BLOCK):
                part = slice(first, first + BLOCK)
                keep[part] = self.tally.clean(raw.take(part))
            splats = raw.activated(self.render_model, self.offset)
            yield splats if self.tally.dropped == before else splats.take(keep)


class PartsStream(SceneStream):
    """Scene of clean parts that are loaded one at a time.

    Args:
        part: function that loads a part by index.
        identity: JSON that identifies the scene.
    """

    def __init__(
        self,
        path: Path,
        counts: Sequence[int],
        part: Callable[[int], Splats],
        sh_degree: int,
        offset: NDArray[np.float64],
        identity: list[Any],
        notes: tuple[Note, ...] = (),
        render_model: RenderModel = "classic",
    ) -> None:
        super().__init__(path, sum(counts), (sh_degree + 1) ** 2 - 1, offset, notes, render_model)
        self._counts, self._part, self._identity = counts, part, identity

    def identity(self) -> list[Any]:
        return self._identity

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        return (self._part(number).means for number in range(len(self._counts)))

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for number, begin in from_row(self._counts, start):
            part = replace(self._part(number), render_model=self.render_model)
            for first in range(begin, len(part), rows):
                block = part.take(slice(first, first + rows))
                self.tally.add(block)
                yield block

    def all_notes(self) -> tuple[Note, ...]:
        return self.notes


class JoinedScenes(SceneStream):
    """Several scenes as one."""

    def __init__(self, streams: list[SceneStream]) -> None:
        rest = (max(stream.sh_degree for stream in streams) + 1) ** 2 - 1
        count = sum(stream.count for stream in streams)
        notes = [replace(n, text=f"{s.path}: {n.text}") for s in streams for n in s.notes]
        model = one_model([stream.render_model for stream in streams])
        super().__init__(streams[0].path, count, rest, streams[0].offset, tuple(notes), model)
        self._streams, self._rest = streams, rest

    def identity(self) -> list[Any]:
        return [stream.identity() for stream in self._streams]

    def positions(self, rows: int) -> Iterator[NDArray[np.float32]]:
        for stream in self._streams:
            for means in stream.positions(rows):
                yield self._moved(means, stream.offset)

    def blocks(self, rows: int, start: int = 0) -> Iterator[Splats]:
        for number, begin in from_row([stream.count for stream in self._streams], start):
            stream = self._streams[number]
            stream.tally = self.tally
            for block in stream.blocks(rows, begin):
                shN = np.zeros((len(block), self._rest, 3), np.float32)
                shN[:, : block.shN.shape[1]] = block.shN
                means = self._moved(block.means, stream.offset)
                yield replace(block, means=means, shN=shN, offset=self.offset)

    def _moved(self, means: NDArray[np.float32], offset: NDArray[np.float64]) -> NDArray[np.float32]:
        shift = offset - self.offset
        return (means + shift).astype(np.float32) if shift.any() else means


def from_row(counts: Sequence[int], start: int) -> Iterator[tuple[int, int]]:
    """Yield the index and the first row of each part that ends after row `start` of all parts."""
    for number, count in enumerate(counts):
        if start < count:
            yield number, start
        start = max(0, start - count)
