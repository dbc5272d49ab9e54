"""Helpers for writers of packed formats: checks, row order, quaternions."""

from itertools import pairwise

import numpy as np

from g2ard.arrays import Bytes, Float, Int, Rows, Values
from g2ard.errors import InputError
from g2ard.io.jsonfile import Json
from g2ard.io.sanitize import LOG_SCALE_LIMIT
from g2ard.scene.splats import Splats
from g2ard.scene.transform import as_stored, moved_axes

_MORTON_BITS = 21
# distance of near rows from the median, as a multiple of the 75th percentile of all distances
_NEAR = 4.0

FAR_FROM_ORIGIN = 32_752.0
"""Distance of a scene's middle from the origin beyond which half floats may overflow: half their largest."""

_OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Indices of the components of a quaternion other than one."""


def writable(splats: Splats) -> Splats:
    """Return the scene, or raise an `InputError` if it is empty or not finite."""
    if not len(splats):
        raise InputError("not written: the scene has no Gaussians")
    bad = np.flatnonzero(~splats.finite_rows())
    if len(bad):
        raise InputError(f"not written: Gaussian {bad[0]} is not finite")
    return splats


def own_place(stored: Splats) -> Json:
    """Return what a file states under "g2ard" of a scene `as_stored`: axes, and the offset in these axes."""
    offset = moved_axes(stored.offset, "RDF", stored.axes)
    own: Json = {}
    if offset.any():
        own["offset"] = offset.tolist()
    if stored.axes != "RDF":
        own["axes"] = stored.axes
    return own


def rounding(splats: Splats, stored: Splats | Float) -> float:
    """Return the largest difference of a coordinate from its stored value, in scene units.

    `stored` is the scene as stored, or its (N, 3) world coordinates; rows in the same order.
    """
    if stored is splats or not len(splats):
        return 0.0
    if isinstance(stored, Splats):
        world = stored.means + (stored.offset - splats.offset)
    else:
        world = stored - splats.offset
    changes = np.abs(world - splats.means)
    return float(np.nanmax(changes))


def as_packed(splats: Splats) -> Splats:
    """Return a scene `as_stored` for a format of a few bits per coordinate: about its middle if that is far.

    Viewers keep such positions in half floats, which end at 65,504.
    """
    form = as_stored(writable(splats))
    middle = np.rint(np.median(form.means.astype(float), axis=0))
    if np.abs(middle).max() > FAR_FROM_ORIGIN:
        return form.recentred(form.offset + middle)
    return form


def packing_order(means: Values, chunk: int = 1) -> Rows:
    """Return rows by shells of distance from the median, and in Morton order within a shell.

    Rows up to four times the 75th percentile of the distances are one shell, and each doubling beyond is
    another, so that a few far rows coarsen neither the cells of the others nor the bounds of their chunks.
    The farthest rows of a shell that do not fill a chunk of `chunk` rows belong to the next one.

    >>> packing_order(np.array([[1.0, 1, 1], [0, 0, 0], [0.9, 1, 1]])).tolist()
    [1, 2, 0]
    """
    from_median = means.astype(float) - np.median(means, axis=0)
    away = np.linalg.norm(from_median, axis=1)
    near = _NEAR * np.percentile(away, 75)
    if not near > 0 or away.max() < near:
        return morton_order(means)
    doublings = np.log2(np.maximum(away / near, 0.5))
    shells = 1 + np.floor(doublings).astype(np.intp)
    outwards = np.argsort(away, kind="stable")
    ends = np.cumsum(np.bincount(shells)) // chunk * chunk
    ends = np.unique([0, *ends[:-1], len(means)])
    ordered = []
    for begin, end in pairwise(ends):
        rows = np.sort(outwards[begin:end])
        ordered.append(rows[morton_order(means[rows])])
    return np.concatenate(ordered)


def morton_order(means: Values) -> Rows:
    """Return rows in Morton order (2²¹ cells per axis, ties by row)."""
    low = means.min(axis=0).astype(float)
    high = means.max(axis=0).astype(float)
    size = max(float((high - low).max()), np.finfo(float).tiny)
    last = (1 << _MORTON_BITS) - 1
    cells = ((means - low) / size * last).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


_SPREADING = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros after each bit."""


def _spread(v: Values) -> Values:
    for shift, mask in _SPREADING:
        shifted = v << np.uint64(shift)
        v = (v | shifted) & np.uint64(mask)
    return v


def log_scales(splats: Splats) -> Float:
    """Return the (N, 3) natural logarithms of scales, clamped to the limits of readers."""
    with np.errstate(divide="ignore"):
        logs = np.log(splats.scales.astype(float))
    return np.clip(logs, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)


def unit_quats(quats: Values) -> Float:
    """Normalise (N, 4) quaternions; zeros become the identity."""
    q = quats.astype(float)
    largest = np.abs(q).max(axis=1, keepdims=True)
    q /= np.maximum(largest, np.finfo(float).tiny)
    norms = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(norms > 0, q / np.maximum(norms, 0.5), [1.0, 0, 0, 0])


def smallest_three(quats: Float) -> tuple[Rows, Float]:
    """Return the index of each unit quaternion's largest component, and the other three.

    The sign is chosen so that the largest is positive; the others are within ±1/√2.

    >>> largest, others = smallest_three(np.array([[0.6, 0, -0.8, 0]]))
    >>> largest.tolist(), others.tolist()
    ([2], [[-0.6, 0.0, 0.0]])
    """
    largest = np.argmax(np.abs(quats), axis=1)
    rows = np.arange(len(quats))
    signs = np.where(quats[rows, largest] < 0, -1.0, 1.0)
    signed = quats * signs[:, None]
    others = signed[rows[:, None], _OTHER_COMPONENTS[largest]]
    return largest, others + 0.0  # no −0


def from_smallest_three(largest: Values, others: Float) -> Float:
    """Return the (N, 4) unit quaternions that `smallest_three` takes apart."""
    quats = np.empty((len(others), 4))
    rows = np.arange(len(others))
    quats[rows[:, None], _OTHER_COMPONENTS[largest]] = others
    rest = 1 - (others**2).sum(axis=1)
    quats[rows, largest] = np.sqrt(np.maximum(0, rest))
    return quats


def as_bytes(values: Values) -> Bytes:
    """Round values to bytes, clipped to 0 … 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def coded(values: Values, top: int) -> Int:
    """Round values in [0, 1] to integers in 0 … top."""
    return np.clip(np.rint(values * top), 0, top).astype(np.int64)
