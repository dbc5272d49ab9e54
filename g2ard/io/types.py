"""What readers hand back: the data, and what was noticed on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError

if TYPE_CHECKING:
    from g2ard.scene.cameras import Cameras
    from g2ard.scene.splats import Splats


@dataclass(frozen=True)
class Note:
    """One thing a reader did that its caller should hear of.

    Args:
        code: a stable word for machines: `dropped_rows`, `clamped_logits`, `missing_photos`, …
        count: how many rows, properties or files it concerns.
        text: one line for people.
    """

    code: str
    count: int
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False)
class Points:
    """A coloured cloud of N points.

    Args:
        positions: (N, 3) float64, world units: map coordinates keep their precision.
        colors: (N, 3) float32 in [0, 1].

    Raises:
        InputError: shapes that do not fit.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.positions.ndim != 2 or self.positions.shape[1] != 3:
            raise InputError(f"expected shape (N, 3), got {self.positions.shape}", parameter="positions")
        if self.colors.shape != self.positions.shape:
            raise InputError(
                f"expected shape {self.positions.shape}, got {self.colors.shape}", parameter="colors"
            )

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene file's Gaussians, and what was noticed while reading."""

    splats: Splats
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud file's points, and what was noticed while reading."""

    points: Points
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True, eq=False)
class ViewSet:
    """Views, and what their file says beside the cameras.

    Args:
        cameras: C views.
        notes: what was noticed while reading.
        splits: per view "train", "test" or None where the file names no split; () if it has none at all.
        weights: (C,) float64, how often a view should be drawn; None if the file has none.
    """

    cameras: Cameras
    notes: tuple[Note, ...] = ()
    splits: tuple[str | None, ...] = ()
    weights: NDArray[np.float64] | None = None

    def take(self, mask: NDArray[np.bool_]) -> ViewSet:
        """The views that `mask` (C,) selects, with all that belongs to them."""
        rows = np.flatnonzero(mask)
        splits = tuple(self.splits[i] for i in rows) if self.splits else ()
        weights = None if self.weights is None else self.weights[rows]
        return ViewSet(self.cameras.take(rows), self.notes, splits, weights)

    def resized(self, longest: int | None) -> ViewSet:
        """The same views with their longer side shrunk to at most `longest` pixels (None keeps them)."""
        return replace(self, cameras=self.cameras.resized(longest))
