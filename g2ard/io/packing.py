"""What writers of packed formats share: rows that can be written, their order, unit quaternions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.errors import InputError
from g2ard.io.sanitize import LOG_SCALE_LIMIT
from g2ard.scene.splats import Splats

_MORTON_BITS = 21


def writable(path: Path, splats: Splats) -> Splats:
    """The scene, if it can be written.

    Raises:
        InputError: it is empty or has a value that is not finite.
    """
    if not len(splats):
        raise InputError("a scene without Gaussians is not written", path=path)
    bad = np.flatnonzero(~splats.finite_rows())
    if len(bad):
        raise InputError(f"not written: Gaussian {bad[0]} is not finite", path=path)
    return splats


def world_means(path: Path, splats: Splats, what: str) -> NDArray[np.float64]:
    """(N, 3) means + offset, for a format that stores no offset and holds float32.

    Raises:
        InputError: float32 there is coarser than half of the Gaussians are thin.
    """
    means = splats.means.astype(np.float64) + splats.offset
    if splats.offset.any():
        step = float(np.spacing(np.abs(means).max().astype(np.float32)))
        thin = float(np.median(splats.scales.min(axis=1)))
        if step > thin:
            raise InputError(
                f"{what} stores no offset, and steps of {step:g} at these coordinates; write "
                ".ply, .compressed.ply, .sog or .glb, or drop the offset with `g2ard convert --recentre`",
                path=path,
            )
    return means


def morton_order(means: NDArray[Any]) -> NDArray[np.intp]:
    """The rows along a Morton curve of 2²¹ cells an axis, ties by row: neighbours in space become neighbours
    in the file, which packs better.

    >>> morton_order(np.array([[1.0, 1, 1], [0, 0, 0], [0.9, 1, 1]])).tolist()
    [1, 2, 0]
    """
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    size = max(float((high - low).max()), np.finfo(float).tiny)
    cells = ((means - low) / size * ((1 << _MORTON_BITS) - 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(v: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Every third bit of the result is a bit of `v`."""
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        v = (v | v << np.uint64(shift)) & np.uint64(mask)
    return v


def log_scales(splats: Splats) -> NDArray[np.float64]:
    """(N, 3) natural logarithms, a scale of 0 at the least that readers keep."""
    with np.errstate(divide="ignore"):
        logs = np.log(splats.scales.astype(np.float64))
    return np.clip(logs, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)


def unit_quats(quats: NDArray[Any]) -> NDArray[np.float64]:
    """(N, 4) of length 1; zeros become the identity."""
    q = quats.astype(np.float64)
    q /= np.maximum(np.abs(q).max(axis=1, keepdims=True), np.finfo(float).tiny)
    norms = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(norms > 0, q / np.maximum(norms, 0.5), [1.0, 0, 0, 0])


def smallest_three(quats: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Which component of each unit quaternion is the largest, and the other three in order, all of the sign
    that makes it positive: each within ±1/√2.

    >>> largest, others = smallest_three(np.array([[0.6, 0, -0.8, 0]]))
    >>> largest.tolist(), others.tolist()
    ([2], [[-0.6, 0.0, 0.0]])
    """
    largest = np.argmax(np.abs(quats), axis=1)
    rows = np.arange(len(quats))
    signed = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[k for k in range(4) if k != i] for i in range(4)])[largest]
    return largest, signed[rows[:, None], others] + 0.0


def coded(values: NDArray[Any], top: int) -> NDArray[np.int64]:
    """Values in [0, 1] as integers in 0 … top, the nearest."""
    return np.clip(np.rint(values * top), 0, top).astype(np.int64)
