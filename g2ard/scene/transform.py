"""Operations of `g2ard convert`: moving, cropping and joining scenes, and axes by name.

Axes are three letters for the directions of x, y and z, such as RDF for right, down, forward.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from g2ard.arrays import Float, Float32, Mask
from g2ard.config.choices import AXES, NAMED_AXES, Axes, RenderModel
from g2ard.errors import InputError, require
from g2ard.scene.splats import ARRAYS, Splats

_RECENTRE_EXTENTS = 16.0
"""Distance in extents beyond which a move goes into `offset`, so that float32 means keep their precision."""

_DIRECTIONS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "U": (0, 1, 0),
    "D": (0, -1, 0),
    "B": (0, 0, 1),
    "F": (0, 0, -1),
}
"""Letter → its direction in the system RUB."""
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes in which each harmonic of bands 1–3 is odd."""


def transform(splats: Splats, matrix: ArrayLike) -> Splats:
    """Apply x ↦ s·R·x + t to means, scales, rotations and harmonics.

    The (4, 4) matrix is a similarity: one scale s > 0, a rotation R, a translation t in scene units. If t
    exceeds 16 extents of the scene, or `offset` is not zero, it moves the float64 `offset`, since float32
    means would lose their digits.

    Raises:
        InputError: the matrix is not a similarity.

    >>> quarter = [[0, -2, 0, 5], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    >>> one = Splats.create([[1, 0, 0]], scales=[[0.1, 0.2, 0.3]])
    >>> moved = transform(one, quarter)
    >>> moved.means.round(6).tolist(), moved.scales.round(6).tolist()
    ([[5.0, 2.0, 0.0]], [[0.20000000298023224, 0.4000000059604645, 0.6000000238418579]])
    """
    scale, rotation, shift = similarity(matrix)
    means = scale * splats.means.astype(np.float64) @ rotation.T
    offset = scale * splats.offset @ rotation.T
    if len(means):
        extent = float(np.linalg.norm(np.ptp(means, axis=0)))
    else:
        extent = 0.0
    # An extent of 0 says nothing about the scene's size.
    far = 0 < _RECENTRE_EXTENTS * extent < np.abs(shift).max()
    if splats.offset.any() or far:
        offset = offset + shift
    else:
        means = means + shift
        offset = np.zeros(3)
    w, x, y, z = quaternion_of(rotation)
    product = np.array(  # of this quaternion with another, on its right
        [
            [w, -x, -y, -z],
            [x, w, -z, y],
            [y, z, w, -x],
            [z, -y, x, w],
        ]
    )
    quats = splats.quats.astype(np.float64) @ product.T
    return replace(
        splats,
        means=means.astype(splats.means.dtype),
        quats=quats.astype(np.float32),
        scales=(splats.scales * scale).astype(np.float32),
        shN=rotate_harmonics(splats.shN, rotation),
        offset=offset,
        up=_turn_up(splats, rotation),
    )


def _turn_up(splats: Splats, matrix: Float) -> Any:
    """Return a scene's up direction after a turn, if it states one."""
    if splats.up is None:
        return None
    return tuple((matrix @ splats.up).tolist())


def moving(scale: float, degrees: Sequence[float], shift: Sequence[float]) -> Float:
    """Return the 4×4 matrix that scales, then rotates about x, y and z in turn, then moves.

    >>> moving(2, (0, 0, 90), (5, 0, 0)).round(6)[:2].tolist()
    [[0.0, -2.0, 0.0, 5.0], [2.0, 0.0, 0.0, 0.0]]
    """
    rotation = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        a = (axis + 1) % 3  # turns towards b
        b = (axis + 2) % 3
        turn = np.eye(3)
        turn[a, a] = np.cos(angle)
        turn[b, b] = np.cos(angle)
        turn[b, a] = np.sin(angle)
        turn[a, b] = -np.sin(angle)
        rotation = turn @ rotation
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = shift
    return matrix


