"""Rigid motions: the exponential map, and pose errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from g2ard.arrays import Float


def rotation_of(omega: ArrayLike) -> Float:
    """Return the (3, 3) rotation by |ω| radians about ω (Rodrigues): I + sin θ/θ [ω]ₓ + (1 − cos θ)/θ² [ω]ₓ².

    >>> np.round(rotation_of([0, 0, np.pi / 2]) @ [1, 0, 0], 12).tolist()
    [0.0, 1.0, 0.0]
    """
    cross, first, second = _rodrigues(omega)
    return np.eye(3) + first * cross + second * (cross @ cross)


def moved(viewmat: Float, xi: ArrayLike) -> Float:
    """Return exp(ξ)·T for a (4, 4) camera_from_world T and ξ = (v, ω), (6,), in the camera's axes.

    The translation of exp(ξ) is V·v with V = I + (1 − cos θ)/θ² [ω]ₓ + (θ − sin θ)/θ³ [ω]ₓ². The rotation is
    re-orthogonalised, so that rounding does not accumulate.
    """
    xi = np.asarray(xi, np.float64)
    v = xi[:3]
    omega = xi[3:]
    cross, first, second = _rodrigues(omega)
    angle2 = float(omega @ omega)
    if angle2 > 1e-8:
        third = (1 - first) / angle2
    else:
        third = 1 / 6
    square = cross @ cross
    R = np.eye(3) + first * cross + second * square
    V = np.eye(3) + second * cross + third * square
    out = np.eye(4)
    U, _, Vt = np.linalg.svd(R @ viewmat[:3, :3])
    out[:3, :3] = U @ Vt
    out[:3, 3] = R @ viewmat[:3, 3] + V @ v
    return out


def motion_between(first: Float, second: Float) -> Float:
    """Return ξ = (v, ω), (6,), with exp(ξ)·first = second, for rotations below 180°."""
    R = second[:3, :3] @ first[:3, :3].T
    axis = _skew_axis(R) / 2
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, (np.trace(R) - 1) / 2))
    omega = axis
    if length > 1e-9:
        omega = axis * (angle / length)
    columns = [moved(np.eye(4), [*unit, *omega])[:3, 3] for unit in np.eye(3)]
    V = np.stack(columns, 1)
    v = np.linalg.solve(V, second[:3, 3] - R @ first[:3, 3])
    return np.concatenate([v, omega])


def pose_error(found: Float, true: Float) -> tuple[float, float]:
    """Return the distance of the camera centres, scene units, and the angle between rotations, degrees.

    The angle of the (4, 4) camera_from_world is atan2(|axis|, trace − 1): the arc cosine of the trace loses
    small angles to rounding.
    """
    found_centre, true_centre = (-T[:3, :3].T @ T[:3, 3] for T in (found, true))
    R = found[:3, :3] @ true[:3, :3].T
    sine = np.linalg.norm(_skew_axis(R))
    angle = np.degrees(np.arctan2(sine, np.trace(R) - 1))
    away = np.linalg.norm(found_centre - true_centre)
    return float(away), float(angle)


def _skew_axis(R: Float) -> Float:
    """Return the (3,) axis of a rotation, times 2 sin θ."""
    return np.array(
        [
            R[2, 1] - R[1, 2],
            R[0, 2] - R[2, 0],
            R[1, 0] - R[0, 1],
        ]
    )


def _rodrigues(omega: ArrayLike) -> tuple[Float, float, float]:
    """Return [ω]ₓ and Rodrigues' coefficients sin θ/θ and (1 − cos θ)/θ², by series for small θ."""
    x, y, z = np.asarray(omega, np.float64)
    cross = np.array(
        [
            [0, -z, y],
            [z, 0, -x],
            [-y, x, 0],
        ]
    )
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        return cross, 1 - angle2 / 6, 0.5 - angle2 / 24
    angle = np.sqrt(angle2)
    first = np.sin(angle) / angle
    second = (1 - np.cos(angle)) / angle2
    return cross, float(first), float(second)
