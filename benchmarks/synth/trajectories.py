"""Camera paths of the four splits: along streets and over roofs, no two splits on one path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.synth.layout import PITCH, Layout
from benchmarks.synth.shapes import Float
from g2ard.scene.cameras import Cameras, look_at

__all__ = ["SPLITS", "split_counts", "trajectories"]

SPLITS = ("train", "val", "adapt", "ood")
_SHARES = (0.70, 0.10, 0.08, 0.12)
"""Share of all views per split; the paper's MatrixCity has 4,075 · 510 · 341 · 495."""

_FOV = 65.0
"""Horizontal field of view of the photos, degrees."""

_LANE = 1.6
"""Metres from the street's centre line at which a car drives."""
_YAWS = (0.0, 55.0, -55.0, 25.0, -90.0, 90.0)


def split_counts(views: int) -> dict[str, int]:
    """Return the number of views per split: at least one each, and the rest for the train pool.

    >>> split_counts(40)
    {'train': 28, 'val': 4, 'adapt': 3, 'ood': 5}
    """
    rest = {
        name: max(1, round(views * share))
        for name, share in zip(SPLITS[1:], _SHARES[1:], strict=True)
    }
    return {"train": views - sum(rest.values()), **rest}


def _pose(at: Float, yaw: float, pitch: float) -> Float:
    """camera_from_world at `at`, facing `yaw` degrees counter-clockwise from +x and `pitch` degrees up."""
    a, e = np.deg2rad(yaw), np.deg2rad(pitch)
    return look_at(at, at + np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]))


def _drives(layout: Layout, parity: int, lane: float) -> list[tuple[Float, Float]]:
    """Return start and end of a drive along every second street each way; odd ones run through the middle."""
    out = []
    for axis in (0, 1):
        end = layout.reach[1 - axis] - 2.0
        for k, across in enumerate(layout.streets(axis)):
            if k % 2 != parity:
                continue
            forwards = 1.0 if (k // 2) % 2 == 0 else -1.0
            turn = np.array([1.0, -1.0])[axis]  # traffic keeps to the right
            a, b = np.zeros(2), np.zeros(2)
            a[axis] = b[axis] = across + turn * forwards * lane
            a[1 - axis], b[1 - axis] = -forwards * end, forwards * end
            out.append((a, b))
    return out


def _along(path: list[tuple[Float, Float]], count: int) -> tuple[Float, NDArray[np.float64]]:
    """`count` points evenly spaced over all segments, and each one's heading in degrees."""
    lengths = np.array([np.linalg.norm(b - a) for a, b in path])
    ends = np.cumsum(lengths)
    s = (np.arange(count) + 0.5) / count * ends[-1]
    k = np.minimum(np.searchsorted(ends, s, side="right"), len(path) - 1)
    share = (s - (ends - lengths)[k]) / lengths[k]
    starts, stops = np.array([a for a, _ in path]), np.array([b for _, b in path])
    heading = np.rad2deg(np.arctan2(*(stops - starts)[k].T[::-1]))
    return starts[k] + share[:, None] * (stops - starts)[k], heading


def _inwards(layout: Layout, at: Float, heading: float, yaw: float) -> float:
    """The direction to face, with `yaw` mirrored where it would look away from the city at its edge."""
    facing = np.deg2rad(heading + yaw)
    outwards = np.where(np.abs(at) > layout.reach - 6.0, np.sign(at), 0.0)
    leaving = outwards @ [np.cos(facing), np.sin(facing)] > 0.3
    return heading - yaw if leaving else heading + yaw


def _street(
    layout: Layout, count: int, parity: int, lane: float, height: float, pitch: float
) -> list[Float]:
    at, heading = _along(_drives(layout, parity, lane), count)
    return [
        _pose(
            np.array([*at[i], height]),
            _inwards(layout, at[i], heading[i], _YAWS[i % len(_YAWS)]),
            pitch,
        )
        for i in range(count)
    ]


def _lawnmower(layout: Layout, count: int, height: float, pitch: float, axis: int) -> list[Float]:
    """Parallel passes over the roofs, looking obliquely to all four sides in turn."""
    reach = layout.reach
    passes = max(2, layout.blocks + 1)
    across = (np.arange(passes) + 0.5) / passes * 2 * reach[axis] - reach[axis]
    path = []
    for k, c in enumerate(across):
        a, b = np.zeros(2), np.zeros(2)
        a[axis] = b[axis] = c
        a[1 - axis], b[1 - axis] = np.array([-1, 1]) * reach[1 - axis] * (1 if k % 2 == 0 else -1)
        path.append((a, b))
    at, heading = _along(path, count)
    return [
        _pose(np.array([*at[i], height]), heading[i] + 90.0 * (i % 4) + 20.0, pitch)
        for i in range(count)
    ]


def _drone(layout: Layout, count: int) -> list[Float]:
    """Low flights above the traffic of every street, across the lanes the cars used."""
    path = [(b, a) for parity in (1, 0) for a, b in _drives(layout, parity, -0.4)]
    at, heading = _along(path, count)
    return [
        _pose(
            np.array([*at[i], 9.0 + 4.0 * (i % 3)]),
            _inwards(layout, at[i], heading[i], (40.0, -65.0, 150.0)[i % 3]),
            -18.0,
        )
        for i in range(count)
    ]


def _circle(layout: Layout, count: int) -> list[Float]:
    """A wide orbit from outside the city, facing its middle."""
    turn = 2 * np.pi * (np.arange(count) + 0.25) / count
    radius = layout.reach + 0.6 * min(PITCH)
    height = 55.0 + 0.12 * layout.reach.max()
    return [
        look_at(
            [radius[0] * np.cos(a), radius[1] * np.sin(a), height], [8 * np.sin(3 * a), 0.0, 5.0]
        )
        for a in turn
    ]


def trajectories(layout: Layout, views: int, size: tuple[int, int]) -> dict[str, Cameras]:
    """The four splits' cameras, in the layout's own coordinates.

    Args:
        layout: the city.
        views: how many in all.
        size: width and height in pixels.

    Returns:
        train (drives along every second street, flights over the roofs), val (views held out evenly from
        these), adapt (drives along the other streets, flights across the train ones) and ood (low drone
        flights and a wide orbit).
    """
    counts = split_counts(views)
    both = counts["train"] + counts["val"]
    aerial = both * 2 // 5
    pool = _street(layout, both - aerial, 1, _LANE, 2.3, 4.0) + _lawnmower(
        layout, aerial, 62.0, -48.0, 0
    )
    held = np.floor((np.arange(counts["val"]) + 0.5) * both / counts["val"]).astype(int)
    adapt_aerial = counts["adapt"] // 3
    poses = {
        "train": [pose for i, pose in enumerate(pool) if i not in set(held.tolist())],
        "val": [pool[i] for i in held],
        "adapt": _street(layout, counts["adapt"] - adapt_aerial, 0, 1.2, 1.8, 7.0)
        + _lawnmower(layout, adapt_aerial, 75.0, -35.0, 1),
        "ood": _drone(layout, counts["ood"] - counts["ood"] // 2)
        + _circle(layout, counts["ood"] // 2),
    }
    width, height = size
    focal = width / 2 / np.tan(np.deg2rad(_FOV) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return {
        name: Cameras.from_lists(
            viewmats,
            [K] * len(viewmats),
            [size] * len(viewmats),
            [f"{name}_{i:04d}" for i in range(len(viewmats))],
        )
        for name, viewmats in poses.items()
    }