def placed(splats: Splats, matrix: Float) -> Splats:
    """Apply a 4×4 similarity like `transform`; a mere translation only changes `offset`."""
    if (matrix[:3, :3] == np.eye(3)).all():
        return replace(splats, offset=splats.offset + matrix[:3, 3])
    return transform(splats, matrix)


def deformed(splats: Splats, matrix: Float) -> tuple[Splats, bool]:
    """Apply any invertible 4×4 affine map like `placed`; return whether harmonics follow it exactly.

    Covariances become MΣMᵀ. Harmonics follow rotations and mirrors exactly; for other maps, bands 1 to 3 are
    fitted to the colours that c(M⁻¹·d) has, and the base colour stays.
    """
    linear = matrix[:3, :3]
    det = float(np.linalg.det(linear))
    if not np.isfinite(matrix).all() or abs(det) < np.finfo(float).tiny:
        raise InputError("flattens the scene, or is not finite", parameter="transform")
    turn = linear / np.cbrt(det)
    exact = bool(np.allclose(turn @ turn.T, np.eye(3), atol=1e-4))
    if exact and det > 0:
        return placed(splats, matrix), True
    # Σ = A·Aᵀ with the scaled axes A, so M·A = U·S·Vᵀ gives the new axes U and scales S.
    axes = rotation_matrices(splats.quats)
    axes *= splats.scales.astype(np.float64)[:, None, :]
    frames, scales, _ = np.linalg.svd(linear @ axes)
    frames *= np.sign(np.linalg.det(frames))[:, None, None]
    shift = np.eye(4)
    shift[:3, 3] = linear @ splats.offset + matrix[:3, 3]
    shift[:3, 3] -= splats.offset
    moved = placed(replace(splats, up=None), shift)
    if exact:
        shN = rotate_harmonics(splats.shN, np.sign(det) * turn)
    else:
        shN = _warp(splats.shN, linear)
    means = splats.means.astype(np.float64) @ linear.T
    scene = replace(
        moved,
        means=means.astype(splats.means.dtype),
        quats=_to_quaternions(frames),
        scales=scales.astype(np.float32),
        shN=shN,
    )
    return scene, exact


def _warp(shN: Float32, linear: Float) -> Float32:
    """Fit coefficients of bands 1 to 3 to c'(d) = c(M⁻¹·d) over many directions."""
    directions = _draw_directions(512)
    before = directions @ np.linalg.inv(linear).T
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    rest = shN.shape[1]
    warped = _recombine(
        shN,
        _evaluate_basis(directions)[:, :rest],
        _evaluate_basis(before)[:, :rest],
    )
    return warped.astype(np.float32)


def _draw_directions(count: int) -> Float:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def _recombine(coefficients: Float32, here: Float, there: Float) -> Float:
    """Return coefficients with which the basis `here` gives the colours that it gave with these `there`.

    Args:
        coefficients: (N, K, 3).
        here: (D, K) basis in some directions.
        there: (D, K) basis in the directions that these were before.
    """
    turn, *_ = np.linalg.lstsq(here, there, rcond=None)
    return np.einsum("kj,njc->nkc", turn, coefficients.astype(np.float64))


def _to_quaternions(rotations: Float) -> Float32:
    """Return (N, 4) wxyz of (N, 3, 3) rotations, by the largest of the four components.

    A rotation gives all products 4·q_a·q_b. Their row of the largest component is that quaternion but for
    its length.
    """
    r = rotations
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    products = np.empty((len(r), 4, 4))
    products[:, 0, 0] = trace + 1
    for i in range(3):
        products[:, i + 1, i + 1] = 2 * r[:, i, i] - trace + 1
    for a, b, i, j, sign in _PRODUCTS:
        product = r[:, i, j] + sign * r[:, j, i]
        products[:, a, b] = product
        products[:, b, a] = product
    squares = np.einsum("nii->ni", products)
    largest = squares.argmax(axis=1)
    quats = products[np.arange(len(r)), largest]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats.astype(np.float32)


_PRODUCTS = (
    (0, 1, 2, 1, -1),
    (0, 2, 0, 2, -1),
    (0, 3, 1, 0, -1),
    (1, 2, 0, 1, 1),
    (1, 3, 0, 2, 1),
    (2, 3, 1, 2, 1),
)
"""(a, b, i, j, sign): the product of components a and b is R[i, j] + sign·R[j, i]."""


