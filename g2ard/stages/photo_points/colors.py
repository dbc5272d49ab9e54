"""Colours for points from the photos that see them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from g2ard.arrays import Float, Float32, Mask, Rows
from g2ard.io.paths import file_identity
from g2ard.io.photos import load_photo
from g2ard.io.sanitize import Tally
from g2ard.io.stream import MarkedPoints, PointStream, RawPoints
from g2ard.io.types import Cloud, Note, Notes, Points
from g2ard.progress import Progress, Say, plural, silent
from g2ard.scene.cameras import Cameras, within_frame
from g2ard.system.cached import cached_property
from g2ard.system.keys import key_of

_PHOTO_SIDE = 640
"""Longer side in pixels of the photos that colour points."""
_SEEN = 9
"""Photos of which a point takes the median."""
_CELL_POINTS = 4
"""Points per cell of the grid in which the nearest hide others."""
_DEPTH_SLACK = 0.05
"""Relative depth behind the nearest point of a cell within which points are seen."""
_HIDING = 200_000
"""Points of a cloud in blocks, to twice as many, that hide others."""
_UNCOLORED_NOTES = ("grey", "black", "black_points")


def colored(
    cloud: Cloud,
    train: Cameras,
    name: str,
    *,
    progress: Progress = silent,
    say: Say,
) -> Points:
    """Return a cloud's points, those without a colour with that of training photos, where any sees them."""
    points = cloud.points
    bare = ~cloud.colored
    if not bare.any():
        return points
    cameras = train.fitted(_PHOTO_SIDE)
    rows = [row for row, path in enumerate(cameras.image_paths) if path is not None]
    found, seen = median_colors(points.positions, bare, cameras.take(rows), progress)
    colors = _with_photo_colors(points.colors, bare, found, seen)
    if seen.any():
        shown = f"{int(seen.sum()):,} of {plural(len(seen), 'point')} without colours"
        say(f"{name}: {shown} take them from the photos that see them")
    return Points(points.positions, colors)


