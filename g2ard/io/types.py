"""Results of readers: data and notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from g2ard.arrays import Float, Float32, Mask
from g2ard.config.choices import Alpha, Axes
from g2ard.errors import InputError
from g2ard.progress import plural
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats, unit_colors


@dataclass(frozen=True)
class Note:
    """A note of a reader on changed or ignored data.

    Args:
        code: stable identifier: `dropped_rows`, `clamped_logits`, `missing_photos`, …
        count: number of affected rows, properties or files.
    """

    code: str
    count: int
    text: str

    def __str__(self) -> str:
        return self.text


Notes = tuple[Note, ...]
Size = tuple[int, int]
"""Width and height in pixels."""

Splits = Sequence[str | None]
"""Split of each view, such as "train" or "test", or None."""


@dataclass(frozen=True, eq=False)
class Points:
    """A coloured point cloud of N points.

    Args:
        positions: (N, 3) float64, world units.
        colors: (N, 3) float32 in [0, 1]; uint8 and uint16 are divided by their largest value.

    Raises:
        InputError: the shapes do not match, or a colour is outside [0, 1].
    """

    positions: Float
    colors: Float32

    def __post_init__(self) -> None:
        shape = self.positions.shape
        if len(shape) != 2 or shape[1] != 3:
            raise InputError(f"expected shape (N, 3), got {shape}", parameter="positions")
        if self.colors.shape != shape:
            text = f"expected shape {shape}, got {self.colors.shape}"
            raise InputError(text, parameter="colors")
        object.__setattr__(self, "colors", unit_colors(self.colors).astype(np.float32))

    def __repr__(self) -> str:
        return f"Points({plural(len(self), 'point')})"

    def __len__(self) -> int:
        return len(self.positions)


Noted = tuple[Splats, Notes]
"""Gaussians of a file, and notes."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a file, with notes.

    Args:
        colored: (N,) whether a point has a colour, neither grey from intensities nor black.
        axes: axes of the coordinates; None if neither the format nor a map tells.
    """

    points: Points
    notes: Notes
    colored: Mask
    axes: Axes | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class ViewFiles:
    """Views on disk, with options for their photos; usable wherever a path of views is.

    Args:
        path: the views, as for `g2ard.io.read_views`.
        images: folder to search for photos by file name; None uses those that the views name.
        alpha: "composite" shows transparent pixels over the background; "mask" ignores them.
    """

    path: Path
    images: Path | None = None
    alpha: Alpha = "composite"

    def __str__(self) -> str:
        return str(self.path)

    def file(self, name: str) -> Path:
        """Return the file of this name in the folder of views, or the file of views."""
        if self.path.is_dir():
            return self.path / name
        return self.path


@dataclass(frozen=True, eq=False)
class ViewSet:
    """Views of a file, with splits, weights and notes.

    Args:
        splits: "train", "test" or None per view; () if the file has no splits.
        weights: (C,) float64 sampling weights; None if the file has none.
    """

    cameras: Cameras
    notes: Notes = ()
    splits: tuple[str | None, ...] = ()
    weights: Float | None = None

    def take(self, mask: Mask) -> ViewSet:
        """Select views by a (C,) mask."""
        rows = np.flatnonzero(mask)
        splits = self.splits
        if splits:
            splits = tuple(splits[i] for i in rows)
        weights = self.weights
        if weights is not None:
            weights = weights[rows]
        return ViewSet(self.cameras.take(rows), self.notes, splits, weights)

    def noted(self, code: str, count: int, text: str) -> ViewSet:
        return replace(self, notes=(*self.notes, Note(code, count, text)))

    def fitted(self, longest: int | None) -> ViewSet:
        """Return the views at a requested longer side; photos only shrink, and None keeps all."""
        return replace(self, cameras=self.cameras.fitted(longest))

    def resized(self, longest: int | None) -> ViewSet:
        """Shrink views to a longer side of at most `longest` pixels; None keeps them."""
        return replace(self, cameras=self.cameras.resized(longest))