def similarity(matrix: ArrayLike) -> tuple[float, Float, Float]:
    """Decompose a 4×4 matrix into s, R (3, 3) and t (3,), or raise an `InputError` if it is no similarity."""
    m = np.asarray(matrix, np.float64)
    if m.shape != (4, 4) or not np.isfinite(m).all() or not np.allclose(m[3], [0, 0, 0, 1]):
        raise InputError(
            "expected 4×4 finite numbers, row-major, the last row 0 0 0 1", parameter="transform"
        )
    linear = m[:3, :3]
    det = float(np.linalg.det(linear))
    if det <= 0:
        raise InputError(
            f"mirrors or flattens the scene (its determinant is {det:g})", parameter="transform"
        )
    scale = det ** (1 / 3)
    rotation = linear / scale
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        raise InputError(
            "shears, or scales differently along different axes; Gaussians cannot follow",
            parameter="transform",
        )
    u, _, v = np.linalg.svd(rotation)
    return scale, u @ v, m[:3, 3]


def unit_up(up: ArrayLike) -> Float:
    """Return the (3,) unit vector of an up direction, after checking it."""
    axis = np.asarray(up, np.float64)
    if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
        raise InputError(f"expected three finite numbers, not all zero, got {up!r}", parameter="up")
    return np.asarray(axis / np.linalg.norm(axis))


def quaternion_of(rotation: Float) -> Float:
    """Return (4,) wxyz: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    upper = np.array(
        [
            [np.trace(rotation), zy - yz, xz - zx, yx - xy],
            [0, xx - yy - zz, xy + yx, xz + zx],
            [0, 0, yy - xx - zz, yz + zy],
            [0, 0, 0, zz - xx - yy],
        ]
    )
    _, vectors = np.linalg.eigh(np.triu(upper) + np.triu(upper, 1).T)  # ascending
    q: Float = vectors[:, -1]
    if q[0] >= 0:
        return q
    return -q


def rotation_matrices(quats: NDArray[np.floating]) -> Float:
    """Return (N, 3, 3) matrices of (N, 4) wxyz quaternions of any length; zero is the identity."""
    q = quats.astype(np.float64)
    largest = np.abs(q).max(1, keepdims=True)  # divided by first, so that no square overflows
    scaled = q / np.where(largest > 0, largest, 1)
    q = np.where(largest > 0, scaled, [1.0, 0.0, 0.0, 0.0])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    w, x, y, z = q.T
    matrices = np.empty((len(quats), 3, 3))
    matrices[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[:, 0, 1] = 2 * (x * y - w * z)
    matrices[:, 0, 2] = 2 * (x * z + w * y)
    matrices[:, 1, 0] = 2 * (x * y + w * z)
    matrices[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[:, 1, 2] = 2 * (y * z - w * x)
    matrices[:, 2, 0] = 2 * (x * z - w * y)
    matrices[:, 2, 1] = 2 * (y * z + w * x)
    matrices[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return matrices


def rotate_harmonics(shN: Float32, rotation: Float) -> Float32:
    """Rotate the coefficients of bands 1 to 3 by R: c'(d) = c(R⁻¹·d).

    Bands rotate separately: the matrix M of a band solves Y(d)·M = Y(R⁻¹·d) by least squares over many
    directions.
    """
    turned = np.empty_like(shN)
    directions = _draw_directions(64)
    here = _evaluate_basis(directions)
    there = _evaluate_basis(directions @ rotation)
    for band in range(1, 4):
        rows = slice(band * band - 1, (band + 1) ** 2 - 1)
        if rows.stop > shN.shape[1]:
            break
        turned[:, rows] = _recombine(
            shN[:, rows],
            here[:, rows],
            there[:, rows],
        )
    return turned


def harmonic_signs(axes: Iterable[float]) -> Float32:
    """Return the (15,) signs of the coefficients of bands 1 to 3 when axes x, y and z get these signs.

    >>> harmonic_signs((1, -1, -1))[:3].tolist()
    [-1.0, -1.0, 1.0]
    """
    signs = dict(zip("xyz", axes, strict=True))
    return np.array([math.prod(signs[axis] for axis in odd) for odd in _ODD], np.float32)


def _evaluate_basis(d: Float) -> Float:
    """Return the (N, 15) real harmonics of bands 1 to 3 at unit vectors."""
    x, y, z = d.T
    xx = x * x
    yy = y * y
    zz = z * z
    a = 1.0925484305920792
    b = 0.31539156525252005
    c = 0.5462742152960396
    e = 0.5900435899266435
    f = 2.890611442640554
    g = 0.4570457994644658
    h = 0.3731763325901154
    columns: list[Any] = [
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        a * x * y,
        -a * y * z,
        b * (2 * zz - xx - yy),
        -a * x * z,
        c * (xx - yy),
        -e * y * (3 * xx - yy),
        f * x * y * z,
        -g * y * (4 * zz - xx - yy),
        h * z * (2 * zz - 3 * xx - 3 * yy),
        -g * x * (4 * zz - xx - yy),
        0.5 * f * z * (xx - yy),
        -e * x * (xx - 3 * yy),
    ]
    return np.stack(columns, axis=1)


def change_of_axes(source: str, target: str) -> Float:
    """Return the (3, 3) matrix from coordinates in one system to those in another; it may mirror.

    >>> change_of_axes("RUB", "RFU") @ [1, 2, 3]
    array([ 1., -3.,  2.])
    >>> change_of_axes("y-up", "z-up") @ [1, 2, 3]
    array([ 1., -3.,  2.])
    """
    return _directions_of(target) @ _directions_of(source).T


def _directions_of(name: str) -> Float:
    """Return the (3, 3) rows of directions of a system's axes."""
    letters = NAMED_AXES.get(name, name)
    require("axes", repr(name), letters in AXES, f"one of {', '.join((*NAMED_AXES, *AXES))}")
    return np.array([_DIRECTIONS[letter] for letter in letters], float)