class ColoredStream(PointStream):
    """A point cloud without colours in blocks, whose points take those of photos, as by `colored`.

    Its points that hide others are a sample.

    Args:
        planned: leave points as they are, in a dry run.
    """

    def __init__(
        self,
        stream: PointStream,
        cameras: Cameras,
        *,
        planned: bool = False,
    ) -> None:
        vars(self).update(vars(stream))  # the same cloud
        pictured = [row for row, path in enumerate(cameras.image_paths) if path is not None]
        self._bare = stream
        self._photos = cameras.take(pictured).fitted(_PHOTO_SIDE)
        self._planned = planned
        self.channels = 3

    @cached_property
    def hiding(self) -> Float:
        """Points that hide others."""
        stride = max(1, self.count // _HIDING)
        read = 0
        parts = []
        for near in self.positions(1 << 20):
            parts.append(near[-read % stride :: stride])
            read += len(near)
        points = np.concatenate(parts)
        return points[np.isfinite(points).all(axis=1)] + self.offset

    def __getstate__(self) -> dict[str, Any]:
        _ = self.hiding  # found once, not by each process
        return super().__getstate__()

    def identity(self) -> list[Any]:
        paths = (*self._photos.image_paths, *self._photos.mask_paths)
        photos = [path for path in paths if path is not None]
        return [
            self._bare.identity(),
            key_of(self._photos),
            file_identity(photos),
        ]

    def absolute(self) -> Self:
        found = super().absolute()
        found._bare = self._bare.absolute()
        found._photos = replace(
            self._photos,
            image_paths=_make_absolute(self._photos.image_paths),
            mask_paths=_make_absolute(self._photos.mask_paths),
        )
        return found

    def parts(self, rows: int) -> list[tuple[int, int]]:
        return self._bare.parts(rows)

    def tallies(self) -> list[Tally]:
        return self._bare.tallies()

    def all_notes(self) -> Notes:
        notes = self._bare.all_notes()
        kept = tuple(note for note in notes if note.code not in _UNCOLORED_NOTES)
        bare = sum(note.count for note in notes if note.code in _UNCOLORED_NOTES)
        if not bare:
            return kept
        text = f"{plural(bare, 'point')} without colours take them from the photos that see them"
        return (*kept, Note("photo_colors", bare, text))

    def raw(self, rows: int, start: int) -> Iterator[MarkedPoints]:
        return self._bare.raw(rows, start)

    def blocks(self, rows: int, start: int = 0) -> Iterator[RawPoints]:
        for positions, colors in self._bare.blocks(rows, start):
            if not self._planned:
                bare = np.ones(len(positions), bool)
                found, seen = median_colors(positions, bare, self._photos, hiding=self.hiding)
                colors = _with_photo_colors(colors, bare, found, seen)
            yield positions, colors


def _make_absolute(paths: Sequence[Path | None]) -> tuple[Path | None, ...]:
    return tuple(None if path is None else path.absolute() for path in paths)


def _with_photo_colors(
    colors: Float32,
    bare: Mask,
    found: Float32,
    seen: Mask,
) -> Float32:
    """Return colours with those that photos show; black that none shows becomes the usual colour."""
    black = not colors[bare].any()
    colors = colors.copy()
    colors[np.flatnonzero(bare)[seen]] = found[seen]
    if seen.any() and black:
        colors[np.flatnonzero(bare)[~seen]] = np.median(found[seen], axis=0)
    return colors


def median_colors(
    positions: Float,
    wanted: Mask,
    cameras: Cameras,
    progress: Progress = silent,
    *,
    hiding: Float | None = None,
) -> tuple[Float32, Mask]:
    """Return the (n, 3) median colours of the wanted points in photos that see them, and whether any does.

    Of each photo, all points are drawn into cells of a few; those behind the nearest of a cell are hidden.

    Args:
        positions: (N, 3) world coordinates.
        wanted: (N,), n of which are true.
        hiding: (M, 3) points that hide others, None for all positions.
    """
    own = np.flatnonzero(wanted)
    kept = np.zeros((len(own), _SEEN, 3), np.uint8)
    count = np.zeros(len(own), np.intp)
    for done, view in enumerate(np.random.default_rng(0).permutation(len(cameras)).tolist()):
        progress("colour points", done, len(cameras))
        few = np.flatnonzero(count < _SEEN)
        if hiding is None:
            pixels, visible = (
                found[own[few]] for found in _find_seen(positions, positions, cameras, view)
            )
        else:
            pixels, visible = _find_seen(positions[own[few]], hiding, cameras, view)
        u, v = pixels[visible].T
        rows = few[visible]
        if not len(rows):
            continue
        image, mask = load_photo(cameras, view, None)
        sample = image[v, u]
        if mask is not None:
            held = mask[v, u]
            rows = rows[held]
            sample = sample[held]
        if image.shape[2] == 4:
            opaque = sample[:, 3] > 0.5
            rows = rows[opaque]
            sample = sample[opaque]
            sample = sample[:, :3] / sample[:, 3:]
        kept[rows, count[rows]] = np.rint(255 * np.clip(sample, 0, 1))
        count[rows] += 1
    colors = np.zeros((len(own), 3), np.float32)
    for seen in range(1, _SEEN + 1):
        rows = np.flatnonzero(count == seen)
        colors[rows] = np.median(kept[rows, :seen], axis=1) / 255
    return colors, count > 0


def _find_seen(
    positions: Float,
    hiding: Float,
    cameras: Cameras,
    view: int,
) -> tuple[Rows, Mask]:
    """Return (N, 2) columns and rows of points in a view, and whether they are inside and not hidden."""
    own = _project(positions, cameras, view)
    if hiding is positions:
        others, depths, drawn = own
    else:
        others, depths, drawn = _project(hiding, cameras, view)
    pixels, depth, inside = own
    width = int(cameras.widths[view])
    height = int(cameras.heights[view])
    cell_pixels = width * height * _CELL_POINTS / max(1, int(drawn.sum()))
    side = max(1.0, np.sqrt(cell_pixels))
    across = int(width / side) + 1
    down = int(height / side) + 1

    def cells(at: Rows) -> Rows:
        column, row = (at / side).astype(np.intp).T
        return row * across + column

    nearest = np.full(across * down, np.inf)
    np.minimum.at(nearest, cells(others[drawn]), depths[drawn])
    hidden_from = (1 + _DEPTH_SLACK) * nearest[cells(pixels)]
    return pixels, inside & (depth <= hidden_from)


def _project(positions: Float, cameras: Cameras, view: int) -> tuple[Rows, Float, Mask]:
    """Return (N, 2) columns and rows of points in a view, their depths, and whether they are inside."""
    width = int(cameras.widths[view])
    height = int(cameras.heights[view])
    pose = cameras.viewmats[view]
    (fx, _, cx), (_, fy, cy), _ = cameras.Ks[view]
    local = positions @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = local[:, 0] / depth * fx + cx
        v = local[:, 1] / depth * fy + cy
    inside = within_frame(u, v, width, height)
    inside &= depth > 0
    pixels = np.where(
        inside[:, None],
        np.stack([u, v], axis=1),
        0,
    )
    return pixels.astype(np.intp), depth, inside