def with_axes(splats: Splats, matrix: Float) -> Splats:
    """Return a scene in other axes, by a matrix M of `change_of_axes`.

    A Gaussian's frame R becomes M·R·Mᵀ, and its scales change places as the axes do. So quaternions keep
    their w and permute the rest like a vector, with all digits, and no rotation is rounded.
    """
    sign = np.sign(np.linalg.det(matrix))
    turn = np.float32(sign) * matrix.astype(np.float32)
    w = splats.quats[:, :1]
    vector = splats.quats[:, 1:]
    quats = np.concatenate([w, vector @ turn.T], axis=1)
    shN = rotate_harmonics(splats.shN, sign * matrix)
    if sign < 0:
        signs = harmonic_signs((-1, -1, -1))
        shN *= signs[: shN.shape[1], None]
    places = np.abs(matrix).argmax(axis=1)
    return replace(
        splats,
        means=splats.means @ matrix.astype(splats.means.dtype).T,
        quats=quats,
        scales=np.ascontiguousarray(splats.scales[:, places]),
        shN=shN,
        offset=matrix @ splats.offset,
        up=_turn_up(splats, matrix),
    )


def as_stored(splats: Splats) -> Splats:
    """Return a scene with float32 means as files hold it, y down; `axes` are still those of its coordinates.

    >>> flat = Splats.create([[1, 2, 3]], scales=[[1, 1, 1]])
    >>> as_stored(replace(flat, axes="RFU")).means.tolist()
    [[1.0, -3.0, 2.0]]
    """
    near = splats.narrowed()
    if near.axes == "RDF":
        return near
    return with_axes(near, change_of_axes(near.axes, "RDF"))


class HasAxes(Protocol):
    """A scene, or a store or stream of one."""

    @property
    def up(self) -> tuple[float, float, float] | None: ...

    @property
    def axes(self) -> Axes: ...


def stand_as(splats: Splats, other: HasAxes) -> Splats:
    """Return a scene with the axes and the up direction of another one, without turning anything."""
    return replace(splats, up=other.up, axes=other.axes)


def moved_axes(offset: ArrayLike, source: Axes, target: Axes) -> Float:
    """Return a (3,) offset in other axes, exactly.

    >>> moved_axes([5.0, 7.0, 2.0], "RFU", "RDF").tolist()
    [5.0, -2.0, 7.0]
    """
    return change_of_axes(source, target) @ np.asarray(offset, np.float64) + 0.0


def restored(splats: Splats, axes: Axes) -> Splats:
    """Return the scene whose `as_stored` form this is, in coordinates of these axes.

    >>> restored(Splats.create([[1, -3, 2]], scales=[[1, 1, 1]]), "RFU").means.tolist()
    [[1.0, 2.0, 3.0]]
    """
    if axes == "RDF":
        return splats
    return replace(with_axes(splats, change_of_axes("RDF", axes)), axes=axes)


def up_in(axes: Axes) -> tuple[float, float, float]:
    """Return the (3,) up direction in a system of axes.

    >>> up_in("RFU"), up_in("RDF")
    ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    """
    x, y, z = (change_of_axes("RUB", axes) @ (0.0, 1.0, 0.0) + 0.0).tolist()
    return x, y, z


def join(scenes: Sequence[Splats]) -> Splats:
    """Join scenes into one, relative to the first one's offset and at the highest SH degree.

    >>> a = Splats.create([[0, 0, 0]], scales=[[1, 1, 1]], offset=[100, 0, 0])
    >>> b = Splats.create([[1, 0, 0]], scales=[[1, 1, 1]])
    >>> join([a, b]).means.tolist()
    [[0.0, 0.0, 0.0], [-99.0, 0.0, 0.0]]
    """
    if not scenes:
        raise InputError("no scenes", parameter="scenes")
    model = one_model([scene.render_model for scene in scenes])
    degree = max(scene.sh_degree for scene in scenes)
    offset = scenes[0].offset
    parts = [scene.recentred(offset).with_sh_degree(degree) for scene in scenes]
    together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    ups = {scene.up for scene in scenes}
    return Splats(
        **together,
        offset=offset,
        render_model=model,
        up=ups.pop() if len(ups) == 1 else None,
        axes=common_axes([scene.axes for scene in scenes]),
    )


def common_axes(axes: Sequence[Axes]) -> Axes:
    """Return the axes that all scenes share, or those of files."""
    if len(set(axes)) == 1:
        return axes[0]
    return "RDF"


def one_model(models: Sequence[RenderModel]) -> RenderModel:
    """Return the render model that all scenes share; raise an `InputError` if they differ."""
    if len(set(models)) > 1:
        raise InputError(
            f"the scenes have different render models ({', '.join(models)}) and cannot be combined",
            hint="if a file is tagged wrongly, {render_model=MODEL} reads all of them as one",
        )
    return models[0]


def in_box(splats: Splats, low: ArrayLike, high: ArrayLike) -> Mask:
    """Return the (N,) mask of means in an axis-aligned box (inclusive), world coordinates."""
    return within_box(splats.positions, low, high)


def within_box(world: Float, low: ArrayLike, high: ArrayLike) -> Mask:
    """Return the (N,) mask of (N, 3) positions in an axis-aligned box (inclusive)."""
    low = np.asarray(low, np.float64)
    high = np.asarray(high, np.float64)
    if not (low <= high).all():
        raise InputError(
            f"from {low.tolist()} to {high.tolist()} holds nothing; the lower corner comes first",
            parameter="box",
        )
    inside: Mask = np.all((world >= low) & (world <= high), axis=1)
    return inside


def in_sphere(splats: Splats, center: ArrayLike, radius: float) -> Mask:
    """Return the (N,) mask of means within `radius` of `center`, world coordinates."""
    if not radius > 0:
        raise InputError(f"expected a radius > 0, got {radius:g}", parameter="sphere")
    away = splats.positions - np.asarray(center, np.float64)
    return (away * away).sum(axis=1) <= radius * radius
